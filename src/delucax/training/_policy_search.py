"""The search behind `synthesise`: trials, refinement, choice and comparison."""

import time
import warnings
from collections.abc import Iterator
from typing import Any

import jax.numpy as jnp
import jax.random as jr
import numpy as np
import optax
from jaxtyping import Array

from .._controller import AbstractController
from .._module import get_path
from .._typing import PRNGKey
from ..controllers import local_lqr, local_mpc, LQR, Residual, Zero
from ..disturbances import Zero as NoDisturbance
from ..environments import Environment
from ._attempt import Attempt, Line
from ._costs import expected_cost
from ._episode_costs import (
    costs_of,
    costs_of_mpc,
    costs_of_plan,
    on_plants,
    tamed,
    TamedCost,
)
from ._evolve import evolve
from ._fit import fit
from ._gradient_estimators import ClippedSamples
from ._imitate import imitate
from ._structures import structures


with warnings.catch_warnings():
    # Without ipywidgets, tqdm warns in a notebook, but the text bar still works.
    warnings.simplefilter("ignore")
    from tqdm.auto import tqdm


# After this number of trials the search checks whether the LQR is enough.
_FIRST = 2
# Time constants of the damped gradients, as shares of the episode.
_MEMORIES = (1 / 30, 1 / 10, 1 / 4)
# The numbers of initial states: to choose a policy, to compare it, and to compare it on
# a family of plants.
CHOICE, _COMPARISON, _PLANTS = 64, 16, 48
# The final choice is among this number of policies, on at most `_ROUNDS` times as many
# initial states.
_LAST, _ROUNDS = 4, 8
# Training ends at the first share of the budget, the final choice at the second. The
# rest is for the comparison.
_TRAINING, _CHOOSING = 0.7, 0.75
# A comparison starts only if it is likely to end within `_OVERRUN` times the budget. It
# is expected to take as long as the longest step so far, and MPC `_MPC` times as long.
_OVERRUN, _MPC = 1.1, 2
# Steps in a round of gradient training, and generations in a round of evolution.
_STEPS, _GENERATIONS = 300, 150
# Initial learning rates of a round. The second one is used when no method gains.
_RATE, _FINE_RATE = 2e-2, 2e-3
# Gradients in a batch, and the longest rollout that is differentiated.
_BATCH, _LONGEST = 32, 200
# Episodes in the cost of each model of a generation.
_EVALUATIONS = 8
# The usual cost before it is known, so large that no cost is far above it.
_ANY = 1e30
# The shares of the budget for a trial and for a later attempt, after the first round.
# After each pass the best 1 / `_FEWER` of the trials go on, `_FEWER` times as long.
_TRIAL, _ATTEMPT, _FEWER = 0.01, 0.03, 3
# A trial is dropped if it costs more than the best by this share.
_CLOSE = 0.5
# Relative gains. Below the first, a method counts as one that does not gain. Below the
# second, a gain does not justify a network or an expert.
_GAIN, _WORTH = 1e-3, 5e-3
# Initial standard deviations of an evolution: of a network, of other policies, and of a
# policy that is already trained.
_WIDE, _NARROW, _NEAR = 1.0, 0.3, 0.05


def _is_better(other: Any, own: Any) -> bool:
    """Whether the mean cost `other` is enough below `own` to justify a change."""
    if not np.isfinite(own):
        return bool(np.isfinite(other))
    return bool(own - other > _WORTH * abs(own))


