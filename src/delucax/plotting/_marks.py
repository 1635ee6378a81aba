"""Marks of events in the panels of a plot, and their entries in the legend."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.lines import Line2D

from .._figures import color_of, NEUTRAL
from ._runs import Run


MOST = 40  # more events than this are ticks above the panels, not lines across them


def event_color(kind: int) -> str:
    """The colour of a kind of event; states and controls have the first colours."""
    return color_of((3, 2, 4, 5)[kind % 4])


def _style(runs: Sequence[Run]) -> dict[str, Any]:
    """The style of event marks: lines across the panels if there is one run with few
    events, else ticks above the panels."""
    counts = [len(path.jumps) for run in runs for path in run.paths]
    if len(counts) == 1 and counts[0] <= MOST:
        return {"linestyle": (0, (1, 1.5)), "linewidth": 1.2}
    return {"linestyle": "none", "marker": "|", "markersize": 4}


def _times(run: Run, name: str) -> list[np.ndarray]:
    """The times at which the event `name` fired, for each member."""
    kind = run.trajectory.event_names.index(name)
    return [path.times[path.jumps[path.kinds == kind]] for path in run.paths]


def _kinds(runs: Sequence[Run]) -> dict[str, list[int]]:
    """From the name of each event that fired to the indices of the runs in which it
    fired."""
    runs_of: dict[str, list[int]] = {}
    for i, run in enumerate(runs):
        if run.trajectory.recorded_events is None:
            continue
        kinds = np.unique(np.concatenate([path.kinds for path in run.paths]))
        for kind in kinds.tolist():
            name = run.trajectory.event_names[kind]
            runs_of.setdefault(name, []).append(i)
    return runs_of


def mark_events(axes: Sequence[Axes], runs: Sequence[Run]) -> None:
    """Mark the events of runs in the panels of their states.

    The marks are lines across each panel, or ticks above the first panel. The ticks
    have a row for each kind of event, or for each run if runs are compared.
    """
    compared = len(runs) > 1
    for name, where in _kinds(runs).items():
        style = _style(runs)
        for i in where:
            kind = runs[i].trajectory.event_names.index(name)
            color = color_of(i) if compared else event_color(kind)
            times = np.concatenate(_times(runs[i], name))
            if "marker" not in style:
                for ax in axes:
                    for t in times:
                        ax.axvline(t, color=color, zorder=1, **style)
                continue
            row, ax = i if compared else kind, axes[0]
            alpha = float(np.clip(MOST / len(times), 0.2, 0.8))
            across = {"transform": ax.get_xaxis_transform(), "clip_on": False}
            heights = np.full(len(times), 1.05 + 0.07 * row)
            ax.plot(times, heights, color=color, alpha=alpha, **style, **across)


def event_entries(runs: Sequence[Run]) -> list[tuple[Line2D, str]]:
    """The legend entries of the marks, such as `"bounce: 6, first at 0.45"`."""
    entries, compared = [], len(runs) > 1
    for name, where in _kinds(runs).items():
        times = [t for i in where for t in _times(runs[i], name)]
        total, first = sum(map(len, times)), min(np.nanmin(t) for t in times if len(t))
        members = sum(len(run.paths) for run in runs)
        label = f"{name.replace('_', ' ')}: {total}"
        label += f" in {members} runs" if members > 1 else f", first at {first:.3g}"
        kind = runs[where[0]].trajectory.event_names.index(name)
        color = NEUTRAL if compared else event_color(kind)
        entries.append((Line2D([], [], color=color, **_style(runs)), label))
    return entries
