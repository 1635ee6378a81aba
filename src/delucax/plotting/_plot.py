"""States, controls and costs against time."""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from .._results import RESULTS
from ..environments import Environment
from ._figure import (
    color_of,
    line_style_of,
    NEUTRAL,
    NotebookFigure,
    side_legend,
    style_axes,
    with_unit,
    wrapped,
)
from ._runs import (
    as_runs,
    HELD,
    last_seen,
    Panel,
    panels_of,
    Run,
    time_label,
    Trajectories,
)


FEW = 8
WIDTH = 7.0
PANEL_HEIGHT = 1.35
SIZE = 9.0


def plot(
    trajectory: Trajectories,
    *,
    labels: str | Sequence[str] | None = None,
    environment: Environment | None = None,
    show: str | Sequence[str] | None = None,
) -> Figure:
    """Draw states, controls and costs against time, in stacked panels.

    States that share a unit share a panel. Controls are drawn as the steps they are. Of
    a batch of at most 8 every member is drawn as a thin line; of a larger one the
    median and the band between the quartiles of those that have not ended. Several
    trajectories are laid over each other, with a panel for each state. A ring marks
    where an episode terminated, a cross where it failed. Above the controls a tick
    marks each step at which something went wrong in the controller, such as a failed
    plan, or, of one trajectory, at which the bounds clipped the control.

    The figure belongs to nobody: pyplot does not know it, a notebook shows it, and
    `figure.savefig("run.pdf")` writes it.

    **Arguments:**

    - `trajectory`: a [`delucax.Trajectory`][], a batch of them, or several to compare:
        a dictionary from labels to trajectories, or a sequence.
    - `labels`: strings, one a trajectory, where a sequence is given; or the title of
        one trajectory. None by default.
    - `environment`: the environment that was run; its control bounds are then drawn as
        dashed lines. None by default.
    - `show`: what to draw, and in which order: `"states"`, `"controls"`, `"costs"`,
        `"observations"`, `"disturbances"`, or the name of one state or control. By
        default the first three, as far as they were kept.

    **Returns:** a `matplotlib.figure.Figure`, with one entry of `axes` a panel.

    **Raises:** `ValueError` if there is nothing to draw, if states were not kept, if
    the trajectories are not of the same plant, or if `show` names what is not there.

    !!! example

        ```python
        import delucax as dlx
        import jax
        import jax.numpy as jnp

        env = dlx.make("pendulum")
        key = jax.random.key(0)
        zero = dlx.rollout(env, dlx.controllers.Zero(1), key=key)
        linear = dlx.controllers.Linear(jnp.array([[20.0, 5.0]]))
        linear = dlx.rollout(env, linear, key=key)
        figure = dlx.plot({"zero": zero, "linear": linear}, environment=env)
        ```
    """
    runs = as_runs(trajectory, labels, "trajectory", "plot")
    compared = len(runs) > 1
    panels = panels_of(runs[0], show, grouped=not compared, where="plot")
    for run in runs[1:]:
        missing = {panel.kind for panel in panels} - set(run.series)
        if missing:
            raise ValueError(
                f"plot: trajectory[{run.label!r}] holds no "
                f"{', '.join(sorted(missing))}, which the first trajectory does; keep "
                "them in both rollouts."
            )
    bounds = None
    if environment is not None:
        bounds = control_bounds(environment, runs[0], "plot")

    columns = 1 if len(panels) <= 5 else 2 if len(panels) <= 10 else 3
    columns = columns if compared else 1
    rows = math.ceil(len(panels) / columns)
    figure = NotebookFigure(
        figsize=(WIDTH + 1.5 * (columns - 1), PANEL_HEIGHT * rows + 0.7),
        layout="constrained",
    )
    grid = figure.add_gridspec(rows, columns)
    axes: list[Axes] = []
    for i, panel in enumerate(panels):
        row, column = divmod(i, columns)
        ax = figure.add_subplot(grid[row, column], sharex=axes[0] if axes else None)
        axes.append(ax)
        last = i + columns >= len(panels)
        draw_panel(ax, panel, runs, bounds, columns=columns)
        ax.tick_params(labelbottom=last)
        if panel.kind == "costs" and not compared:
            ax.set_title(_total(runs[0]), loc="right", fontsize=SIZE - 1, pad=3)
    if columns == 1:
        axes[-1].set_xlabel(time_label(runs[0]), fontsize=SIZE)
    else:
        figure.supxlabel(time_label(runs[0]), fontsize=SIZE)
    figure.align_ylabels(axes)
    kinds = {panel.kind for panel in panels}
    with_controls = "controls" in kinds
    _head(figure, runs, with_costs="costs" in kinds, with_controls=with_controls)
    return figure


