"""What each method of the scoreboard costs, and how far that is above the best known.

A method is compared on each task by its excess, in units of the lesser of two costs:
that of the best known, and what the best known saves against zero control. The unit is
at least a hundredth of the former.
"""

import dataclasses
import functools
import json
from collections.abc import Iterable
from typing import Any, NamedTuple

import numpy as np

from delucax.experiments import Results
from delucax.lung import BreathCost
from delucax.studies._scoreboard import FAMILIES, is_disturbed, task_of


PLAN, OWN = "plan", "synthesise"
COLUMNS = {name: tuple(family) for name, family in FAMILIES.items()}
COLUMNS["Training"] += (OWN,)
METHODS = tuple(method for family in COLUMNS.values() for method in family)
"""The methods that have a score: all but the plan, which is no controller."""
NEAR, GROUPS = 0.05, ("LQR within 5%", "LQR farther, or none", "events", "lungs")
# The least unit, as a share of the cost of the best known. At a share from which on the
# saving counts at all, the scores would jump.
_LEAST = 0.01


class Spread(NamedTuple):
    """A cost: the middle one of several trainings, the least and the most."""

    middle: float
    low: float
    high: float
    count: int


@dataclasses.dataclass(frozen=True)
class Board:
    """The costs by task and method, each of shape `(trainings, starts)`; and
    microseconds a step.

    **Arguments:**

    - `costs`, `speeds`: by task and method; without what does not suit.
    - `disturbed`: the tasks with disturbances, which a plan knows and no controller.
    """

    costs: dict[tuple[str, str], np.ndarray]
    speeds: dict[tuple[str, str], float]
    disturbed: frozenset[str] = frozenset()

    @functools.cached_property
    def tasks(self) -> dict[str, list[str]]:
        """The tasks that were run, in the groups of the page."""
        groups: dict[str, list[str]] = {name: [] for name in GROUPS}
        for task in sorted({task for task, method in self.costs if method == "zero"}):
            groups[self._group(task)].append(task)
        return {name: tasks for name, tasks in groups.items() if tasks}

    @property
    def names(self) -> list[str]:
        """The tasks in the order of the page."""
        return [task for tasks in self.tasks.values() for task in tasks]

    def _group(self, task: str) -> str:
        env = task_of(task)
        if isinstance(env.cost, BreathCost):
            return GROUPS[3]
        if env.dynamics.event_names:
            return GROUPS[2]
        excess = self.excess(task, "LQR")
        return GROUPS[0] if excess is not None and excess <= NEAR else GROUPS[1]

    @functools.cached_property
    def methods(self) -> tuple[str, ...]:
        """Those that were run."""
        ran = {method for _, method in self.costs}
        return tuple(method for method in METHODS if method in ran)

    def cost(self, task: str, method: str) -> Spread | None:
        """The cost of a method, if it suits."""
        costs = self.costs.get((task, method))
        if costs is None:
            return None
        each = [float(np.mean(row)) for row in costs]
        return Spread(float(np.median(each)), min(each), max(each), len(each))

    def best(self, task: str) -> float:
        """The least cost of each start over all that was run; with disturbances that
        of the best single controller, as the least of several draws is luck."""
        ran = [c for (name, m), c in self.costs.items() if name == task and m != PLAN]
        if task in self.disturbed:
            return min(float(np.mean(row)) for costs in ran for row in costs)
        if (task, PLAN) in self.costs:
            ran.append(self.costs[task, PLAN])
        return float(np.mean(np.min(np.concatenate(ran), axis=0)))

    def trainings(self, task: str, method: str) -> int:
        """How many trainings were run."""
        return len(self.costs.get((task, method), ()))

    def excess(self, task: str, method: str) -> float | None:
        """How much more a method costs than the best known: 0 is the best known, 0.03
        is 3% more, infinite diverges. `None` if it does not suit."""
        cost = self.cost(task, method)
        return None if cost is None else self.above(task, cost.middle)

    def above(self, task: str, cost: float) -> float:
        """The excess of a cost."""
        best = self.best(task)
        if not np.isfinite(cost):
            return np.inf
        if cost == best:
            return 0.0
        saved = self.cost_of_zero(task) - best
        size = abs(best) or saved
        unit = min(size, max(saved, _LEAST * size))
        return (cost - best) / unit if unit else np.inf

    def cost_of_zero(self, task: str) -> float:
        """The cost of no control."""
        cost = self.cost(task, "zero")
        assert cost is not None
        return cost.middle

    def ranked(self, task: str) -> list[tuple[float, str]]:
        """The controllers that suit from the best on, the simplest first where they
        are as good, to a tenth of a percent."""
        each = [(self.excess(task, m), k, m) for k, m in enumerate(self.methods)]
        order = sorted((round(e, 3), k, m) for e, k, m in each if e is not None)
        return [(excess, method) for excess, _, method in order]


def board_of(results: Results, synthesised: Iterable[str] = ()) -> Board:
    """The board of what is stored.

    **Arguments:**

    - `results`: of the scoreboard.
    - `synthesised`: the lines of `results/synthesis.jsonl`; none by default.
    """
    cases: dict[tuple[str, str], list[dict[str, Any]]] = {}
    for row in results.rows:
        if row["method"] in (*METHODS, PLAN):
            cases.setdefault((row["task"], row["method"]), []).append(row)
    costs, speeds = {}, {}
    for place, rows in cases.items():
        # A case that failed has no cost, and one that does not suit none either.
        starts = [row.get("trainings") or [row.get("cost")] for row in rows]
        if any(None in trainings for trainings in starts):
            continue
        costs[place] = np.array(starts, float).T
        times = [row["us_per_step"] for row in rows if row["us_per_step"]]
        if times:
            speeds[place] = float(np.median(times))
    own: dict[str, list[list[float]]] = {}
    for row in map(json.loads, synthesised):
        if "scoreboard" in row:
            own.setdefault(row["task"], []).append(row["scoreboard"])
    for task, seeds in own.items():
        costs[task, OWN] = np.array(seeds, float)
    costs = {place: np.where(np.isfinite(c), c, np.inf) for place, c in costs.items()}
    ran = {task for task, method in costs if method == "zero"}
    return Board(costs, speeds, frozenset(filter(is_disturbed, ran)))
