"""The search behind `synthesise`: trials, refinement, choice and comparison."""

import time
import warnings
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
import optax
from jaxtyping import Array

from .._controller import AbstractController
from .._module import get_path
from .._typing import PRNGKey
from ..controllers import Constant, local_lqr, local_mpc, LQR, OpenLoop, Zero
from ..disturbances import Zero as NoDisturbance
from ..environments import Environment, randomise
from ..planning import ILQR
from ..simulation import rollout
from ._costs import expected_cost
from ._evolve import evolve
from ._fit import fit
from ._imitate import imitate
from ._structures import LQR_AND_NETWORK, structures


with warnings.catch_warnings():
    # In a notebook without ipywidgets it warns, and draws its bar as text all the same.
    warnings.simplefilter("ignore")
    from tqdm.auto import tqdm


_WHERE = "synthesise"
# After which share of the episode a damped gradient is forgotten.
_MEMORIES = (1 / 30, 1 / 10, 1 / 4)
# What is tried first where there is an LQR: they tell whether it is enough.
_FIRST = [(LQR_AND_NETWORK, "gradient"), ("network", "evolution")]
# Starts on which policies are chosen, and others on which the best is compared: more
# where each has a plant of its own.
_CHOICE, _COMPARISON, _PLANTS = 64, 16, 48
# The share of the budget for training; the rest is for the comparison.
_TRAINING = 0.7
# How far a comparison may overrun it, if it takes as long as the longest compilation.
_OVERRUN = 1.1
# Steps of a round, and generations of one of evolution.
_STEPS, _GENERATIONS = 300, 150
# First learning rates of a round: the second is for when nothing gains any more.
_RATE, _FINE_RATE = 2e-2, 2e-3
_BATCH, _LONGEST = 32, 200
# The share of the budget that a trial and a later attempt may take, after its first
# round, and how many times fewer and longer the trials become.
_TRIAL, _ATTEMPT, _FEWER = 0.01, 0.03, 3
# Trials that cost more than the best by this share are given up.
_CLOSE = 0.5
# A gain below which a method is given up, and one that is worth a network or an
# expert.
_GAIN, _WORTH = 1e-3, 5e-3
# How wide an evolution begins: for each structure, and near the best.
_WIDTHS, _NEAR = {"network": 1.0, LQR_AND_NETWORK: 0.3, "memory": 0.3}, 0.05


class Attempt(NamedTuple):
    """One training that was tried.

    **Attributes:** `structure` of the policy; `method`; `cost`, the mean over the
    starts on which policies are chosen; `seconds`, with compilation.

    !!! example

        ```python
        import delucax as dlx

        attempt = dlx.training.Attempt("network", "evolution", 12.5, 3.0)
        attempt.method, attempt.cost
        ```
    """

    structure: str
    method: str
    cost: float
    seconds: float


class _Line(NamedTuple):
    """A policy that one method trains, and its cost."""

    structure: str
    method: str
    policy: AbstractController
    cost: float