def control_bounds(environment: Any, run: Run, where: str) -> Any:
    """The bounds of each control, shape `(2, m)`, or `None`; checked against a run."""
    if not isinstance(environment, Environment):
        raise ValueError(
            f"{where}: environment must be an Environment, got "
            f"{type(environment).__name__}."
        )
    for name in ("state_names", "control_names"):
        expected = getattr(run.trajectory, name)
        got = getattr(environment.dynamics, name)
        if got != expected:
            raise ValueError(
                f"{where}: environment has {name} {got}, but the trajectory has "
                f"{expected}."
            )
    if environment.control_bounds is None:
        return None
    size = environment.control_size
    ends = [np.asarray(end, float) for end in environment.control_bounds]
    if any(end.shape not in ((), (size,)) for end in ends):
        raise ValueError(
            f"{where}: environment must be one environment, not a batch; its control "
            f"bounds have shape {ends[0].shape}."
        )
    return np.stack([np.broadcast_to(end, (size,)) for end in ends])


def draw_panel(
    ax: Axes,
    panel: Panel,
    runs: Sequence[Run],
    bounds: Any = None,
    *,
    columns: int = 1,
    size: float = SIZE,
    faint: float = 1.0,
) -> list[Line2D]:
    """One panel: its series, its names, and the bounds of its controls.

    Returns a handle a line, which has its colour and style.
    """
    style_axes(ax, size=size)
    compared = len(runs) > 1
    handles: list[Line2D] = []
    for i, run in enumerate(runs):
        for j, column in enumerate(panel.columns):
            index = i if compared else j + (panel.kind in HELD)
            color = NEUTRAL if panel.kind == "costs" and not compared else None
            style: dict[str, Any] = {
                "color": color or color_of(index),
                "linestyle": line_style_of(index),
            }
            values = run.series[panel.kind][..., column]
            handles.append(_draw_series(ax, run, panel.kind, values, style, faint))
            if panel.kind == "states":
                _mark_ends(ax, run, values, style["color"])
    if panel.kind == "controls":
        if bounds is not None:
            _draw_bounds(ax, panel, bounds, compared)
        _mark_incidents(ax, runs)
    width = int(PANEL_HEIGHT * 13 * 9 / size) if columns == 1 else 16
    _label(ax, panel, width, size)
    if len(panel.names) > 1:
        names = [wrapped(name, 24) for name in panel.names]
        side_legend(ax, handles, names, size=size - 1)
    return handles


def _label(ax: Axes, panel: Panel, width: int, size: float) -> None:
    joined = ", ".join(panel.names)
    if len(panel.names) > 1 and len(with_unit(joined, panel.unit)) > 2.5 * width:
        # The names are in the legend; here the kind and the unit say enough.
        joined = panel.kind
    text = wrapped(with_unit(joined, panel.unit), width)
    lines = text.count("\n") + 1
    ax.set_ylabel(text, fontsize=size if lines < 3 else size - 1)


def _total(run: Run) -> str:
    """`"total cost 12.3"`, or the median over a batch of those that are finite."""
    totals = run.total_costs
    if totals.size == 1:
        return f"total cost {totals[0]:.4g}"
    finite = totals[np.isfinite(totals)]
    return f"median total cost {np.median(finite) if finite.size else np.nan:.4g}"


def _draw_series(ax, run, kind, values, style, faint):
    """One series of a run, of shape `(batch, T + 1)`; returns the legend's handle."""
    drawstyle = "steps-post" if kind in HELD else "default"
    members = len(values)
    if members <= FEW or not run.same_times:
        width = 1.6 if members == 1 else 0.9
        alpha = faint * (1.0 if members == 1 else max(0.15, 0.75 - 0.05 * members))
        for t, v in zip(run.times, values, strict=True):
            ax.plot(t, v, drawstyle=drawstyle, linewidth=width, alpha=alpha, **style)
        return Line2D([], [], linewidth=1.6, **style)
    t = run.times[0]
    low, middle, high = _quartiles(values)
    step = "post" if kind in HELD else None
    color = style["color"]
    ax.fill_between(t, low, high, step=step, color=color, alpha=0.2, linewidth=0)
    ax.plot(t, middle, drawstyle=drawstyle, linewidth=1.6, **style)
    return Line2D([], [], linewidth=1.6, **style)


def _quartiles(values: np.ndarray) -> np.ndarray:
    """Quartiles over the members that are there, shape `(3, T + 1)`."""
    result = np.full((3, values.shape[1]), np.nan)
    some = np.any(np.isfinite(values), axis=0)
    result[:, some] = np.nanquantile(values[:, some], [0.25, 0.5, 0.75], axis=0)
    return result


def _mark_ends(ax, run, values, color):
    """A cross where a member failed, a ring where it terminated.

    Of a band, whose members are not drawn, the marks stand on the time axis.
    """
    few = len(values) <= FEW or not run.same_times
    last = last_seen(run)
    rows = np.arange(len(values))
    for mask, marker, face in (
        (run.failed, "x", color),
        (run.terminated & ~run.failed, "o", "none"),
    ):
        if not mask.any():
            continue
        times = run.times[rows, last][mask]
        where = values[rows, last][mask] if few else np.zeros(len(times))
        ax.plot(
            times,
            where,
            marker,
            color=color,
            markerfacecolor=face,
            markersize=6 if few else 4,
            markeredgewidth=1.5 if few else 0.8,
            alpha=1.0 if few else 0.5,
            clip_on=False,
            zorder=3,
            transform=ax.transData if few else ax.get_xaxis_transform(),
        )


