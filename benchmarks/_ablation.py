"""What each part of `training.synthesise` brings: the part `ablation` of
`benchmarks.policies`.

The same search without one of its parts, on tasks of each kind. `gradient alone` is a
network alone, trained by the undamped gradient of the rollout. `no LQR` is without the
LQR altogether: in the policies, among what may be returned, and in the scale of the
controls. `no clipping` takes the mean gradient of a batch. `no last choice` returns the
best on the starts of the training. No search ends because the LQR is as good as a plan.

How much of the budget compilation takes depends on the machine. So the seeds of a
search share a process, whose first search only compiles, and of the budget of each
`COMPILATION` counts as spent.
"""

from itertools import islice
from typing import Any
from unittest import mock

import equinox as eqx
import jax
import numpy as np
import pandas as pd

from benchmarks import _cases
from benchmarks._synthesis import regret


STORE = _cases.RESULTS / "ablation.jsonl"
SEEDS, BUDGET, COMPILATION = 2, 75.0, 25.0
_ENOUGH = 600.0
"""The budget of the search that only compiles."""
TASKS = (
    "acrobot",
    "cartpole_swing_up",
    "furuta",
    "learned_lung",
    "mountain_car",
    "pendulum",
    "quadrotor",
    "slung_load",
)
ALL = "all of it"
WITHOUT = (
    ALL,
    "no LQR",
    "no damping",
    "no clipping",
    "no evolution",
    "no last choice",
    "gradient alone",
)
SEVERAL = 2
"""Seeds from which on their range is shown."""


class MeanGradient(eqx.Module):
    """The mean of several gradients, none of which is clipped."""

    samples: int = eqx.field(static=True)

    def __call__(self, loss: Any, model: Any, key: Any) -> Any:
        from delucax.training import analytic

        keys = jax.random.split(key, self.samples)
        each = jax.vmap(lambda key: analytic(loss, model, key))(keys)
        return jax.tree.map(lambda leaf: jax.numpy.mean(leaf, axis=0), each)


def case(task: str, without: str, seeds: int, budget: float) -> dict[str, Any]:
    """The policies of one task, from searches without a part."""
    from delucax.studies._scoreboard import task_of
    from delucax.training._synthesis import _rounds

    environment = task_of(task)
    unclipped = without == "no clipping"
    estimator = MeanGradient if unclipped else _rounds.ClippedSamples
    with mock.patch.object(_rounds, "ClippedSamples", estimator):
        compile_all(environment, without)
        made = [searched(environment, without, seed, budget) for seed in range(seeds)]
    return {"searches": made}


def reduced(environment: Any, without: str, seed: int, budget: float) -> Any:
    """The search without a part."""
    from delucax.training._synthesis._policy_search import PolicySearch

    alone = without == "gradient alone"

    class Reduced(PolicySearch):
        def regulator(self):
            if alone or without == "no LQR":
                # So that the networks start with the same weights.
                self.fresh_key()
                return None
            return super().regulator()

        def is_settled(self):
            return False

    key = jax.random.key(seed)
    search = Reduced(environment, None, key, budget=budget, progress=False)
    dropped = {
        "no damping": lambda name: name.startswith("gradient,"),
        "no evolution": lambda name: name == "evolution",
        "gradient alone": lambda name: name != "gradient",
    }.get(without, lambda name: False)
    search.methods = {n: m for n, m in search.methods.items() if not dropped(n)}
    return search


def compile_all(environment: Any, without: str) -> None:
    """One block of each training, so that the programs are compiled."""
    from delucax.training._synthesis import _policy_search as module

    search = reduced(environment, without, 2**20, _ENOUGH)
    search.refine = lambda lines: None
    with mock.patch.multiple(module, _ROUND=0.0, _ATTEMPT=0.0):
        search.run(width=32, depth=1)


def searched(
    environment: Any, without: str, seed: int, budget: float
) -> dict[str, Any]:
    """What one search finds."""
    search = reduced(environment, without, seed, budget)
    search.budget.began -= min(COMPILATION, budget)
    search.run(width=32, depth=1)
    if without != "no last choice":
        search.choose()
    structure, policy = search.chosen()
    # After the policy and the laws without a training come MPC and the plan.
    first = 1 + sum(name in search.best for name in search.baselines)
    compared = islice(search.compare(policy), first)
    costs = {n: cost.tolist() for n, cost in compared}
    tried = [attempt._asdict() for attempt in search.tried]
    about = {"seed": seed, "structure": structure, "seconds": search.budget.spent}
    return about | {"costs": costs, "tried": tried}


def ablation(only: list[str], seeds: int = SEEDS, **how: Any) -> dict[str, Any]:
    """Run what is missing; a row for each task, a column for each part left out, and
    with several seeds their range beside it."""
    cases = [
        {"task": task, "without": without, "seeds": seeds, "budget": BUDGET}
        for task in only or TASKS
        for without in WITHOUT
    ]

    def said(row):
        each = [np.mean(made["costs"]["policy"]) for made in row["searches"]]
        return ", ".join(f"{cost:.5g}" for cost in each)

    rows = _cases.run("benchmarks._ablation", STORE, cases, said, **how)
    made = summary(rows)
    print("Above the best known of each start, median of the seeds (range)")
    shown = [
        {"task": row["task"]} | {n: cell(row, n) for n in WITHOUT if n in row}
        for row in made
    ]
    print(pd.DataFrame(shown).to_string(index=False))
    return {"seeds": seeds, "rows": made}


def summary(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """A row for each task: the median of each search, and its least and most."""
    made: dict[str, dict[str, Any]] = {}
    for (task, name), group in pd.DataFrame(_above_best(rows)).groupby(
        ["task", "without"]
    ):
        above = group["above"].to_list()
        row = made.setdefault(str(task), {"task": task})
        row[str(name)] = float(np.median(above))
        if len(above) >= SEVERAL:
            row |= {f"{name}, least": min(above), f"{name}, most": max(above)}
    return list(made.values())


def cell(row: dict[str, Any], name: str, show: Any = "{:+.1%}".format) -> str:
    """The median, and the range if there is one."""
    if f"{name}, least" not in row:
        return show(row[name])
    low, high = (show(row[f"{name}, {end}"]) for end in ("least", "most"))
    return f"{show(row[name])} ({low} to {high})"


def _above_best(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """How far each is above the best of all searches with its seed."""
    rows = [row | made for row in rows for made in row["searches"]]
    made = []
    for row in rows:
        same = [r for r in rows if (r["task"], r["seed"]) == (row["task"], row["seed"])]
        costs = {f"{n}, {r['without']}": c for r in same for n, c in r["costs"].items()}
        costs["policy"] = row["costs"]["policy"]
        made.append(row | {"above": regret(row | {"costs": costs})})
    return made


if __name__ == "__main__":
    _cases.answer(case)
