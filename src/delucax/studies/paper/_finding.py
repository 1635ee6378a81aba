"""The findings of a study of the paper."""

from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from jaxtyping import Float

from ...experiments import Bootstrap


@dataclass(frozen=True)
class Claim:
    """One sentence of the paper, and what was measured.

    - `statement`: the claim, with its limit.
    - `measured`: the number, with its unit.
    - `holds`: whether the claim holds.
    """

    statement: str
    measured: str
    holds: bool


@dataclass(frozen=True)
class Finding:
    """The claims of one study, its tables and its figures.

    - `tables`: by title, the rows as dictionaries.
    - `figures`: by file name, Matplotlib figures or paths of images.
    - `notes`: what was done, and what differs from the paper.
    """

    title: str
    claims: list[Claim]
    tables: dict[str, list[dict[str, Any]]] = field(default_factory=dict)
    figures: dict[str, Any] = field(default_factory=dict)
    notes: str = ""


def mean_and_half_width(values: Float[np.ndarray, " n"]) -> tuple[float, float]:
    """The mean, and half the width of its 95% interval."""
    half = 1.96 * values.std(ddof=1) / np.sqrt(len(values)) if len(values) > 1 else 0.0
    return float(values.mean()), float(half)


def paired_ratio(
    one: Float[np.ndarray, " n"], other: Float[np.ndarray, " n"]
) -> tuple[float, float, float]:
    """The ratio of the means over the same seeds, and its 95% interval."""
    pairs = np.stack([one, other], axis=1)
    return Bootstrap(statistic=np.mean).paired([pairs], ratio=True)


def side_by_side(function: Callable[..., Any], arguments: Iterable[Any]) -> list[Any]:
    """The results for each argument, from two threads. Nearly all of the time of a
    study is compilation, and a program compiles on one core."""
    with ThreadPoolExecutor(max_workers=2) as pool:
        return list(pool.map(function, arguments))


def draw_panels(count: int, size: tuple[float, float], **options: Any) -> Any:
    """The axes of a figure with panels side by side, with faint grids. `options` go to
    Matplotlib's `subplots`."""
    from matplotlib.figure import Figure

    from ..._figures import PALETTE

    figure = Figure(figsize=size, layout="constrained")
    axes = figure.subplots(1, count, **options)
    for ax in np.ravel(axes):
        ax.grid(alpha=0.25, lw=0.5)
        ax.set_prop_cycle(color=[*PALETTE, "0.2"])
    return axes