def _mark_incidents(ax, runs):
    """Ticks above the panel, a row for each kind of incident."""
    for row, name in enumerate(incident_names(runs)):
        for i, run in enumerate(runs):
            steps = run.incidents.get(name)
            if steps is None or len(steps) > FEW:
                continue
            times = run.times[:, :-1][steps]
            ax.plot(
                times,
                np.full(len(times), 1.04 + 0.09 * row),
                "|",
                color=color_of(i) if len(runs) > 1 else _incident_color(name),
                markersize=4,
                markeredgewidth=1.2,
                transform=ax.get_xaxis_transform(),
                clip_on=False,
            )


def incident_names(runs: Sequence[Run]) -> list[str]:
    """The kinds of incident that happened in any run. Where runs are compared, those
    of the controllers alone: every one of them may be clipped."""
    names = {name for run in runs for name in run.incidents}
    return sorted(names - {"clipped_control"} if len(runs) > 1 else names)


def _incident_color(name: str) -> str:
    return NEUTRAL if name == "clipped_control" else color_of(3)


def _incident_label(name: str, runs: Sequence[Run]) -> str:
    """`"failed plan: 12 steps, first at 0.55"`, or in how many members of a batch."""
    steps = [run.incidents[name] for run in runs if name in run.incidents]
    words = name.replace("_", " ")
    members = sum(len(run.failed) for run in runs)
    if members > 1:
        hit = sum(int(now.any(axis=1).sum()) for now in steps)
        return f"{words}: in {hit} of {members}"
    count, first = int(steps[0].sum()), int(np.argmax(steps[0][0]))
    plural = "step" if count == 1 else "steps"
    return f"{words}: {count} {plural}, first at {runs[0].times[0, first]:.3g}"


def _draw_bounds(ax, panel, bounds, compared):
    """A dashed line a bound: neutral where the controls of the panel share it."""
    chosen = bounds[:, list(panel.columns)]
    shared = np.all(chosen == chosen[:, :1])
    for j in range(1 if shared else chosen.shape[1]):
        color = NEUTRAL if shared or compared else color_of(j + 1)
        for end in chosen[:, j][np.isfinite(chosen[:, j])]:
            ax.axhline(end, color=color, linestyle="--", linewidth=1.0, zorder=1)


def _head(
    figure: Figure, runs: Sequence[Run], *, with_costs: bool, with_controls: bool
) -> None:
    """The legend above the panels: the labels, and what the marks mean."""
    handles: list[Line2D] = []
    labels: list[str] = []
    for i, run in enumerate(runs):
        if len(runs) > 1:
            style: dict[str, Any] = {
                "color": color_of(i),
                "linestyle": line_style_of(i),
            }
            handles.append(Line2D([], [], linewidth=1.6, **style))
            cost = f" ({_total(run)})" if with_costs else ""
            labels.append(wrapped(run.label, 40) + cost)
    for name, marker in (("failed", "x"), ("terminated", "o")):
        masks = [
            run.failed if name == "failed" else run.terminated & ~run.failed
            for run in runs
        ]
        count, members = sum(int(m.sum()) for m in masks), sum(m.size for m in masks)
        if not count:
            continue
        style = {"marker": marker, "markeredgewidth": 1.5, "color": NEUTRAL}
        style |= {"markerfacecolor": "none"} if marker == "o" else {}
        handles.append(Line2D([], [], linestyle="none", **style))
        if members > len(runs):
            labels.append(f"{name}: {count} of {members}")
        elif name == "failed" and len(runs) == 1:
            labels.append(f"failed: {RESULTS[runs[0].trajectory.result]}")
        else:
            labels.append(name)
    if with_controls:
        for name in incident_names(runs):
            color = NEUTRAL if len(runs) > 1 else _incident_color(name)
            style = {"marker": "|", "color": color}
            handles.append(Line2D([], [], linestyle="none", **style))
            labels.append(_incident_label(name, runs))
    title = wrapped(runs[0].label, 80) if len(runs) == 1 else ""
    if not handles:
        figure.suptitle(title, fontsize=SIZE + 1)
        return
    # Lengths in characters, of which eleven fit an inch, and six more for the handle.
    lengths = [6 + max(map(len, label.split("\n"))) for label in labels]
    room = int(11 * figure.get_figwidth())
    columns = len(labels) if sum(lengths) <= room else room // max(lengths)
    figure.legend(
        handles,
        labels,
        loc="outside upper center",
        ncols=max(1, columns),
        frameon=False,
        title=title or None,
        title_fontsize=SIZE + 1,
        fontsize=SIZE,
        handlelength=1.8,
        columnspacing=1.6,
    )