class PolicySearch:
    """The best policy so far of each structure, and what was tried, within a time."""

    def __init__(
        self,
        environment: Environment,
        ranges: dict[str, Any] | None,
        key: PRNGKey,
        budget: float,
        progress: bool,
    ):
        self.environment, self.ranges = environment, ranges
        self.key, self.draws, self.budget = key, 0, budget
        self.began = time.perf_counter()
        layout = "{desc}: {bar}| {n:.0f}/{total:.0f} s{postfix}"
        options: Any = dict(desc=_WHERE, bar_format=layout, disable=not progress)
        self.bar = tqdm(total=round(budget), **options)
        # Also what an interrupt leaves before anything has been tried.
        self.best: dict[str, tuple[AbstractController, float]] = {
            "zero": (Zero(environment.control_size), np.inf)
        }
        self.tried: list[Attempt] = []
        self.lqr: LQR | None = None
        self.steps = min(environment.horizon, _LONGEST)
        lasting = self.steps * float(environment.dt)
        memories = {f"gradient, {lasting * m:.2g} s": lasting * m for m in _MEMORIES}
        # Seconds over which a gradient is forgotten.
        self.methods = memories | {"gradient": jnp.inf, "evolution": None}
        self.rate = _RATE
        # Of the first round of an attempt, which compiles.
        self.longest = 0.0

    @property
    def seconds(self) -> float:
        """The time since the beginning."""
        return time.perf_counter() - self.began

    @property
    def may_train(self) -> bool:
        """Whether there is time to train."""
        return self.seconds < _TRAINING * self.budget

    @property
    def may_compare(self) -> bool:
        """Whether there is time to compare with one more controller."""
        return self.seconds + self.longest < _OVERRUN * self.budget

    def keys(self, count: int) -> Array:
        """Keys of that many episodes, others for each count."""
        return jr.split(jr.fold_in(self.key, count), count)

    def fresh_key(self) -> PRNGKey:
        """A key that was not used before."""
        self.draws += 1
        return jr.fold_in(self.key, _CHOICE + self.draws)

    def check(self) -> None:
        """Raise where nothing could be trained, whatever the method."""
        env, keys = self.environment, self.keys(_CHOICE)
        loss = expected_cost(env, batch=1, horizon=1, ranges=self.ranges)
        held = Constant(jnp.zeros(env.control_size))
        try:
            jax.eval_shape(eqx.filter_grad(loss), held, keys[0])
        except Exception as error:
            raise ValueError(
                f"{_WHERE}: environment must have dynamics and a cost that JAX can "
                f"differentiate, got: {str(error).splitlines()[0]} For others use "
                "delucax.training.evolve."
            ) from error
        starts, costs, steps = map(np.asarray, _first_steps(env, keys))
        for what, values in (("first state", starts), ("cost of a first state", costs)):
            finite = np.isfinite(values.reshape(_CHOICE, -1)).all(axis=1)
            if not finite.all():
                x = starts[finite.argmin()]
                raise ValueError(f"{_WHERE}: the {what} must be finite, at x0 = {x}.")
        kept = np.isfinite(steps).all(axis=-1).any(axis=1)
        if not kept.all():
            raise ValueError(
                f"{_WHERE}: no control keeps the first step finite from x0 = "
                f"{starts[kept.argmin()]}."
            )

    def run(self, width: int, depth: int) -> None:
        """Train until the time is up or nothing gains any more."""
        env = self.environment
        zero, _ = self.best["zero"]
        self.best["zero"] = zero, self.cost(zero)
        self.lqr = self.regulator()
        if self.lqr is not None:
            self.best["LQR"] = self.lqr, self.cost(self.lqr)
        made = structures(env, self.lqr, width, depth, self.fresh_key())
        pairs = [(name, method) for method in self.methods for name in made]
        pairs = sorted(pairs, key=lambda pair: pair not in _FIRST)
        lines = [_Line(name, method, made[name], np.inf) for name, method in pairs]
        # Successive halving: the better third goes on, for three times as long.
        share = _TRIAL
        while (self.may_train or not self.tried) and len(lines) > 1:
            after = []
            for line in lines:
                if not self.may_train and self.tried:
                    break
                after.append(self.attempt(line, share))
                if self.is_settled():
                    return
            left = max(1, round(len(lines) / _FEWER))
            after = sorted(after, key=lambda line: line.cost)[:left]
            most = after[0].cost + _CLOSE * abs(after[0].cost)
            lines = [line for line in after if line.cost <= most]
            share *= _FEWER
        if lines:
            self.finish(lines[0], made[lines[0].structure])

    def regulator(self) -> LQR | None:
        """The LQR, where there is one."""
        if not self.environment.dynamics.observes_state:
            return None
        try:
            return local_lqr(self.environment)
        except (ValueError, RuntimeError):
            return None

    def is_settled(self) -> bool:
        """Whether neither training around the LQR nor a search without gradient nor a
        plan is better than the LQR, or MPC where a plan would know the disturbances."""
        tried = [(attempt.structure, attempt.method) for attempt in self.tried]
        if tried != _FIRST or self.chosen()[0] != "LQR":
            return False
        env, keys = self.environment, self.keys(_CHOICE)[: len(self.comparison)]
        own = np.mean(_costs(env, self.ranges, self.lqr, keys))
        known = isinstance(env.disturbance, NoDisturbance)
        other = np.mean(
            _costs_of_plan(env, self.ranges, self.lqr, keys)
            if known
            else _costs_of_mpc(env, self.ranges, self.lqr, keys)
        )
        return bool(own - other <= _WORTH * abs(own))

    def trained(self, line: _Line) -> AbstractController:
        """The policy of a line after a round of its method."""
        env, policy, method = self.environment, line.policy, line.method
        options: Any = dict(key=self.fresh_key(), progress=False, throw=False)
        # The LQR inside a policy stays as it is.
        options["trainable"] = (
            "correction" if line.structure == LQR_AND_NETWORK else None
        )
        if method == "imitation":
            expert = local_mpc(env, self.lqr, throw=False)
            return imitate(env, expert, policy, **options).model
        if method == "evolution":
            options["sigma"] = (
                _NEAR if np.isfinite(line.cost) else _WIDTHS[line.structure]
            )
            loss = expected_cost(env, batch=8, ranges=self.ranges)
            return evolve(loss, policy, _GENERATIONS, **options).model
        adam = optax.adam(optax.cosine_decay_schedule(self.rate, _STEPS))
        optimiser = optax.chain(optax.clip_by_global_norm(1.0), adam)
        # An array, so that all compile once.
        decay = jnp.exp(-env.dt / self.methods[method])
        shape: Any = dict(batch=_BATCH, horizon=self.steps)
        loss = expected_cost(env, gradient_decay=decay, ranges=self.ranges, **shape)
        return fit(loss, policy, optimiser, _STEPS, **options).model

    def finish(self, line: _Line, untrained: AbstractController) -> None:
        """Train the last line on by the method that gained most when it was last used,
        until none gains; then more slowly, and from what imitates MPC if that is
        better."""
        fresh = dict.fromkeys([line.method, *self.methods], np.inf)
        gains, has_imitated = fresh.copy(), False
        while self.may_train:
            method = max(gains, key=lambda method: gains[method])
            after = self.attempt(line._replace(method=method), _ATTEMPT)
            gain = (line.cost - after.cost) / max(abs(after.cost), 1e-12)
            # NaN where neither is finite.
            gains[method] = np.nan_to_num(gain)
            line = min(line, after, key=lambda line: line.cost)
            if max(gains.values()) > _GAIN:
                continue
            gains = fresh.copy()
            if self.rate != _FINE_RATE:
                self.rate = _FINE_RATE
            elif not has_imitated and self.expert_is_better(line.policy):
                has_imitated, self.rate = True, _RATE
                clone = line._replace(method="imitation", policy=untrained, cost=np.inf)
                line = min(line, self.attempt(clone, 0.0), key=lambda line: line.cost)
            else:
                break

    def expert_is_better(self, policy: AbstractController) -> bool:
        """Whether MPC costs less, on some of the starts of the choice."""
        if not self.environment.dynamics.observes_state or self.ranges is not None:
            return False
        keys = self.keys(_CHOICE)[:_COMPARISON]
        expert = np.mean(_costs_of_mpc(self.environment, None, self.lqr, keys))
        own = np.mean(_costs(self.environment, None, policy, keys))
        return bool(own - expert > _WORTH * abs(own))

    def attempt(self, line: _Line, share: float) -> _Line:
        """The line after rounds of its method, for a share of the budget after the
        first, which compiles."""
        began, compiled, best = self.seconds, None, line
        while compiled is None or self.seconds - compiled < share * self.budget:
            policy = self.trained(best)
            now = best._replace(policy=policy, cost=self.cost(policy))
            if compiled is None:
                compiled = self.seconds
                self.longest = max(self.longest, compiled - began)
            # What changes nothing diverges at once.
            stays = now.cost == best.cost
            best = min(best, now, key=lambda line: line.cost)
            if stays or not self.may_train:
                break
        name = line.structure
        if best.cost < self.best.get(name, (None, np.inf))[1]:
            self.best[name] = best.policy, best.cost
        seconds = self.seconds - began
        self.tried.append(Attempt(name, line.method, best.cost, seconds))
        least = min(cost for _, cost in self.best.values())
        self.bar.set_postfix_str(f"cost {least:.5g}, {name}", refresh=False)
        self.bar.update(min(self.seconds, self.bar.total) - self.bar.n)
        return best

    def cost(self, policy: AbstractController) -> float:
        """The mean cost over the starts on which policies are chosen."""
        keys = self.keys(_CHOICE)
        costs = np.asarray(_costs(self.environment, self.ranges, policy, keys), float)
        return float(np.mean(costs)) if np.all(np.isfinite(costs)) else np.inf

    def chosen(self) -> tuple[str, AbstractController]:
        """The best policy, or the floor where that is as good."""
        least = min(cost for _, cost in self.best.values())
        simple = {
            name: self.best[name] for name in ("zero", "LQR") if name in self.best
        }
        for name, (policy, cost) in simple.items():
            if cost - least <= _WORTH * abs(least):
                return name, policy
        name = min(self.best, key=lambda name: self.best[name][1])
        return name, self.best[name][0]

    @property
    def comparison(self) -> Array:
        """Keys of the episodes in which policies are compared."""
        return self.keys(_COMPARISON if self.ranges is None else _PLANTS)

    def plants(self) -> dict[str, np.ndarray]:
        """What is drawn for the plants of the comparison."""
        ranges = self.ranges or {}
        of = lambda plant, key: {path: get_path(plant, path) for path in ranges}
        drawn = _on_plants(self.environment, ranges, self.comparison, of)
        return {path: np.asarray(values) for path, values in drawn.items()}

    def compared(self, policy: AbstractController) -> dict[str, np.ndarray]:
        """The costs of the policy and of others, from starts of their own."""
        env, ranges, keys = self.environment, self.ranges, self.comparison
        floor = {n: self.best[n][0] for n in ("zero", "LQR") if n in self.best}
        costs = {
            name: _costs(env, ranges, one, keys)
            for name, one in {"policy": policy, **floor}.items()
        }
        if env.dynamics.observes_state and self.may_compare:
            costs["MPC"] = _costs_of_mpc(env, ranges, self.lqr, keys)
        if self.may_compare:
            costs["plan"] = _costs_of_plan(env, ranges, policy, keys)
        return {name: np.asarray(cost, float) for name, cost in costs.items()}


