"""Every task crossed with the controllers that suit it.

`python -m benchmarks.scoreboard` runs what is missing or changed, writes
`results/scoreboard.jsonl`, and puts the tables into `docs/scoreboard.md` and draws its
picture; with `--table` it only does the latter, with `--fresh` it runs all, and with
`-k "SQP or RTI"` a selection.
"""

import argparse
import functools
import sys
import time
from pathlib import Path
from typing import Any

import jax
import numpy as np
from matplotlib.figure import Figure

import delucax as dlx
from benchmarks._machine import describe, keep_programs
from delucax import experiments
from delucax.experiments import interquartile_mean, Results
from delucax.studies._scoreboard import FAMILIES, METHODS, scoreboard, task_of


STORE = Path(__file__).parent / "results" / "scoreboard.jsonl"
PAGE = Path(__file__).parents[1] / "docs" / "scoreboard.md"
PICTURE = PAGE.parent / "assets" / "scoreboard.svg"
# Two processes side by side, as the page says of the times.
WORKERS = 2
# Costs that differ by less, relative to the best known, are as good.
CLOSE = 5e-3
SHORT = {"FiniteHorizonLQR": "finite LQR", "HInfinity": "H∞"}
BEGIN, END = "<!-- scoreboard -->\n", "<!-- end of scoreboard -->"


def floor_of(costs: dict[tuple[str, str], Any], task: str) -> str:
    """Zero control, or LQR where the plant is not stable at its equilibrium."""
    return "zero" if isinstance(costs[task, "LQR"], str) else _floor(task)


@functools.cache
def _floor(task: str) -> str:
    env = task_of(task)
    model = dlx.linearize(env.dynamics, 0.0, *env.dynamics.equilibrium())
    radius = np.max(np.abs(np.linalg.eigvals(np.asarray(model.A))))
    return "LQR" if radius > 1 - 1e-4 else "zero"


def costs_of(results: Results) -> dict[tuple[str, str], np.ndarray | str]:
    """The costs over the seeds by task and method, or that there are none."""
    found: dict[tuple[str, str], Any] = {}
    for place, values in _by_case(results, "cost").items():
        complete = bool(values) and None not in values
        found[place] = np.array(values, float) if complete else "not suited"
    return found


def _by_case(results: Results, name: str) -> dict[tuple[str, str], list]:
    """What there is of one result over the seeds, by task and method."""
    names = dict.fromkeys(row["task"] for row in results.rows)
    found = {(task, method): [] for task in names for method in METHODS}
    for row in results.rows:
        if row["method"] in METHODS:
            found[row["task"], row["method"]].append(row.get(name))
    return found


def tasks_of(costs: dict[tuple[str, str], Any]) -> list[str]:
    """The tasks that there are results of."""
    return list(dict.fromkeys(task for task, _ in costs))


def scores_of(costs: dict[tuple[str, str], Any]) -> dict[tuple[str, str], Any]:
    """By task and method, 0 at the floor and 1 at the best known; or a word: nothing
    where it is not suited, `diverges`, and where the floor is as good as the best
    known, whether this is, `best` or `worse`."""
    scores: dict[tuple[str, str], Any] = {}
    for task in tasks_of(costs):
        low = best_cost(costs, task)
        near = low + CLOSE * abs(low)
        floor = _mean(costs[task, floor_of(costs, task)])
        for method in METHODS:
            cost = costs[task, method]
            own = np.nan if isinstance(cost, str) else _mean(cost)
            if np.isnan(own):
                score = ""
            elif not np.isfinite(own):
                score = "diverges"
            elif floor <= near:
                score = "best" if own <= near else "worse"
            else:
                score = (floor - own) / (floor - low)
            scores[task, method] = score
    return scores


def _mean(cost: np.ndarray) -> float:
    """The interquartile mean; infinite where a middling start diverges."""
    return interquartile_mean(np.where(np.isfinite(cost), cost, np.inf))


def best_cost(costs: dict[tuple[str, str], Any], task: str) -> float:
    """The interquartile mean of the least cost of each start."""
    usable = [c for m in METHODS if not isinstance(c := costs[task, m], str)]
    best = np.min(np.where(np.isfinite(usable), usable, np.inf), axis=0)
    return interquartile_mean(best)


