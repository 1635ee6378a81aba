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
WITHIN = {"usual": 0.05, "events": 0.05, "hard": 0.1}
"""How far from the best known the median seed may be."""
FLOOR = ("zero", "LQR", "LQG")
"""What needs no training."""
AS_GOOD = 5e-3
"""How far above the floor still counts as no worse."""
SECONDS = 90.0


def names() -> list[str]:
    """Each task once."""
    from delucax.environments import registered

    return [name for name in registered() if "/" not in name]


def hard() -> list[str]:
    """The harder tasks."""
    from delucax.environments._registry import TASKS

    return TASKS["_hard"].split()


def case(task: str, seed: int) -> dict[str, Any]:
    """The policy of one task and seed, in this process: its costs on starts of its own
    beside those of others, and on the starts of the scoreboard."""
    began = time.perf_counter()
    import jax

    from delucax.studies._scoreboard import costs_of, task_of
    from delucax.training import synthesise

    made = synthesise(task_of(task), key=jax.random.key(seed), progress=False)
    seconds = time.perf_counter() - began
    costs = {name: cost.tolist() for name, cost in made.costs.items()}
    tried = [attempt._asdict() for attempt in made.tried]
    about = {"structure": made.structure, "seconds": seconds}
    about["scoreboard"] = costs_of(task, made.policy)
    return about | {"costs": costs, "tried": tried}


def run(only: list[str], seeds: int, **how: Any) -> list[dict[str, Any]]:
    """The cases, those that are missing run first."""
    # A seed of every task before the next, so that a run that is cut off shows all.
    cases = [
        {"task": task, "seed": seed}
        for seed in range(seeds)
        for task in only or names()
    ]

    def said(row):
        return f"{row['structure']}, {regret(row):+.1%} in {row['seconds']:.0f} s"

    return _cases.run("benchmarks._synthesis", STORE, cases, said, **how)


def regret(row: dict[str, Any], of: str = "policy") -> float:
    """How much more a controller costs than the best known of each start, relative to
    that. Where there are disturbances, which a plan knows beforehand, than the best
    controller."""
    from delucax.studies._scoreboard import is_disturbed

    each = {name: np.array(cost, float) for name, cost in row["costs"].items()}
    costs = {n: np.where(np.isfinite(c), c, np.inf) for n, c in each.items()}
    if is_disturbed(row["task"]):
        rivals = [c for name, c in costs.items() if not name.startswith("plan")]
        best = min(map(np.mean, rivals))
    else:
        best = np.mean(np.min(list(costs.values()), axis=0))
    return float((np.mean(costs[of]) - best) / abs(best))


def is_compared(row: dict[str, Any]) -> bool:
    """Whether there was time for MPC or a plan beside the policy."""
    return not {"MPC", "plan"}.isdisjoint(row["costs"])


def table(rows: list[dict[str, Any]]) -> pd.DataFrame:
    """A row for each task: what its seeds reach, on starts of their own, and, as
    `beside all`, on those of the scoreboard beside everything that ran there. The
    latter is a score, and `costs more` the same as a share of the best known cost."""
    from benchmarks.scoreboard import stored

    board, made = stored(), []
    for task, group in pd.DataFrame(rows).groupby("task"):
        seeds = group.to_dict("records")
        own = [regret(row) if is_compared(row) else np.nan for row in seeds]
        names = [n for n in FLOOR if all(n in row["costs"] for row in seeds)]
        floor = np.array([[regret(row, name) for row in seeds] for name in names])
        cost, best = board.cost(str(task), "synthesise"), board.best(str(task))
        made.append(
            {
                "task": task,
                "kind": kind(str(task)),
                "seeds": len(group),
                "policy": ", ".join(group["structure"].value_counts().index),
                "above best": np.nanmedian(own) if np.any(np.isfinite(own)) else None,
                "worst seed": np.nanmax(own) if np.any(np.isfinite(own)) else None,
                "beside all": board.excess(str(task), "synthesise"),
                "costs more": cost and (cost.middle - best) / abs(best),
                "floor": np.min(np.median(floor, axis=1)),
                "worst beside floor": np.max(
                    [regret(row) for row in seeds] - np.min(floor, axis=0)
                ),
                "seconds": group["seconds"].max(),
            }
        )
    return pd.DataFrame(made).sort_values(["kind", "task"])


def kind(task: str) -> str:
    """`hard`, `events` or `usual`."""
    from delucax.studies._scoreboard import task_of

    if task in hard():
        return "hard"
    return "events" if task_of(task).dynamics.event_names else "usual"


def tasks(only: list[str], seeds: int = SEEDS, **how: Any) -> dict[str, Any]:
    """Run what is missing, and print what all reach."""
    reached = table(run(only, seeds, **how))
    print(reached.to_string(index=False, float_format="%.3g"))
    summary = []
    for name, group in reached.groupby("kind"):
        within = WITHIN[str(name)]
        near, beside = (group[c] <= within for c in ("above best", "beside all"))
        simple = near & (group["floor"] <= within)
        counts = {"tasks": len(group), "near": near.sum(), "by LQR": simple.sum()}
        counts["compared"] = group["above best"].notna().sum()
        counts["near beside all"] = beside.sum()
        counts["cost near beside all"] = (group["costs more"] <= within).sum()
        summary.append({"kind": name} | {k: int(v) for k, v in counts.items()})
        print(f"{name}: {near.sum()} of {len(group)} within {within:.0%}", end="")
        print(f", {beside.sum()} beside all that ran on the scoreboard", end="")
        print(f"; on {simple.sum()} of them LQR, LQG or no control alone is as near")
    worse = reached["worst beside floor"] > AS_GOOD
    slow = reached["seconds"] > SECONDS
    print(f"a seed is worse than the floor on: {', '.join(reached[worse].task) or '-'}")
    print(f"above {SECONDS:g} s: {', '.join(reached[slow].task) or '-'}")
    about = {"none is worse than the floor": bool(not worse.any()), "summary": summary}
    return about | {"rows": reached.to_dict("records")}


if __name__ == "__main__":
    _cases.answer(case)
