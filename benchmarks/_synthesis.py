"""Every named task by `training.synthesise`: the part `tasks` of `benchmarks.policies`.

Each task and seed is a process of its own, so that its seconds have all compilation in
them. What is stored already is not run again.
"""

import time
from typing import Any

import numpy as np
import pandas as pd

from benchmarks import _cases


STORE = _cases.RESULTS / "synthesis.jsonl"
SEEDS = 5
WITHIN = 0.05
"""How far from the best known a policy may be."""
SECONDS = 90.0


def names() -> list[str]:
    """Each task once."""
    from delucax.environments import registered

    return [name for name in registered() if "/" not in name]


def case(task: str, seed: int) -> dict[str, Any]:
    """The policy of one task and seed, in this process: its costs on starts of its own
    beside those of others, and on the starts of the scoreboard."""
    began = time.perf_counter()
    import jax

    from delucax.studies._scoreboard import costs_of, task_of
    from delucax.training import synthesise

    found = synthesise(task_of(task), key=jax.random.key(seed), progress=False)
    seconds = time.perf_counter() - began
    costs = {name: cost.tolist() for name, cost in found.costs.items()}
    tried = [attempt._asdict() for attempt in found.tried]
    about = {"structure": found.structure, "seconds": seconds}
    about["scoreboard"] = costs_of(task, found.policy)
    return about | {"costs": costs, "tried": tried}


def run(only: list[str], seeds: int) -> list[dict[str, Any]]:
    """The cases, those that are missing run first."""
    # A seed of every task before the next, so that a run that is cut off shows all.
    cases = [
        {"task": task, "seed": seed}
        for seed in range(seeds)
        for task in only or names()
    ]

    def said(row):
        return f"{row['structure']}, {regret(row):+.1%} in {row['seconds']:.0f} s"

    return _cases.run("benchmarks._synthesis", STORE, cases, said)


def regret(row: dict[str, Any], of: str = "policy") -> float:
    """How much more a controller costs than the best known of each start, relative to
    that. Where there are disturbances, which a plan knows beforehand, than the best
    controller."""
    from delucax.studies._scoreboard import is_disturbed

    costs = {name: np.array(cost, float) for name, cost in row["costs"].items()}
    finite = {n: np.where(np.isfinite(c), c, np.inf) for n, c in costs.items()}
    if is_disturbed(row["task"]):
        best = min(np.mean(cost) for name, cost in finite.items() if name != "plan")
    else:
        best = np.mean(np.min(list(finite.values()), axis=0))
    return float((np.mean(costs[of]) - best) / abs(best))


def table(rows: list[dict[str, Any]]) -> pd.DataFrame:
    """A row for each task: what its seeds reach."""
    made = []
    for task, group in pd.DataFrame(rows).groupby("task"):
        own = [regret(row) for row in group.to_dict("records")]
        floor = min(
            np.median([regret(row, name) for row in group.to_dict("records")])
            for name in ("zero", "LQR")
            if name in group.iloc[0]["costs"]
        )
        structures = group["structure"].value_counts()
        made.append(
            {
                "task": task,
                "seeds": len(group),
                "policy": ", ".join(structures.index),
                "above best": np.median(own),
                "worst seed": max(own),
                "floor": floor,
                "seconds": group["seconds"].max(),
            }
        )
    return pd.DataFrame(made)


def tasks(only: list[str], seeds: int = SEEDS) -> list[dict[str, Any]]:
    """Run what is missing, and print what all reach."""
    found = table(run(only, seeds))
    print(found.to_string(index=False, float_format="%.3g"))
    near = int(np.sum(found["above best"] <= WITHIN))
    simple = int(np.sum(found["policy"].isin(["LQR", "zero"])))
    slow = int(np.sum(found["seconds"] > SECONDS))
    print(
        f"within {WITHIN:.0%}: {near} of {len(found)}, {simple} by LQR alone; ", end=""
    )
    print(f"{slow} above {SECONDS:g} s")
    return found.to_dict("records")


if __name__ == "__main__":
    _cases.answer(case)