def _on_plants(
    environment: Environment, ranges: dict[str, Any] | None, keys: Array, of: Any
) -> Any:
    """`of(plant, key)` for each key, the plant being drawn as by `expected_cost`."""

    def one(key):
        if ranges is None:
            return of(environment, key)
        key, plant_key = jr.split(key)
        return of(randomise(environment, plant_key, ranges), key)

    return jax.vmap(one)(keys)


_QUIETLY: Any = dict(keep=(), throw=False)


@eqx.filter_jit
def _costs(environment, ranges, policy, keys):
    of = lambda plant, key: rollout(plant, policy, key=key, **_QUIETLY).total_cost
    return _on_plants(environment, ranges, keys, of)


@eqx.filter_jit
def _costs_of_mpc(environment, ranges, lqr, keys):
    def of(plant, key):
        mpc = local_mpc(plant, lqr, throw=False)
        return rollout(plant, mpc, key=key, **_QUIETLY).total_cost

    return _on_plants(environment, ranges, keys, of)


@eqx.filter_jit
def _costs_of_plan(environment, ranges, policy, keys):
    """Of the best plan with known disturbances that starts from the policy's controls,
    or of these."""

    def of(plant, key):
        keep = ("states", "controls", "disturbances")
        run: Any = rollout(plant, policy, key=key, keep=keep, throw=False)
        given: Any = dict(w=run.disturbances, bounds=plant.control_bounds, throw=False)
        x0, planner = run.states[0], ILQR(max_iterations=100)
        plan = planner(plant.dynamics, plant.cost, x0, run.controls, **given)
        planned = rollout(plant, OpenLoop(plan.controls), key=key, **_QUIETLY)
        return jnp.fmin(planned.total_cost, run.total_cost)

    return _on_plants(environment, ranges, keys, of)


@eqx.filter_jit
def _first_steps(environment, keys):
    """First states, their cost without control, and the states after one step under
    several controls."""
    m, bounds = environment.control_size, environment.control_bounds
    controls = jnp.concatenate([jnp.zeros((1, m)), jr.normal(keys[0], (15, m))])
    if bounds is not None:
        low, high = (jnp.nan_to_num(jnp.broadcast_to(e, m)) for e in bounds)
        controls = jnp.concatenate([controls, low[None], high[None]])

    def one(key):
        x0 = environment.reset(environment.split_key(key)[0])
        step = lambda u: environment.step(jnp.zeros(()), x0, u)
        after = jax.vmap(lambda u: step(u).state)(controls)
        return x0, step(jnp.zeros(m)).cost, after

    return jax.vmap(one)(keys)
