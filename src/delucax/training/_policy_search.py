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
from .._typing import PRNGKey
from ..controllers import Constant, local_lqr, LQR, MPC, OpenLoop, Zero
from ..costs import AbstractCost, Function
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
# Seconds over which a damped gradient is forgotten.
_MEMORIES = {"gradient": jnp.inf, "gradient, 0.5 s": 0.5, "gradient, 0.1 s": 0.1}
METHODS = (*_MEMORIES, "evolution")
# Starts on which policies are chosen, and others on which the best is compared.
_CHOICE, _COMPARISON = 64, 16
# The share of the budget for training; the rest is for the comparison.
_TRAINING = 0.7
# Steps and first learning rate of a round, and generations of one of evolution.
_STEPS, _RATE, _GENERATIONS = 300, 5e-3, 150
_BATCH, _LONGEST = 32, 200
# The share of the budget that one attempt may take, after its first round.
_ATTEMPT = 0.03
# A gain below which a method is given up, and one that is worth a network or an
# expert.
_GAIN, _WORTH = 1e-3, 5e-3
# How wide an evolution begins: for each structure, and near the best.
_WIDTHS, _NEAR = {"network": 1.0, LQR_AND_NETWORK: 0.3, "memory": 0.3}, 0.05
# Of MPC, as the expert and in the comparison.
_LOOKAHEAD, _ITERATIONS = 30, 8


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

    @property
    def seconds(self) -> float:
        """The time since the beginning."""
        return time.perf_counter() - self.began

    @property
    def may_train(self) -> bool:
        """Whether there is time to train."""
        return self.seconds < _TRAINING * self.budget

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
        loss = expected_cost(env, batch=1, horizon=1, ranges=self.ranges)
        held = Constant(jnp.zeros(env.control_size))
        try:
            jax.eval_shape(eqx.filter_grad(loss), held, keys[0])
        except Exception as error:
            raise ValueError(
                f"{_WHERE}: environment must have dynamics and a cost that JAX can "
                f"differentiate, got: {error} For others use delucax.training.evolve."
            ) from error

    def run(self, width: int, depth: int) -> None:
        """Train until the time is up or nothing gains any more."""
        env = self.environment
        zero, _ = self.best["zero"]
        self.best["zero"] = zero, self.cost(zero)
        self.lqr = _regulator(env)
        if self.lqr is not None:
            self.best["LQR"] = self.lqr, self.cost(self.lqr)
        made = structures(env, self.lqr, width, depth, self.fresh_key())
        lines = [
            _Line(name, method, policy, np.inf)
            for name, policy in made.items()
            for method in METHODS
        ]
        # Successive halving: the better half goes on, for twice as long.
        share = _ATTEMPT
        while (self.may_train or not self.tried) and len(lines) > 1:
            lines = [
                self.attempt(line, share)
                for line in lines
                if self.may_train or not self.tried
            ]
            lines = sorted(lines, key=lambda line: line.cost)[: (len(lines) + 1) // 2]
            share *= 2
        if lines:
            self.finish(lines[0], made[lines[0].structure])

    def trained(self, line: _Line) -> AbstractController:
        """The policy of a line after a round of its method."""
        env, policy, method = self.environment, line.policy, line.method
        options: Any = dict(key=self.fresh_key(), progress=False, throw=False)
        # The LQR inside a policy stays as it is.
        options["trainable"] = (
            "correction" if line.structure == LQR_AND_NETWORK else None
        )
        if method == "imitation":
            return imitate(env, _mpc(env, self.lqr), policy, **options).model
        if method == "evolution":
            options["sigma"] = (
                _NEAR if np.isfinite(line.cost) else _WIDTHS[line.structure]
            )
            loss = expected_cost(env, batch=8, ranges=self.ranges)
            return evolve(loss, policy, _GENERATIONS, **options).model
        adam = optax.adam(optax.cosine_decay_schedule(_RATE, _STEPS))
        optimiser = optax.chain(optax.clip_by_global_norm(1.0), adam)
        # An array, so that all compile once.
        decay = jnp.exp(-env.dt / _MEMORIES[method])
        shape: Any = dict(batch=_BATCH, horizon=min(env.horizon, _LONGEST))
        loss = expected_cost(env, gradient_decay=decay, ranges=self.ranges, **shape)
        return fit(loss, policy, optimiser, _STEPS, **options).model

    def finish(self, line: _Line, untrained: AbstractController) -> None:
        """Train the last line on, by each method in turn until none gains, and from
        what imitates MPC if that is better."""
        others = [method for method in METHODS if method != line.method]
        methods, left = [line.method, *others], len(METHODS)
        has_imitated = False
        while self.may_train and left:
            after = self.attempt(line._replace(method=methods[0]), 2 * _ATTEMPT)
            gains = line.cost - after.cost > _GAIN * abs(line.cost)
            line = min(line, after, key=lambda line: line.cost)
            left = len(METHODS) if gains else left - 1
            if not gains:
                methods = [*methods[1:], methods[0]]
            if not left and not has_imitated and self.expert_is_better(line.policy):
                has_imitated, left = True, len(METHODS)
                clone = line._replace(method="imitation", policy=untrained, cost=np.inf)
                line = min(line, self.attempt(clone, 0.0), key=lambda line: line.cost)

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
        began, compiled, now = self.seconds, None, line
        best = now
        while compiled is None or self.seconds - compiled < share * self.budget:
            before, policy = now.cost, self.trained(now)
            now = now._replace(policy=policy, cost=self.cost(policy))
            best = min(best, now, key=lambda line: line.cost)
            compiled = self.seconds if compiled is None else compiled
            # What changes nothing diverges at once.
            if now.cost == before or not self.may_train:
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

    def compared(self, policy: AbstractController) -> dict[str, np.ndarray]:
        """The costs of the policy and of others, from starts of their own."""
        env, ranges = self.environment, self.ranges
        keys = self.keys(_COMPARISON)
        floor = {n: self.best[n][0] for n in ("zero", "LQR") if n in self.best}
        costs = {
            name: _costs(env, ranges, one, keys)
            for name, one in {"policy": policy, **floor}.items()
        }
        if env.dynamics.observes_state and self.seconds < self.budget:
            costs["MPC"] = _costs_of_mpc(env, ranges, self.lqr, keys)
        if self.seconds < self.budget:
            costs["plan"] = _costs_of_plan(env, ranges, policy, keys)
        return {name: np.asarray(cost, float) for name, cost in costs.items()}


def _regulator(environment: Environment) -> LQR | None:
    """The LQR, where there is one."""
    if not environment.dynamics.observes_state:
        return None
    try:
        return local_lqr(environment)
    except (ValueError, RuntimeError):
        return None


def _mpc(environment: Environment, lqr: LQR | None) -> MPC:
    """MPC with the model and the cost of the task, and at the end of a plan the LQR's
    cost to go, where there is one."""
    dynamics, cost = environment.dynamics, environment.cost
    if lqr is not None:
        P, x_ref, difference = lqr.P, lqr.x_ref, dynamics.difference

        def to_go(t: Any, x: Array) -> Array:
            away = difference(x, x_ref)
            return away @ P @ away

        cost: AbstractCost = Function(cost, to_go)
    planner = ILQR(max_iterations=_ITERATIONS)
    bounds = environment.control_bounds
    return MPC(dynamics, cost, _LOOKAHEAD, planner=planner, bounds=bounds, throw=False)


def _on_plants(
    environment: Environment, ranges: dict[str, Any] | None, keys: Array, of: Any
) -> Array:
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
        return rollout(plant, _mpc(plant, lqr), key=key, **_QUIETLY).total_cost

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
