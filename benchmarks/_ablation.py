"""What each part of `training.synthesise` brings: the part `ablation` of
`benchmarks.policies`.

The same search within 40 s, without one of its parts, on tasks of each kind. `gradient
alone` is what one writes without it: a network, trained by the gradient of the rollout.
"""

import time
from typing import Any

import jax
import numpy as np
import pandas as pd

from benchmarks import _cases
from benchmarks._synthesis import regret


STORE = _cases.RESULTS / "ablation.jsonl"
SEEDS, BUDGET = 3, 40.0
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
    "no LQR inside",
    "no damping",
    "no evolution",
    "gradient alone",
)


def case(task: str, without: str, seed: int, budget: float) -> dict[str, Any]:
    """The policy of one task and seed without a part of the search."""
    began = time.perf_counter()
    from delucax.studies._scoreboard import task_of
    from delucax.training._policy_search import PolicySearch

    alone = without == "gradient alone"

    class Reduced(PolicySearch):
        def regulator(self):
            return None if alone or without == "no LQR inside" else super().regulator()

    key = jax.random.key(seed)
    search = Reduced(task_of(task), None, key, budget=budget, progress=False)
    dropped = {
        "no damping": lambda name: name.startswith("gradient,"),
        "no evolution": lambda name: name == "evolution",
        "gradient alone": lambda name: name != "gradient",
    }.get(without, lambda name: False)
    search.methods = {n: m for n, m in search.methods.items() if not dropped(n)}
    search.run(width=32, depth=1)
    search.choose()
    structure, policy = search.chosen()
    costs = {n: cost.tolist() for n, cost in search.compared(policy)}
    seconds = time.perf_counter() - began
    tried = [attempt._asdict() for attempt in search.tried]
    about = {"structure": structure, "seconds": seconds}
    return about | {"costs": costs, "tried": tried}


def ablation(only: list[str], seeds: int = SEEDS, **how: Any) -> dict[str, Any]:
    """Run what is missing; a row for each task, a column for each part left out."""
    cases = [
        {"task": task, "without": without, "seed": seed, "budget": BUDGET}
        for seed in range(seeds)
        for task in only or TASKS
        for without in WITHOUT
    ]

    def said(row):
        return f"{row['structure']}, {np.mean(row['costs']['policy']):.5g}"

    rows = _cases.run("benchmarks._ablation", STORE, cases, said, **how)
    table = pd.DataFrame(_above_best(rows))
    table = table.pivot_table("above", "task", "without", aggfunc="median")
    table = table[[name for name in WITHOUT if name in table]]
    print("Above the best known of each start, median of the seeds")
    print(table.to_string(float_format="{:+.1%}".format))
    return {"seeds": seeds, "rows": table.reset_index().to_dict("records")}


def _above_best(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """How far each is above the best of all searches with its seed."""
    made = []
    for row in rows:
        same = [r for r in rows if (r["task"], r["seed"]) == (row["task"], row["seed"])]
        costs = {f"{n}, {r['without']}": c for r in same for n, c in r["costs"].items()}
        costs["policy"] = row["costs"]["policy"]
        made.append(row | {"above": regret(row | {"costs": costs})})
    return made


if __name__ == "__main__":
    _cases.answer(case)