def tables(results: Results) -> str:
    """Scores, costs and speed, as Markdown."""
    costs, speeds = costs_of(results), _by_case(results, "us_per_step")
    scores = scores_of(costs)
    scored = [method for method in METHODS if method != "plan"]
    body = [
        [f"`{task}`", floor_of(costs, task), *(_score(scores[task, m]) for m in scored)]
        for task in tasks_of(costs)
    ]
    parts = [
        "## Score\n\n0 is the floor, 1 the best known.\n",
        _markdown(["task", "floor", *map(_short, scored)], body, 2),
        "## Cost\n\nOf an episode, the interquartile mean over 8 starts.\n",
    ]
    for name, family in FAMILIES.items():
        body = []
        for task in tasks_of(costs):
            found = [costs[task, method] for method in family]
            if all(isinstance(cost, str) for cost in found):
                continue
            found += [costs[task, "plan"]]
            best = _number(best_cost(costs, task))
            body.append([f"`{task}`", *map(_cost, found), best])
        head = ["task", *map(_short, family), "plan", "best known"]
        parts += [f"### {name}: cost\n", _markdown(head, body, 1)]
    parts.append(
        "## Time\n\nMicroseconds a step, the controller included, of each of a batch "
        "of 8. Two processes ran side by side, on the two threads of one core.\n"
    )
    for name, family in FAMILIES.items():
        body = []
        for task in tasks_of(costs):
            found = [_speed(speeds[task, method]) for method in family]
            if any(found):
                body.append([f"`{task}`", *found])
        parts += [f"### {name}: time\n"]
        parts += [_markdown(["task", *map(_short, family)], body, 1)]
    return "\n".join(parts)


def footer() -> str:
    """What it was measured with."""
    machine = describe()
    version = machine["versions"]
    return (
        f"Float32, {machine['cpu']}, delucax {version['delucax']}, JAX "
        f"{version['jax']}."
    )


def draw(results: Results) -> Figure:
    """The scores as a picture: a row for each task, a column for each controller."""
    costs = costs_of(results)
    scores = scores_of(costs)
    scored = [method for method in METHODS if method != "plan"]
    rows = tasks_of(costs)
    shade = {"": np.nan, "diverges": -1.0, "worse": -0.5, "best": 1.0}
    values = [[scores[task, m] for m in scored] for task in rows]
    colours = np.array([[shade.get(v, v) for v in row] for row in values], float)
    figure = Figure(figsize=(10, 0.3 * len(rows) + 1.6), layout="constrained")
    axes = figure.subplots()
    image = axes.imshow(np.clip(colours, -1, 1), cmap="RdYlGn", vmin=-1, vmax=1)
    for (i, j), colour in np.ndenumerate(colours):
        text = _score(values[i][j]).replace("below -10", "< -10")
        text = text.replace("diverges", "div.")
        ink = "white" if abs(colour) > 0.7 else "black"
        axes.text(j, i, text, ha="center", va="center", fontsize=6, color=ink)
    axes.set_xticks(range(len(scored)), map(_short, scored), rotation=60, ha="right")
    axes.set_yticks(range(len(rows)), rows)
    axes.tick_params(length=0, labelsize=8)
    axes.set_facecolor("0.93")
    edge = -0.5
    for name, family in FAMILIES.items():
        size = sum(method in scored for method in family)
        axes.text(edge + size / 2, -0.8, name, ha="center", va="bottom", fontsize=9)
        edge += size
        if edge < len(scored) - 1:
            axes.axvline(edge, color="black", linewidth=1)
    axes.spines[:].set_visible(False)
    figure.colorbar(image, label="score", shrink=0.6, pad=0.01)
    return figure


def _short(method: str) -> str:
    return SHORT.get(method, method)


def _score(value: float | str) -> str:
    if isinstance(value, str):
        return value
    return f"{value:.2f}".replace("-0.00", "0.00") if value > -10 else "below -10"


def _cost(cost: Any) -> str:
    if isinstance(cost, str):
        return ""
    return _number(_mean(cost))


def _speed(values: list[float | None]) -> str:
    took = [value for value in values if value]
    return _number(float(np.median(took)), 3) if took else ""


def _number(value: float, digits: int = 4) -> str:
    if not np.isfinite(value):
        return "diverges"
    return f"{value:.{digits}g}" if abs(value) < 1e5 else f"{value:.1e}"


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
    parser.add_argument("-k", default="", metavar="CASES", help="a selection")
    options = parser.parse_args(arguments)
    keep_programs()
    begin = time.perf_counter()
    if options.table:
        results = Results.read(STORE)
    else:
        results = experiments.run(
            scoreboard,
            store=STORE,
            workers=WORKERS,
            select=options.k,
            fresh=options.fresh,
        )
        # With what was stored before.
        results = Results.read(STORE)
    for row in {row["case"]: row for row in results.failed}.values():
        print(f"FAILED {row['case']}: {row['error'].splitlines()[0]}", file=sys.stderr)
    text = f"{tables(results)}\n{footer()}"
    print(text)
    write_page(text)
    draw(results).savefig(PICTURE)
    print(f"{time.perf_counter() - begin:.0f} s on {jax.devices()[0].device_kind}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