class PolicySearch:
    """A search for a policy within a time budget."""

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
        options: Any = dict(desc="synthesise", bar_format=layout, disable=not progress)
        self.bar = tqdm(total=round(budget), **options)
        # If an interrupt comes before the first trial, this is the result.
        zero = Zero(environment.control_size)
        self.best = {"zero": Line("zero", "none", zero)}
        self.last: list[Line] = []
        self.tried: list[Attempt] = []
        self.lqr: LQR | None = None
        self.steps = min(environment.horizon, _LONGEST)
        lasting = self.steps * float(environment.dt)
        unit, times = environment.dynamics.time_unit, [lasting * m for m in _MEMORIES]
        # From the name of a method to the time constant of its damped gradient.
        damped: dict[str, Any] = {f"gradient, {at:.2g} {unit}": at for at in times}
        self.methods = damped | {"gradient": jnp.inf, "evolution": None}
        self.rate = _RATE
        # The least median cost so far, and its absolute value.
        self.least, self.usual = np.inf, _ANY
        # The longest step so far: a first round, which compiles, or a comparison.
        self.longest = 0.0

    @property
    def seconds(self) -> float:
        """The time since the search began."""
        return time.perf_counter() - self.began

    @property
    def may_train(self) -> bool:
        """Whether there is time to train."""
        return self.seconds < _TRAINING * self.budget

    def may_compare(self, name: str) -> bool:
        """Whether there is time for a comparison with this controller."""
        # MPC makes a plan at each step, and takes longer to compile than a training.
        likely = self.longest * (_MPC if name == "MPC" else 1)
        return self.seconds + likely < _OVERRUN * self.budget

    def keys(self, count: int) -> Array:
        """Keys for `count` episodes. Another count gives other keys."""
        return jr.split(jr.fold_in(self.key, count), count)

    def fresh_key(self) -> PRNGKey:
        """A key that was not used before."""
        self.draws += 1
        return jr.fold_in(self.key, CHOICE + self.draws)

    def run(self, width: int, depth: int) -> None:
        """Train until the time is up or no method gains."""
        env = self.environment
        self.enter(self.best["zero"])
        self.lqr = self.regulator()
        if self.lqr is not None:
            self.enter(Line("LQR", "none", self.lqr))
        self.warn_of_lost_starts()
        family = self.ranges is not None
        made = structures(env, self.lqr, family, width, depth, self.fresh_key())
        pairs = [(name, method) for method in self.methods for name in made]
        # The trials that show whether the LQR is enough come first.
        first = [("LQR + memory" if family else "LQR + network", "gradient")]
        first.append(("network", "evolution"))
        pairs = sorted(pairs, key=lambda pair: pair not in first)
        lines = [Line(name, method, made[name]) for name, method in pairs]
        # Successive halving: the best third goes on, for three times as long.
        share = _TRIAL
        while (self.may_train or not self.tried) and len(lines) > 1:
            after = []
            for line in lines:
                if not self.may_train and after:
                    break
                after.append(self.attempt(line, share))
                if len(self.tried) == _FIRST and self.is_settled():
                    return
            left = max(1, round(len(lines) / _FEWER))
            after = sorted(after, key=self.score)[:left]
            least = self.score(after[0])
            most = least + _CLOSE * abs(least)
            lines = [line for line in after if self.score(line) <= most]
            share *= _FEWER
        if lines:
            self.finish(lines[0], made[lines[0].structure])

    def warn_of_lost_starts(self) -> None:
        """Warn before the training if plants run away under all laws so far."""
        known = [line.costs for line in self.best.values() if line.costs is not None]
        lost = np.all([~np.isfinite(costs) for costs in known], axis=0)
        if np.any(lost):
            laws = "zero control and the LQR" if self.lqr else "zero control"
            warnings.warn(
                f"synthesise: the cost is not finite from {np.sum(lost)} of "
                f"{len(lost)} initial states under {laws}. If no control keeps the "
                "plant finite from there, no policy will: draw other initial states, "
                "or end the episode before (`terminated`).",
                stacklevel=4,
            )

    def regulator(self) -> LQR | None:
        """The LQR, or `None` if it does not exist for this environment."""
        if not self.environment.dynamics.observes_state:
            return None
        try:
            return local_lqr(self.environment)
        except (ValueError, RuntimeError) as error:
            warnings.warn(
                "synthesise: no LQR and no network around one is tried, because there "
                f"is no LQR: {error} If the plant can rest somewhere, define its "
                "`equilibrium`, or give the cost a target.",
                stacklevel=4,
            )
            return None

    def is_settled(self) -> bool:
        """Whether the LQR is enough: neither the first two trials nor a plan is better.
        With disturbances MPC replaces the plan, because a plan would know them."""
        if self.chosen()[0] != "LQR":
            return False
        keys = self.keys(CHOICE)[: len(self.comparison)]
        own = np.mean(costs_of(self.environment, self.ranges, self.lqr, keys))
        known = isinstance(self.environment.disturbance, NoDisturbance)
        other = np.mean(self.costs_of_rival("plan" if known else "MPC", self.lqr, keys))
        return bool(np.isfinite(own)) and not _is_better(other, own)

    def costs_of_rival(self, name: str, policy: Any, keys: Array) -> np.ndarray:
        """The costs of MPC, or of a plan that starts from the controls of `policy`."""
        began = self.seconds
        given = self.environment, self.ranges
        costs = np.asarray(
            costs_of_mpc(*given, self.lqr, keys)
            if name == "MPC"
            else costs_of_plan(*given, policy, keys)
        )
        # The next comparison may take as long.
        self.longest = max(self.longest, self.seconds - began)
        return costs

    def trained(self, line: Line) -> AbstractController:
        """The policy of a line after one round of training with its method."""
        env, policy, method = self.environment, line.policy, line.method
        options: Any = dict(key=self.fresh_key(), progress=False, throw=False)
        if isinstance(policy, Residual):
            options["trainable"] = "correction"  # not the LQR
        if method == "imitation":
            expert = local_mpc(env, self.lqr, throw=False)
            return imitate(env, expert, policy, **options).model
        if method == "evolution":
            width = _WIDE if line.structure == "network" else _NARROW
            options["sigma"] = width if line.costs is None else _NEAR
            episode = expected_cost(env, batch=1, ranges=self.ranges)
            loss = TamedCost(episode, jnp.asarray(self.usual), _EVALUATIONS)
            return evolve(loss, policy, _GENERATIONS, **options).model
        adam = optax.adam(optax.cosine_decay_schedule(self.rate, _STEPS))
        optimiser = optax.chain(optax.clip_by_global_norm(1.0), adam)
        # An array, so that the methods share one compiled program.
        decay = jnp.exp(-env.dt / self.methods[method])
        shape: Any = dict(batch=1, horizon=self.steps)
        loss = expected_cost(env, gradient_decay=decay, ranges=self.ranges, **shape)
        options["gradient"] = ClippedSamples(_BATCH)
        return fit(loss, policy, optimiser, _STEPS, **options).model

    def finish(self, line: Line, untrained: AbstractController) -> None:
        """Refine the last policy.

        Each attempt uses the method with the largest gain in its last attempt. When no
        method gains, go on with the fine learning rate; after that, try once an
        imitation of MPC, if MPC costs less.
        """
        fresh = dict.fromkeys([line.method, *self.methods], np.inf)
        gains, has_imitated = fresh.copy(), False
        while self.may_train:
            method = max(gains, key=lambda method: gains[method])
            after = self.attempt(line._replace(method=method), _ATTEMPT)
            own = self.score(after)
            gains[method] = (self.score(line) - own) / max(abs(own), 1e-12)
            line = min(line, after, key=self.score)
            if max(gains.values()) > _GAIN:
                continue
            gains = fresh.copy()
            if self.rate != _FINE_RATE:
                self.rate = _FINE_RATE
            elif not has_imitated and self.expert_is_better(line.policy):
                has_imitated, self.rate = True, _RATE
                clone = Line(line.structure, "imitation", untrained)
                line = min(line, self.attempt(clone, 0.0), key=self.score)
            else:
                break

    def expert_is_better(self, policy: AbstractController) -> bool:
        """Whether MPC costs less than the policy, on a few initial states."""
        if not self.environment.dynamics.observes_state or self.ranges is not None:
            return False
        keys = self.keys(CHOICE)[:_COMPARISON]
        expert = np.mean(self.costs_of_rival("MPC", policy, keys))
        own = np.mean(costs_of(self.environment, None, policy, keys))
        return _is_better(expert, own)

    def attempt(self, line: Line, share: float) -> Line:
        """The line after some rounds of its method. After the first round, which
        compiles, they may take `share` of the budget."""
        began, compiled, best = self.seconds, None, line
        while compiled is None or self.seconds - compiled < share * self.budget:
            policy = self.trained(best)
            now = best._replace(policy=policy, costs=self.costs(policy))
            if compiled is None:
                compiled = self.seconds
                self.longest = max(self.longest, compiled - began)
            # If a round changes nothing, it diverged at its first step.
            stays = self.score(now) == self.score(best)
            best = min(best, now, key=self.score)
            if stays or not self.may_train:
                break
        self.enter(best)
        took = self.seconds - began
        self.tried.append(Attempt(line.structure, line.method, self.mean(best), took))
        least = min(self.best.values(), key=self.mean)
        shown = f"cost {self.mean(least):.5g}, {least.structure}"
        self.bar.set_postfix_str(shown, refresh=False)
        self.bar.update(min(self.seconds, self.bar.total) - self.bar.n)
        return best

    def costs(self, policy: AbstractController, keys: Any = None) -> np.ndarray:
        """The costs of a policy, by default in the episodes for choosing a policy."""
        keys = self.keys(CHOICE) if keys is None else keys
        return np.asarray(costs_of(self.environment, self.ranges, policy, keys), float)

    def enter(self, line: Line) -> None:
        """Keep the line if it is the best of its structure, and update the usual
        cost."""
        if line.costs is None:
            line = line._replace(costs=self.costs(line.policy))
        name = line.structure
        self.last = sorted([*self.last, line], key=self.score)[:_LAST]
        self.best[name] = min(self.best.get(name, line), line, key=self.score)
        costs = self.best[name].costs
        middle = float(np.median(np.where(np.isfinite(costs), costs, np.inf)))
        # The least is taken with its sign, so a large reward, which is a negative cost,
        # gives a large usual cost.
        if middle != 0 and middle < self.least:
            self.least, self.usual = middle, abs(middle)

    def score(self, line: Line) -> float:
        """The mean tamed cost, the criterion for choosing policies."""
        if line.costs is None:
            return np.inf
        return float(jnp.mean(tamed(jnp.asarray(line.costs), self.usual)))

    def mean(self, line: Line) -> float:
        """The mean cost, or infinity if the cost of an episode is not finite."""
        costs = np.inf if line.costs is None else line.costs
        return float(np.mean(np.where(np.isfinite(costs), costs, np.inf)))

    def choose(self) -> None:
        """Prepare the final choice among the best policies, zero control and the LQR:
        compare them on more initial states.

        Good policies often differ only in a rare episode in which the plant runs away,
        and the first 64 initial states may have none.
        """
        floor = [self.best[name] for name in ("zero", "LQR") if name in self.best]
        lines = [line for line in self.last if line.costs is not None]
        lines += [line for line in floor if line.costs is not None]
        for k in range(1, _ROUNDS):
            if self.seconds > _CHOOSING * self.budget:
                break
            keys = jr.split(jr.fold_in(jr.fold_in(self.key, CHOICE), k), CHOICE)
            more = [self.costs(line.policy, keys) for line in lines]
            lines = [
                line._replace(costs=np.concatenate([line.costs, costs]))
                for line, costs in zip(lines, more, strict=True)
            ]
        for line in lines:
            own = [other for other in lines if other.structure == line.structure]
            self.best[line.structure] = min(own, key=self.score)

    def chosen(self) -> tuple[str, AbstractController]:
        """The best policy, or zero control or the LQR if they are about as good."""
        best = min(self.best.values(), key=self.score)
        least = self.score(best)
        for name in ("zero", "LQR"):
            simple = self.best.get(name, best)
            if self.score(simple) - least <= _WORTH * abs(least):
                best = simple
                break
        return best.structure, best.policy

    @property
    def comparison(self) -> Array:
        """The keys of the episodes for the comparison."""
        return self.keys(_COMPARISON if self.ranges is None else _PLANTS)

    def plants(self) -> dict[str, np.ndarray]:
        """The parameters drawn for the plants of the comparison, by path."""
        ranges = self.ranges or {}
        of = lambda plant, key: {path: get_path(plant, path) for path in ranges}
        drawn = on_plants(self.environment, ranges, self.comparison, of)
        return {path: np.asarray(values) for path, values in drawn.items()}

    def compared(self, policy: AbstractController) -> Iterator[tuple[str, np.ndarray]]:
        """The costs of the policy and of other controllers, one after the other, in
        episodes that were used for nothing else."""
        env, ranges, keys = self.environment, self.ranges, self.comparison
        floor = {n: self.best[n].policy for n in ("zero", "LQR") if n in self.best}
        laws = {"policy": policy, **floor}
        for name, law in laws.items():
            yield name, np.asarray(costs_of(env, ranges, law, keys), float)
        for name in ("MPC", "plan") if env.dynamics.observes_state else ("plan",):
            if self.may_compare(name):
                costs = self.costs_of_rival(name, policy, keys)
                yield name, np.asarray(costs, float)
