"""The search behind `synthesise`: trials, refinement, choice and comparison."""

import warnings
from collections.abc import Iterator
from typing import Any

import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
from jaxtyping import Array

from ..._controller import AbstractController
from ..._module import get_path
from ..._progress import tqdm
from ..._typing import PRNGKey
from ...controllers import local_lqg, local_lqr, LQG, LQR, Zero
from ...disturbances import Zero as NoDisturbance
from ...environments import Environment
from ._attempt import Attempt, Candidate
from ._budget import Budget
from ._episode_costs import (
    costs_of,
    costs_of_mpc,
    costs_of_plan,
    is_hidden,
    on_plants,
    tamed,
)
from ._rounds import by_evolution, by_gradient, LONGEST
from ._structures import structures


# After this number of trials the search checks whether the LQR is enough.
_FIRST = 2
# Time constants of the damped gradients, as shares of the differentiated rollout.
_TIME_CONSTANTS = (1 / 30, 1 / 10, 1 / 4)
# The numbers of initial states: to choose a policy, to compare it, and to compare it on
# a family of plants.
CHOICE, _COMPARISON, _PLANTS = 64, 16, 48
# The final choice is among this number of policies, on at most `_ROUNDS` times as many
# initial states.
_LAST, _ROUNDS = 4, 8
# Episodes of a comparison with MPC or plans that run together.
_TOGETHER = 4
# A round of training ends early if it has taken this share of the budget since its
# first block, which compiles.
_ROUND = 0.05
# The initial learning rate of a method. It falls by the second factor when the method
# does not gain, and below the third number the method is not used for this policy any
# more. The standard deviation of an evolution falls by the same factor.
_RATE, _SLOWER, _LEAST_RATE = 2e-2, 0.1, 1e-3
# The usual cost before it is known, so large that no cost is far above it.
_ANY = 1e30
# The share of the budget for an attempt, after its first round, and for each policy of
# the second pass. After each pass the best half goes on, for twice as long.
_ATTEMPT, _SHARE, _FEWER = 0.02, 0.1, 2
# A policy is dropped if it costs more than the best by this share.
_CLOSE = 0.5
# Relative gains. Below the first, a method counts as one that does not gain. Below the
# second, a gain does not justify a network.
_GAIN, _WORTH = 1e-3, 5e-3
# Initial standard deviations of an evolution: of a network, of other policies, and of a
# policy that is already trained.
_WIDE, _NARROW, _NEAR = 1.0, 0.3, 0.05
_EVOLUTION = "evolution"


def _is_better(other: Any, own: Any) -> bool:
    """Whether the mean cost `other` is enough below `own` to justify a change."""
    if not np.isfinite(own):
        return bool(np.isfinite(other))
    return bool(own - other > _WORTH * abs(own))


def _distinct(candidates: list[Candidate]) -> list[Candidate]:
    """Each policy once: an attempt without a gain returns the policy it began with."""
    return list(
        {
            (candidate.structure, id(candidate.policy)): candidate
            for candidate in candidates
        }.values()
    )


