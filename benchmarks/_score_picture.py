"""The picture of the scoreboard: a row for each task, a column for each controller."""

from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import colormaps, rc_context
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from benchmarks._scores import Board, COLUMNS


SHORT = {"FiniteHorizonLQR": "finite LQR", "HInfinity": "H∞"}
MOST = 9.99
"""The excess from which on a score is but said to be more."""
# Readable on a white page and on a dark one.
INK = "#7d8187"
# Bright is good, whatever the colours that a reader tells apart.
COLOURS = colormaps["cividis_r"]


def short(method: str) -> str:
    """The name of a method at the head of a column."""
    return SHORT.get(method, method)


def score(excess: float | None) -> str:
    """An excess in percent, bounded."""
    if excess is None:
        return ""
    if not np.isfinite(excess):
        return "diverges"
    if excess > MOST:
        return f"> {100 * MOST:.0f}"
    return f"{100 * excess:.{1 if excess < 0.0995 else 0}f}"


def shade(excess: float) -> float:
    """From 0 at the best known to 1 at `MOST` and beyond: logarithmic above 1%."""
    return float(np.log1p(min(excess, MOST) / 0.01) / np.log1p(MOST / 0.01))


def draw(board: Board, path: Path) -> None:
    """Draw the scores into a file."""
    groups, methods = board.tasks, board.methods
    rows = sum(len(tasks) + 1 for tasks in groups.values())
    style = {"font.size": 7, "svg.fonttype": "path", "svg.hashsalt": "delucax"}
    with rc_context(style):
        figure = Figure(figsize=(8.5, 0.185 * rows + 1.35))
        height = figure.get_figheight()
        axes = figure.add_axes((0.166, 0.45 / height, 0.805, 0.185 * rows / height))
        axes.set(xlim=(0, len(methods)), ylim=(rows, 0))
        axes.axis("off")
        place = 0
        for title, tasks in groups.items():
            _text(axes, -0.15, place + 0.62, title, ha="right", weight="bold")
            axes.plot([0, len(methods)], [place + 0.62] * 2, color=INK, lw=0.4)
            for k, task in enumerate(tasks, place + 1):
                _text(axes, -0.15, k + 0.5, task, ha="right")
                for j, method in enumerate(methods):
                    _cell(axes, j, k, board.excess(task, method))
            place += len(tasks) + 1
        _heads(axes, methods)
        _key(figure, height)
        figure.savefig(path, transparent=True, metadata={"Date": None})


def _text(axes: Any, x: float, y: float, said: str, **how: Any) -> None:
    axes.text(x, y, said, **({"va": "center", "color": INK} | how))


def _cell(axes: Any, j: int, k: int, excess: float | None) -> None:
    if excess is None:
        return
    colour = COLOURS(shade(excess))
    axes.add_patch(Rectangle((j + 0.03, k + 0.03), 0.94, 0.94, color=colour, lw=0))
    said = score(excess).replace("diverges", "div.").replace(" ", "")
    ink = {"color": _ink(colour), "fontsize": 6.3}
    _text(axes, j + 0.5, k + 0.52, said, ha="center", **ink)


def _ink(colour: tuple[float, ...]) -> str:
    """Black or white, whichever has more contrast."""
    linear = np.array(colour[:3]) ** 2.2
    return "black" if linear @ [0.2126, 0.7152, 0.0722] > 0.179 else "white"


def _heads(axes: Any, methods: tuple[str, ...]) -> None:
    """The names of the columns, and over them those of the families."""
    aslant = {"rotation": 55, "rotation_mode": "anchor", "va": "bottom"}
    for j, method in enumerate(methods):
        _text(axes, j + 0.3, -0.1, short(method), **aslant)
    edge = 0
    for name, family in COLUMNS.items():
        size = sum(method in methods for method in family)
        _text(axes, edge + 0.1, -3.8, name, weight="bold", fontsize=8)
        ends = [edge + 0.1, edge + size - 0.2]
        axes.plot(ends, [-3.3] * 2, color=INK, lw=0.8, clip_on=False)
        edge += size


def _key(figure: Figure, height: float) -> None:
    """What the colours mean."""
    axes = figure.add_axes((0.17, 0.2 / height, 0.4, 0.1 / height))
    axes.imshow(
        np.linspace(0, 1, 256)[None], cmap=COLOURS, aspect="auto", extent=(0, 1, 0, 1)
    )
    at = {"0": 0.0, "1": 0.01, "10": 0.1, "100": 1.0, f"> {100 * MOST:.0f}": MOST}
    axes.set_xticks([shade(e) for e in at.values()], at, color=INK)
    axes.set_yticks([])
    axes.tick_params(length=2, color=INK, pad=1)
    axes.spines[:].set_visible(False)
    _text(axes, 1.08, 0.5, "percent above the best known")
