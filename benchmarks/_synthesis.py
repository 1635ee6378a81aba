"""Every named task by `training.synthesise`: the part `tasks` of `benchmarks.policies`.

Each task and seed is a process of its own, so that its seconds have all compilation in
them. What is stored already is not run again.
"""

import json
import os
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from benchmarks._machine import describe


STORE = Path(__file__).parent / "results" / "synthesis.jsonl"
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
    # With all cores, as a user has; the benchmark itself may be on one.
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, range(os.cpu_count() or 1))
    import jax

    from delucax.studies._scoreboard import costs_of, task_of
    from delucax.training import synthesise

    found = synthesise(task_of(task), key=jax.random.key(seed), progress=False)
    seconds = time.perf_counter() - began
    costs = {name: cost.tolist() for name, cost in found.costs.items()}
    tried = [attempt._asdict() for attempt in found.tried]
    about = {"task": task, "seed": seed, "structure": found.structure}
    about["scoreboard"] = costs_of(task, found.policy)
    return about | {"seconds": seconds, "costs": costs, "tried": tried}


def run(only: list[str], seeds: int) -> list[dict[str, Any]]:
    """The cases, those that are missing run first."""
    rows = [json.loads(line) for line in STORE.open()] if STORE.exists() else []
    known = {(row["task"], row["seed"]) for row in rows}
    # A seed of every task before the next, so that a run that is cut off shows all.
    for seed in range(seeds):
        for task in only or names():
            if (task, seed) in known:
                continue
            command = [sys.executable, "-m", "benchmarks._synthesis", task, str(seed)]
            done = subprocess.run(command, capture_output=True, text=True, check=False)
            if done.returncode:
                print(f"  {task}, {seed}: {done.stderr.strip().splitlines()[-1]}")
                continue
            row = json.loads(done.stdout) | {"machine": describe()}
            rows.append(row)
            with STORE.open("a") as file:
                file.write(json.dumps(row) + "\n")
            print(f"  {task}, {seed}: {row['structure']}, {regret(row):+.1%} ", end="")
            print(f"in {row['seconds']:.0f} s", flush=True)
    return [row for row in rows if not only or row["task"] in only]


def regret(row: dict[str, Any], of: str = "policy") -> float:
    """How much more a controller costs than the best known of each start, relative to
    that."""
    costs = {name: np.array(cost, float) for name, cost in row["costs"].items()}
    finite = [np.where(np.isfinite(cost), cost, np.inf) for cost in costs.values()]
    best = np.mean(np.min(finite, axis=0))
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
    print(json.dumps(case(sys.argv[1], int(sys.argv[2]))))