def _program(candidate: Candidate, method: str) -> tuple[Any, float]:
    """What a training compiles: the gradients of all dampings share a program, and so
    do evolutions of all standard deviations, and policies of one form."""
    rate = 0.0 if method == _EVOLUTION else candidate.rates.get(method, _RATE)
    return jax.tree.structure(candidate.policy), rate


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
        self.key, self.draws, self.budget = key, 0, Budget(budget)
        layout = "{desc}: {bar}| {n:.0f}/{total:.0f} s{postfix}"
        options: Any = dict(desc="synthesise", bar_format=layout, disable=not progress)
        self.bar = tqdm(total=round(budget), **options)
        zero = Zero(environment.control_size)
        unknown = np.full(CHOICE, np.inf)
        self.best = {"zero": Candidate("zero", "none", zero, unknown)}
        self.finalists: list[Candidate] = []
        self.tried: list[Attempt] = []
        self.ended = "interrupted"
        self.law: LQR | LQG | None = None
        name = "LQG" if is_hidden(environment) else "LQR"
        # The names of the policies that need no training.
        self.baselines = "zero", name
        lasting = min(environment.horizon, LONGEST) * float(environment.dt)
        unit = environment.dynamics.time_unit
        times = [lasting * share for share in _TIME_CONSTANTS]
        # From the name of a method to the time constant of its damped gradient.
        damped: dict[str, Any] = {f"gradient, {at:.2g} {unit}": at for at in times}
        self.methods = damped | {"gradient": jnp.inf, _EVOLUTION: None}
        # The least median cost so far, and the usual cost that belongs to it.
        self.least, self.usual = np.inf, _ANY
        # The programs of trainings that are compiled.
        self.compiled: set[tuple[Any, float]] = set()

    def may_begin(self, candidate: Candidate, method: str) -> bool:
        """Whether there is time to train a candidate with a method."""
        if _program(candidate, method) in self.compiled:
            return self.budget.may_train
        return self.budget.may_compile(method != _EVOLUTION)

    @property
    def choice_keys(self) -> Array:
        """Keys of the episodes for choosing a policy. The first `CHOICE` of them choose
        between the rounds of the training, too."""
        return jr.split(jr.fold_in(self.key, CHOICE), _ROUNDS * CHOICE)

    def fresh_key(self) -> PRNGKey:
        """A key that was not used before."""
        self.draws += 1
        return jr.fold_in(self.key, CHOICE + self.draws)

    def run(self, width: int, depth: int) -> None:
        """Train until the time is up or no method gains."""
        self.law = self.regulator()
        family, key = self.ranges is not None, self.fresh_key()
        made = structures(self.environment, self.law, family, width, depth, key)
        floor = [self.best["zero"].policy]
        if self.law is not None:
            # The first policy starts as the LQR.
            floor.append(next(iter(made.values())))
        for name, law in zip(self.baselines, floor, strict=False):
            began = self.budget.spent
            candidate = Candidate(name, "none", law, self.costs(law))
            self.enter(candidate)
            took = self.budget.spent - began
            self.tried.append(Attempt(name, "none", self.mean(candidate), took))
        self.warn_of_lost_starts()
        if not self.budget.may_train:
            warnings.warn(
                f"synthesise: a budget of {self.budget.total:g} s is too small for "
                "this plant, because its first programs took "
                f"{self.budget.spent:.0f} s to compile. Only one policy is trained.",
                stacklevel=3,
            )
        # Each policy is trained from the start by the gradient, with less and less
        # damping, and by evolution.
        gradients = [name for name in self.methods if name != _EVOLUTION]
        evolution = [name for name in self.methods if name == _EVOLUTION]
        first, last = list(made)[0], list(made)[-1]
        trials = [(first, gradients), (last, evolution)]
        # Evolution around the LQR is seldom the best, so the time may end before it.
        trials += [(last, gradients), (first, evolution)] if first != last else []
        if self.environment.dynamics.event_names:
            # The gradient does not show what another order of events would cost, and
            # its program compiles for twice as long.
            trials = [(last, evolution), (first, gradients), *trials[2:]]
        candidates, untrained = [], len(self.tried)
        for name, methods in trials:
            candidate = Candidate(name, "none", made[name], self.costs(made[name]))
            for method in methods:
                # However short the budget is, one policy is trained.
                if self.may_begin(candidate, method) or len(self.tried) == untrained:
                    own = self.mean(candidate)
                    candidate = self.attempt(candidate, method)
                    # If the gradient is zero, it is zero with less damping too.
                    if np.isfinite(own) and self.tried[-1].cost == own:
                        break
            candidates.append(candidate)
            if len(candidates) == _FIRST and self.is_settled():
                rival = "a plan" if self.is_known else "MPC"
                self.ended = f"the LQR was as good as {rival}"
                return
        self.refine(candidates)
        self.ended = "no training lowered the cost any more"
        if not self.budget.may_compile(differentiates=False):
            self.ended = "the time was over"

    def refine(self, candidates: list[Candidate]) -> None:
        """Train the best of the candidates, and the others if time is left."""
        share, dropped = _SHARE * self.budget.total, []
        while len(candidates) > 1:
            candidates = sorted(candidates, key=self.score)
            least = self.score(candidates[0])
            most = least + _CLOSE * abs(least)
            half = candidates[: len(candidates) // _FEWER]
            kept = [candidate for candidate in half if self.score(candidate) <= most]
            dropped += candidates[len(kept) :]
            candidates = kept
            if len(candidates) > 1:
                candidates = [
                    self.improve(candidate, share) for candidate in candidates
                ]
            share *= _FEWER
        for candidate in [*candidates, *sorted(dropped, key=self.score)]:
            self.improve(candidate)

    def warn_of_lost_starts(self) -> None:
        """Warn before the training if plants run away under all laws so far."""
        known = [candidate.costs for candidate in self.best.values()]
        lost = np.all(~np.isfinite(known), axis=0)
        if np.any(lost):
            laws = " and the ".join(["zero control", self.baselines[1]][: len(known)])
            warnings.warn(
                f"synthesise: the cost is not finite from {np.sum(lost)} of "
                f"{len(lost)} initial states under {laws}: the plant runs away, or the "
                "cost is not defined everywhere. If no control keeps the plant finite "
                "from there, no policy will: draw other initial states, or end the "
                "episode before (`terminated`).",
                stacklevel=4,
            )

    def regulator(self) -> LQR | LQG | None:
        """The LQR or LQG, or `None` if it does not exist for this environment."""
        key = self.fresh_key()
        try:
            if is_hidden(self.environment):
                return local_lqg(self.environment, key=key)
            return local_lqr(self.environment)
        except (ValueError, RuntimeError) as error:
            name, bounds = self.baselines[1], self.environment.control_bounds
            text = (
                f"synthesise: no {name} and no network around one is tried, because "
                f"there is no {name}: {error} If the plant can rest somewhere, define "
                "its `equilibrium`, or give the cost a target."
            )
            if bounds is None or not all(np.all(np.isfinite(end)) for end in bounds):
                text += (
                    f" Without an {name}, networks give a control without bounds only "
                    "values from -2 to 2 at first: set `control_bounds`."
                )
            warnings.warn(text, stacklevel=4)
            return None

    @property
    def is_known(self) -> bool:
        """Whether the disturbances are known, because there are none."""
        return isinstance(self.environment.disturbance, NoDisturbance)

    def is_settled(self) -> bool:
        """Whether the LQR is enough: neither the first two trials nor a plan is better.
        With disturbances MPC replaces the plan, because a plan would know them."""
        if self.chosen()[0] != "LQR":
            return False
        keys = self.choice_keys[: self.comparison_size]
        own = np.mean(self.best["LQR"].costs[: self.comparison_size])
        rival = "plan" if self.is_known else "MPC"
        if not self.budget.may_compare(rival, self.budget.spent):
            return False
        other = self.costs_of_rival(rival, self.best["LQR"].policy, keys)
        # A rival that fails proves nothing.
        if other is None or not np.all(np.isfinite([own, *other])):
            return False
        return not _is_better(np.mean(other), own)

    def costs_of_rival(self, name: str, policy: Any, keys: Array) -> np.ndarray | None:
        """The costs of MPC, or of a plan that starts from the controls of `policy`;
        `None` if the time does not suffice, or with a warning if it fails."""
        began, parts = self.budget.spent, []
        given = self.environment, self.ranges
        for start in range(0, len(keys), _TOGETHER):
            if self.budget.is_over:
                return None
            some = keys[start : start + _TOGETHER]
            try:
                costs = (
                    costs_of_mpc(*given, self.law, some)
                    if name == "MPC"
                    else costs_of_plan(*given, policy, some)
                )
            except (ValueError, RuntimeError) as error:
                # What is trained must not be lost for a comparison.
                text = f"synthesise: there is no comparison with {name}: {error}"
                warnings.warn(text, stacklevel=4)
                return None
            parts.append(np.asarray(costs, float))
            self.show()
        # The next comparison may take as long.
        self.budget.add_step(self.budget.spent - began, differentiates=True)
        return np.concatenate(parts)

    def trained(self, candidate: Candidate, method: str) -> AbstractController:
        """The policy of a candidate after one round of training with a method."""
        ends = None

        def is_over(*_: Any) -> bool:
            nonlocal ends
            self.show()
            # The first block compiles.
            now = self.budget.spent
            ends = now + _ROUND * self.budget.total if ends is None else ends
            return not self.budget.may_train or now > ends

        given = self.environment, self.ranges, candidate.policy
        options: Any = dict(key=self.fresh_key(), callbacks=(is_over,))
        rate = candidate.rates.get(method, _RATE)
        if method != _EVOLUTION:
            return by_gradient(*given, self.methods[method], rate, **options)
        width = _WIDE if candidate.structure == "network" else _NARROW
        sigma = (width if candidate.method == "none" else _NEAR) * rate / _RATE
        return by_evolution(*given, sigma, self.usual, **options)

    def improve(self, candidate: Candidate, seconds: float = np.inf) -> Candidate:
        """The candidate after some seconds of training, or when no method gains.

        Each attempt uses the method with the largest gain in its last attempt at this
        rate. A method that was not tried at its rate comes before.
        """
        ends = self.budget.spent + seconds
        # The method of the last gain comes first, then evolution, then the gradients,
        # those with less damping before the others.
        names = sorted(
            reversed(self.methods), key=lambda name: name != candidate.method
        )
        gains = dict.fromkeys(names, np.inf)
        while self.budget.may_train and self.budget.spent < ends:
            left = [n for n in names if candidate.rates.get(n, _RATE) > _LEAST_RATE]
            left = [name for name in left if self.may_begin(candidate, name)]
            if not left:
                break
            method = max(left, key=lambda name: gains[name])
            before, candidate = candidate, self.attempt(candidate, method)
            gain = self.gain(before, candidate)
            gains[method] = gain if gain > _GAIN else np.inf
        return candidate

    def gain(self, before: Candidate, after: Candidate) -> float:
        """How much the score fell, relative to its size."""
        own = self.score(after)
        return (self.score(before) - own) / max(abs(own), 1e-12)

    def attempt(self, candidate: Candidate, method: str) -> Candidate:
        """The candidate after some rounds of a method, or as it was if none helps."""
        began, best, ends, least = self.budget.spent, candidate, 0.0, np.inf
        while not ends or self.budget.spent < ends:
            policy = self.trained(best, method)
            costs = self.costs(policy)
            after = best._replace(method=method, policy=policy, costs=costs)
            if not ends:
                # The first round compiles.
                took = self.budget.spent - began
                self.budget.add_step(took, method != _EVOLUTION)
                self.compiled.add(_program(candidate, method))
                ends = self.budget.spent + _ATTEMPT * self.budget.total
            least = min(least, self.mean(after))
            # If a round changes nothing, it diverged at its first step.
            stays = self.score(after) == self.score(best)
            best = min(after, best, key=self.score)
            self.keep(best)
            if stays or not self.budget.may_train:
                break
        took = self.budget.spent - began
        self.tried.append(Attempt(candidate.structure, method, least, took))
        self.enter(best)
        self.show()
        if self.gain(candidate, best) <= _GAIN:
            slower = candidate.rates.get(method, _RATE) * _SLOWER
            best = best._replace(rates=candidate.rates | {method: slower})
        return best

    def show(self) -> None:
        """Update the bar."""
        least, left = min(self.best.values(), key=self.mean), self.budget.left
        shown = f"{left:.0f} s left, cost {self.mean(least):.5g}, {least.structure}"
        self.bar.set_postfix_str(shown, refresh=False)
        self.bar.update(min(self.budget.spent, self.bar.total) - self.bar.n)

    def costs(self, policy: AbstractController, keys: Any = None) -> np.ndarray:
        """The costs of a policy, by default in the episodes for choosing a policy."""
        keys = self.choice_keys[:CHOICE] if keys is None else keys
        return np.asarray(costs_of(self.environment, self.ranges, policy, keys), float)

    def keep(self, candidate: Candidate) -> None:
        """Keep the candidate if it is the best of its structure."""
        other = self.best.get(candidate.structure, candidate)
        self.best[candidate.structure] = min(other, candidate, key=self.score)

    def enter(self, candidate: Candidate) -> None:
        """Keep the candidate if it is among the best, and update the usual cost."""
        self.keep(candidate)
        if candidate.structure not in self.baselines:
            candidates = _distinct([*self.finalists, candidate])
            self.finalists = sorted(candidates, key=self.score)[:_LAST]
        costs = self.best[candidate.structure].costs
        known = np.where(np.isfinite(costs), costs, np.inf)
        low, middle, high = np.quantile(known, [0.25, 0.5, 0.75], method="lower")
        # The least is taken with its sign, so a large reward, which is a negative cost,
        # gives a large usual cost. If the median is near zero, which is arbitrary if
        # the cost has a constant, the spread of the costs counts.
        usual = max(abs(middle), high - low if np.isfinite(high) else 0.0)
        if usual != 0 and middle < self.least:
            self.least, self.usual = float(middle), float(usual)

    def score(self, candidate: Candidate) -> float:
        """The mean tamed cost, the criterion for choosing policies."""
        return float(jnp.mean(tamed(jnp.asarray(candidate.costs), self.usual)))

    def mean(self, candidate: Candidate) -> float:
        """The mean cost, or infinity if the cost of an episode is not finite."""
        return float(
            np.mean(np.where(np.isfinite(candidate.costs), candidate.costs, np.inf))
        )

    def choose(self) -> None:
        """Prepare the final choice among the best policies, zero control and the LQR:
        compare them on more initial states.

        Good policies often differ only in a rare episode in which the plant runs away,
        and the first 64 initial states may have none.
        """
        candidates = _distinct([*self.finalists, *self.best.values()])
        ends = self.budget.choice_ends
        for k in range(1, _ROUNDS):
            if self.budget.spent > ends:
                break
            some = self.choice_keys[k * CHOICE : (k + 1) * CHOICE]
            more = [self.costs(candidate.policy, some) for candidate in candidates]
            self.show()
            candidates = [
                candidate._replace(costs=np.concatenate([candidate.costs, costs]))
                for candidate, costs in zip(candidates, more, strict=True)
            ]
        # Only these were compared on all initial states.
        best: dict[str, Candidate] = {}
        for candidate in sorted(candidates, key=self.score):
            best.setdefault(candidate.structure, candidate)
        self.best = best

    def chosen(self) -> tuple[str, AbstractController]:
        """The best policy, or zero control or the LQR if they are about as good."""
        best = min(self.best.values(), key=self.score)
        least = self.score(best)
        for name in self.baselines:
            simple = self.best.get(name, best)
            if self.score(simple) - least <= _WORTH * abs(least):
                best = simple
                break
        return best.structure, best.policy

    @property
    def comparison_size(self) -> int:
        """The number of episodes in the comparison."""
        return _COMPARISON if self.ranges is None else _PLANTS

    @property
    def comparison_keys(self) -> Array:
        """The keys of the comparison: as many as for a choice, because policies run
        them in the same compiled program. Only the first `comparison_size` are used."""
        return jr.split(jr.fold_in(self.key, self.comparison_size), CHOICE)

    def plants(self) -> dict[str, np.ndarray]:
        """The parameters drawn for the plants of the comparison, by path."""
        ranges, keys = self.ranges or {}, self.comparison_keys[: self.comparison_size]
        of = lambda plant, key: {path: get_path(plant, path) for path in ranges}
        drawn = on_plants(self.environment, ranges, keys, of)
        return {path: np.asarray(values) for path, values in drawn.items()}

    def compare(self, policy: AbstractController) -> Iterator[tuple[str, np.ndarray]]:
        """The costs of the policy and of other controllers, one after the other, in
        episodes that were used for nothing else."""
        floor = {n: self.best[n].policy for n in self.baselines if n in self.best}
        laws = {"policy": policy, **floor}
        for name, law in laws.items():
            yield name, self.costs(law, self.comparison_keys)[: self.comparison_size]
        # MPC plans from the state.
        for name in ("plan",) if is_hidden(self.environment) else ("MPC", "plan"):
            if self.budget.may_compare(name, self.budget.spent):
                keys = self.comparison_keys[: self.comparison_size]
                costs = self.costs_of_rival(name, policy, keys)
                if costs is not None:
                    yield name, costs
