"""The tables and the figure of `docs/ventilator_results.md`, from what is stored."""

from pathlib import Path
from typing import Any

import numpy as np

from delucax._figures import color_of, NotebookFigure, style_axes
from delucax.studies.ventilator._report import PID_ROWS


DOCS = Path(__file__).parents[1] / "docs"
PAGE = DOCS / "ventilator_results.md"


def write_page(results: dict[str, Any]) -> None:
    """Put each table between its marks, and draw the figure."""
    text = PAGE.read_text(encoding="utf-8")
    for name, table in tables(results).items():
        begin, end = f"<!-- table: {name} -->\n", f"<!-- end: {name} -->"
        before, _, rest = text.partition(begin)
        _, _, after = rest.partition(end)
        text = f"{before}{begin}\n{table}\n{end}{after}"
    PAGE.write_text(text, encoding="utf-8")
    draw_training(results, DOCS / "assets" / "ventilator" / "training.png")


def tables(results: dict[str, Any]) -> dict[str, str]:
    """As Markdown, by name."""
    summary, rows = results["summary"], results["report"]
    simulators = summary["simulators"]
    closed = summary["simulators_closed_loop"]
    names = list(simulators["learned"])
    kinds = list(simulators)
    published = results["learned lung as published, open loop"]
    simulated = [
        [
            _lung(name),
            *(f"{simulators[k][name]:.2f} ({closed[k][name]:.2f})" for k in kinds),
            f"{published[name]:.2f}",
        ]
        for name in names
    ]
    return {
        "simulators": _markdown(["R, C", *kinds, "learned, as published"], simulated),
        "networks": _networks(results, names),
        "controllers": _controllers(rows),
        "training": _training(results),
        "limits": _limits(results),
        "tasks": _tasks(results),
    }


def _networks(results: dict[str, Any], names: list[str]) -> str:
    rows = results["report"]
    alike = results["network for all / best PID for all, lung by lung"]
    body = []
    for name in names:
        errors = {label: _mean(rows, label, "unseen", name) for label in PID_ROWS}
        best = min(errors, key=lambda label: errors[label])
        mean, low, high = results["network / best PID"][name]
        body.append(
            [
                _lung(name),
                f"{errors[best]:.2f} ({best})",
                f"{_mean(rows, 'MLP', 'unseen', name):.2f}",
                f"{mean:.2f} [{low:.2f}, {high:.2f}]",
                f"{_mean(rows, 'least error', 'unseen', name):.2f}",
                f"{alike[name][0]:.2f}",
            ]
        )
    head = ["R, C", "best PID", "network", "network / best PID", "least error"]
    head.append("for all: network / best PID")
    return _markdown(head, body)


def _tasks(results: dict[str, Any]) -> str:
    body = [
        [
            f"`{row['task']}`",
            f"{row['least error']:.2f}",
            f"{row['before a control']:.2f}",
        ]
        for row in results["least error of other tasks at 35 cmH2O"]
    ]
    head = ["task", "least error", "part before any control can act"]
    return _markdown(head, body)


def _controllers(rows: list[dict[str, Any]]) -> str:
    labels = list(dict.fromkeys(row["controller"] for row in rows))
    body = []
    for label in labels:
        between = _mean(rows, label, "between")
        body.append(
            [
                label,
                *(f"{_mean(rows, label, part):.2f}" for part in ("seen", "unseen")),
                "" if np.isnan(between) else f"{between:.2f}",
            ]
        )
    body.sort(key=lambda line: float(line[2]))
    head = ["controller", "pressures trained at", "pressures between", "lungs between"]
    return _markdown(head, body)


def _training(results: dict[str, Any]) -> str:
    body = []
    for level in results["steps of the simulator to an error"]:
        first = level["gradient"]
        line = [f"{level['error']:g}"]
        for way, steps in level.items():
            if way == "error":
                continue
            if steps is None:
                most = results["training"][way]["steps"][-1]
                ratio = "" if first is None else f" (over {_below(most / first)} times)"
                line.append(f"not in {most:,}{ratio}")
                continue
            known = way != "gradient" and first is not None
            ratio = f" ({steps / first:.2g} times)" if known else ""
            line.append(f"{steps:,}{ratio}")
        body.append(line)
    ways = [name for name in results["training"]]
    return _markdown(["error, cmH2O", *ways], body)


def _below(ratio: float) -> str:
    """Two digits, rounded down."""
    return f"{np.floor(ratio * 10) / 10:g}" if ratio < 10 else f"{np.floor(ratio):g}"


def _limits(results: dict[str, Any]) -> str:
    body = [
        [
            name,
            f"{value:.2f}",
            f"{results['limits'][name]:g}",
            "kept" if value <= results["limits"][name] else "missed",
        ]
        for name, value in results["measured"].items()
    ]
    return _markdown(["what", "measured", "at most", ""], body)


def _mean(rows: Any, label: str, split: str, lung: Any = None) -> float:
    found = [
        float(row["mae"])
        for row in rows
        if row["controller"] == label
        and row["split"] == split
        and lung in (None, row["lung"])
    ]
    return float(np.mean(found)) if found else float("nan")


def _lung(name: str) -> str:
    """`R5C10` as `5, 10`."""
    return name[1:].replace("C", ", ")


def _markdown(head: list[str], body: list[list[str]]) -> str:
    rule = ["---"] + ["---:"] * (len(head) - 1)
    lines = [" | ".join(line) for line in (head, rule, *body)]
    return "".join(f"| {line} |\n" for line in lines)


def draw_training(results: dict[str, Any], path: Path) -> None:
    """The error over the steps of the simulator, for each way to train."""
    figure = NotebookFigure(figsize=(6.5, 3.4), layout="constrained")
    ax = figure.subplots()
    for k, (name, curve) in enumerate(results["training"].items()):
        steps, errors = np.array(curve["steps"]), np.array(curve["errors"])
        color = color_of(k)
        ax.plot(steps, errors.mean(axis=1), color=color, lw=1.6, label=name)
        ends = errors.min(axis=1), errors.max(axis=1)
        ax.fill_between(steps, *ends, color=color, alpha=0.15, lw=0)
    ax.set_xlabel("steps of the simulator, a gradient's counted thrice", fontsize=9)
    ax.set_ylabel("mean |error| [cmH2O]", fontsize=9)
    ax.legend(fontsize=8, frameon=False)
    style_axes(ax, size=9)
    ax.set_xscale("log")
    ax.set_yscale("log")
    ax.minorticks_off()
    ax.set_yticks([2, 3, 5, 8], ["2", "3", "5", "8"])
    figure.savefig(path, dpi=130)
