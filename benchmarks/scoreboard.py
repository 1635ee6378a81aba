"""Every task crossed with every controller that suits it.

`python -m benchmarks.scoreboard` runs what is missing or changed, writes
`results/scoreboard.jsonl`, and puts the tables into `docs/scoreboard.md`; with
`--table` it only does the latter, with `--fresh` it runs all.
"""

import argparse
import sys
import time
from pathlib import Path
from typing import Any

import jax
import numpy as np

import delucax as dlx
from benchmarks._machine import describe
from delucax import experiments
from delucax.experiments import interquartile_mean, Results
from delucax.experiments._scoreboard import METHODS, scoreboard, task_of, tasks


STORE = Path(__file__).parent / "results" / "scoreboard.jsonl"
PAGE = Path(__file__).parents[1] / "docs" / "scoreboard.md"
BEGIN, END = "<!-- scoreboard -->\n", "<!-- end of scoreboard -->"


def floor_of(task: str) -> str:
    """Zero control, or LQR where the plant is unstable at its equilibrium."""
    env = task_of(task)
    try:
        model = dlx.linearize(env.dynamics, 0.0, *env.dynamics.equilibrium())
    except ValueError:
        return "zero"
    radius = np.max(np.abs(np.linalg.eigvals(np.asarray(model.A))))
    return "LQR" if radius > 1.001 else "zero"


def costs_of(results: Results) -> dict[tuple[str, str], np.ndarray | str]:
    """The costs over the seeds by task and method, or why there are none."""
    found: dict[tuple[str, str], Any] = {}
    for task in tasks():
        for method in METHODS:
            rows = results.where(task=task, method=method).rows
            values = [row.get("cost") for row in rows]
            if rows and all(value is not None for value in values):
                found[task, method] = np.array(values, float)
            else:
                found[task, method] = "not suited"
    return found


def tables(results: Results) -> str:
    """Scores, costs and speed, as Markdown."""
    costs = costs_of(results)
    scores, raw, speed = [], [], []
    for task in dict.fromkeys(row["task"] for row in results.rows):
        floor = floor_of(task)
        if not isinstance(costs[task, floor], np.ndarray):
            floor = "zero"
        usable = [c for m in METHODS if isinstance(c := costs[task, m], np.ndarray)]
        with np.errstate(invalid="ignore"):
            best = np.nanmin(np.where(np.isfinite(usable), usable, np.inf), axis=0)
        low, high = interquartile_mean(best), interquartile_mean(costs[task, floor])
        line, numbers, times = [f"`{task}`", floor], [f"`{task}`"], [f"`{task}`"]
        for method in METHODS:
            cost = costs[task, method]
            if isinstance(cost, str):
                line.append("")
                numbers.append("")
                times.append("")
                continue
            own = interquartile_mean(np.where(np.isfinite(cost), cost, np.inf))
            numbers.append(_number(own))
            if high - low <= 1e-3 * abs(low) or not np.isfinite(high):
                line.append("")
            elif not np.isfinite(own):
                line.append("diverges")
            else:
                score = (high - own) / (high - low)
                text = f"{score:.2f}" if score > -10 else "below -10"
                line.append(text.replace("-0.00", "0.00"))
            rows = results.where(task=task, method=method).rows
            took = [row["us_per_step"] for row in rows if row.get("us_per_step")]
            times.append(f"{np.median(took):.2f}" if took else "")
        numbers.append(_number(low))
        scores.append(line)
        raw.append(numbers)
        speed.append(times)
    names = ["zero", "PID", "LQR", "H∞", "GPC", "MLP", "plan"]
    parts = [
        "Score: 0 is the floor, 1 the best known.\n",
        _markdown(["task", "floor", *names[:-1]], [row[:-1] for row in scores], 2),
        "Cost of an episode, the interquartile mean over 8 starts.\n",
        _markdown(["task", *names, "best known"], raw, 1),
        "Microseconds a step of each of a batch of 8, the controller included.\n",
        _markdown(["task", *names[:-1]], [row[:-1] for row in speed], 1),
    ]
    machine = describe()
    version = machine["versions"]
    parts.append(
        f"Float32, one core of {machine['cpu']}, delucax {version['delucax']}, JAX "
        f"{version['jax']}."
    )
    return "\n".join(parts)


def _number(value: float) -> str:
    if not np.isfinite(value):
        return "diverges"
    return f"{value:.4g}" if abs(value) < 1e5 else f"{value:.1e}"


def _markdown(head: list[str], body: list[list[str]], left: int) -> str:
    rule = ["---" if k < left else "---:" for k in range(len(head))]
    lines = [" | ".join(line) for line in (head, rule, *body)]
    return "".join(f"| {line} |\n" for line in lines)


def write_page(text: str) -> None:
    """Put the tables between their marks."""
    page = PAGE.read_text(encoding="utf-8")
    before, _, rest = page.partition(BEGIN)
    _, _, after = rest.partition(END)
    PAGE.write_text(f"{before}{BEGIN}\n{text}\n{END}{after}", encoding="utf-8")


def main(arguments: list[str] | None = None) -> int:
    """Run what is missing and write the page."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.scoreboard")
    parser.add_argument("--table", action="store_true", help="from what is stored")
    parser.add_argument("--fresh", action="store_true", help="run all again")
    parser.add_argument("--workers", type=int, default=1)
    options = parser.parse_args(arguments)
    begin = time.perf_counter()
    if options.table:
        results = Results.read(STORE)
    else:
        results = experiments.run(
            scoreboard, store=STORE, workers=options.workers, fresh=options.fresh
        )
    for row in {row["case"]: row for row in results.failed}.values():
        print(f"FAILED {row['case']}: {row['error'].splitlines()[0]}", file=sys.stderr)
    text = tables(results)
    print(text)
    write_page(text)
    print(f"{time.perf_counter() - begin:.0f} s on {jax.devices()[0].device_kind}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
