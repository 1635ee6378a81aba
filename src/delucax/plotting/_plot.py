"""Plots of states, controls and costs against time."""

import math
from collections.abc import Sequence
from typing import Any, TypeAlias

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from .. import _figures as figures
from .._check import check_instance
from .._results import RESULTS
from ..environments import Environment
from ._marks import event_entries, mark_events
from ._runs import as_runs, FEW, HELD, Panel, panels_of, Run, Trajectories


Bounds: TypeAlias = Float[np.ndarray, "2 controls"]
Values: TypeAlias = Float[np.ndarray, "batch times"]

WIDTH = 7.0
PANEL_HEIGHT = 1.35
SIZE = 9.0
# The style of a legend beside a panel.
COMPACT: dict[str, Any] = {"handlelength": 1.4, "handletextpad": 0.5}
COMPACT |= {"labelspacing": 0.3, "borderaxespad": 0.3}
# The markers at the end of each member of a run.
END_MARKS: dict[str, dict[str, Any]] = {
    "failed": {"marker": "x"},
    "terminated": {"marker": "o", "markerfacecolor": "none"},
}


def plot(
    trajectory: Trajectories,
    *,
    labels: str | Sequence[str] | None = None,
    environment: Environment | None = None,
    show: str | Sequence[str] | None = None,
) -> Figure:
    """Draw states, controls and costs against time, in stacked panels.

    States with the same unit are drawn in the same panel. Controls are drawn as steps,
    because they are held over each step. Each member of a batch of at most 8 is drawn
    as a thin line. For a larger batch, a line shows the median and a band shows the
    range between the quartiles. Both are computed over the members whose episode has
    not ended. Several trajectories are drawn in the same panels, with one panel for
    each state.

    A ring marks the point at which an episode terminated, and a cross the point at
    which it failed. A tick above the controls marks a step at which something went
    wrong in the controller, such as a failed plan. For a single trajectory, ticks also
    mark the steps at which the bounds clipped the control. If the trajectory kept its
    events, the lines of the states are interrupted at each event. A dotted line across
    the panels of the states marks each event. If there are many events, or several
    trajectories, a tick above the panels marks each event, instead of a dotted line.

    The figure is not registered with pyplot, so `plt.show()` does not show it. A
    notebook shows the figure, and `figure.savefig("run.pdf")` writes it to a file.

    **Arguments:**

    - `trajectory`: a [`delucax.Trajectory`][], a batch of trajectories, or several
        trajectories to compare: a dictionary from labels to trajectories, or a
        sequence.
    - `labels`: one label for each trajectory of a sequence, or the title of a single
        trajectory. None by default.
    - `environment`: the environment that was run. If the environment is given, its
        control bounds are drawn as dashed lines. None by default.
    - `show`: what to draw, and in which order: `"states"`, `"controls"`, `"costs"`,
        `"observations"`, `"disturbances"`, or the name of one state or control. By
        default `plot` draws those of the states, controls and costs that the trajectory
        holds.

    **Returns:** a `matplotlib.figure.Figure`. The list `axes` of the figure has one
    entry for each panel.

    **Raises:** `ValueError` if there is nothing to draw, if states were not kept, if
    the trajectories are not of the same plant, or if `show` names something that the
    trajectory does not hold.

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
                f"{', '.join(sorted(missing))}, but the first trajectory does; keep "
                "them in both rollouts."
            )
    env = environment
    bounds = None if env is None else control_bounds(env, runs[0], "plot")

    columns = min(math.ceil(len(panels) / 5), 3) if compared else 1
    rows = math.ceil(len(panels) / columns)
    size = WIDTH + 1.5 * (columns - 1), PANEL_HEIGHT * rows + 0.7
    figure = figures.NotebookFigure(figsize=size, layout="constrained")
    grid = figure.add_gridspec(rows, columns)
    axes: list[Axes] = []
    for i, panel in enumerate(panels):
        sharex = axes[0] if axes else None
        ax = figure.add_subplot(grid[divmod(i, columns)], sharex=sharex)
        axes.append(ax)
        draw_panel(ax, panel, runs, bounds, columns=columns)
        ax.tick_params(labelbottom=i + columns >= len(panels))
        if panel.kind == "costs" and not compared:
            ax.set_title(_total(runs[0]), loc="right", fontsize=SIZE - 1, pad=3)
    of_states = [ax for ax, p in zip(axes, panels, strict=True) if p.kind == "states"]
    if of_states:
        mark_events(of_states, runs)
    set_label = axes[-1].set_xlabel if columns == 1 else figure.supxlabel
    set_label(runs[0].time_label, fontsize=SIZE)
    figure.align_ylabels(axes)
    _draw_head(figure, runs, {panel.kind for panel in panels})
    return figure


def control_bounds(environment: Any, run: Run, where: str) -> Bounds | None:
    """The bounds of each control, shape `(2, m)`, or `None` without bounds. Raises an
    error if the environment does not fit the run."""
    check_instance(environment, Environment, "environment", where)
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
    bounds: Bounds | None = None,
    *,
    columns: int = 1,
    size: float = SIZE,
    faint: float = 1.0,
) -> list[Line2D]:
    """Draw one panel: its series, its names, and the bounds of its controls.

    Returns a handle for each line, with its colour and style.
    """
    figures.style_axes(ax, size=size)
    compared = len(runs) > 1
    handles: list[Line2D] = []
    for i, run in enumerate(runs):
        for j, column in enumerate(panel.columns):
            style = figures.line_style(i if compared else j + (panel.kind in HELD))
            if panel.kind == "costs" and not compared:
                style["color"] = figures.NEUTRAL
            _draw_series(ax, run, panel.kind, column, style, faint)
            handles.append(Line2D([], [], linewidth=1.6, **style))
            if panel.kind == "states":
                values = run.series["states"][..., column]
                _mark_ends(ax, run, values, style["color"])
    if panel.kind == "controls":
        if bounds is not None:
            _draw_bounds(ax, panel, bounds, compared)
        _mark_incidents(ax, runs)
    _label(ax, panel, int(PANEL_HEIGHT * 13 * 9 / size) if columns == 1 else 16, size)
    if len(panel.names) > 1:  # beside the panel, where it covers no data
        names = [figures.wrapped(name, 24) for name in panel.names]
        place = {"loc": "center left", "bbox_to_anchor": (1.0, 0.5), "frameon": False}
        ax.legend(handles, names, fontsize=size - 1, **place, **COMPACT)
    return handles


def _label(ax: Axes, panel: Panel, width: int, size: float) -> None:
    joined = ", ".join(panel.names)
    length = len(figures.with_unit(joined, panel.unit))
    if len(panel.names) > 1 and length > 2.5 * width:
        # The legend has the names: the kind and the unit are enough here.
        joined = panel.kind
    text = figures.wrapped(figures.with_unit(joined, panel.unit), width)
    ax.set_ylabel(text, fontsize=size if text.count("\n") < 2 else size - 1)


def _total(run: Run) -> str:
    """`"total cost 12.3"`, or the median of the finite total costs of a batch."""
    totals = run.total_costs
    if totals.size == 1:
        return f"total cost {totals[0]:.4g}"
    finite = totals[np.isfinite(totals)]
    return f"median total cost {np.median(finite) if finite.size else np.nan:.4g}"


def _draw_series(
    ax: Axes, run: Run, kind: str, column: int, style: dict[str, Any], faint: float
) -> None:
    """Draw one series of a run: a line for each member, or the median and a band."""
    held = kind in HELD
    style = style | {"drawstyle": "steps-post" if held else "default"}
    if run.as_band:
        values = run.series[kind][..., column]
        # Quartiles over the members that have not ended.
        low, middle, high = np.full((3, values.shape[1]), np.nan)
        some = np.any(np.isfinite(values), axis=0)
        quartiles = np.nanquantile(values[:, some], [0.25, 0.5, 0.75], axis=0)
        low[some], middle[some], high[some] = quartiles
        band = {"color": style["color"], "alpha": 0.2, "linewidth": 0}
        step = "post" if held else None
        ax.fill_between(run.times[0], low, high, step=step, **band)
        ax.plot(run.times[0], middle, linewidth=1.6, **style)
        return
    members = len(run.times)
    width = 1.6 if members == 1 else 0.9
    alpha = faint * (1.0 if members == 1 else max(0.15, 0.75 - 0.05 * members))
    for t, v in run.lines(kind, column):
        ax.plot(t, v, linewidth=width, alpha=alpha, **style)


def _mark_ends(ax: Axes, run: Run, values: Values, color: str) -> None:
    """Draw a cross where a member failed, and a ring where it terminated.

    If a band is drawn in place of the members, the marks lie on the time axis.
    """
    style: dict[str, Any] = {"markersize": 6, "markeredgewidth": 1.5}
    if run.as_band:
        style = {"markersize": 4, "markeredgewidth": 0.8, "alpha": 0.5}
        style["transform"] = ax.get_xaxis_transform()
    for name, marker in END_MARKS.items():
        ended = np.flatnonzero(getattr(run, name))
        if len(ended):
            at = ended, run.last[ended]
            heights = np.zeros(len(ended)) if run.as_band else values[at]
            style |= marker | {"linestyle": "none", "clip_on": False, "zorder": 3}
            ax.plot(run.times[at], heights, color=color, **style)


def _mark_incidents(ax: Axes, runs: Sequence[Run]) -> None:
    """Draw ticks above the panel, in a row for each kind of incident."""
    style = {"markersize": 4, "markeredgewidth": 1.2, "clip_on": False}
    style["transform"] = ax.get_xaxis_transform()
    for row, (name, own_color) in enumerate(_incident_colors(runs).items()):
        for i, run in enumerate(runs):
            steps = run.incidents.get(name)
            if steps is not None and len(steps) <= FEW:
                times = run.times[:, :-1][steps]
                color = figures.color_of(i) if len(runs) > 1 else own_color
                heights = np.full(len(times), 1.04 + 0.09 * row)
                ax.plot(times, heights, "|", color=color, **style)


def _incident_colors(runs: Sequence[Run]) -> dict[str, str]:
    """The kinds of incident that happened in any run, and their colours. If runs are
    compared, clipped controls are left out, because they can be common to all runs."""
    colors = {name: figures.color_of(3) for run in runs for name in run.incidents}
    if "clipped_control" in colors:
        colors["clipped_control"] = figures.NEUTRAL
        if len(runs) > 1:
            del colors["clipped_control"]
    return dict(sorted(colors.items()))


def _incident_label(name: str, runs: Sequence[Run]) -> str:
    """`"failed plan: 12 steps, first at 0.55"`, or `"failed plan: in 3 of 8"` for a
    batch."""
    steps = [run.incidents[name] for run in runs if name in run.incidents]
    words = name.replace("_", " ")
    members = sum(len(run.failed) for run in runs)
    if members > 1:
        hit = sum(int(now.any(axis=1).sum()) for now in steps)
        return f"{words}: in {hit} of {members}"
    count, first = int(steps[0].sum()), int(np.argmax(steps[0][0]))
    plural = "step" if count == 1 else "steps"
    return f"{words}: {count} {plural}, first at {runs[0].times[0, first]:.3g}"


def _draw_bounds(ax: Axes, panel: Panel, bounds: Bounds, compared: bool) -> None:
    """Draw a dashed line for each bound, in grey if the controls of the panel share the
    bounds."""
    chosen = bounds[:, list(panel.columns)]
    shared = np.all(chosen == chosen[:, :1])
    for j in range(1 if shared else chosen.shape[1]):
        color = figures.NEUTRAL if shared or compared else figures.color_of(j + 1)
        for end in chosen[:, j][np.isfinite(chosen[:, j])]:
            ax.axhline(end, color=color, linestyle="--", linewidth=1.0, zorder=1)


def _draw_head(figure: Figure, runs: Sequence[Run], kinds: set[str]) -> None:
    """Draw the legend above the panels: the labels, and the meaning of the marks."""
    compared = len(runs) > 1
    entries: list[tuple[Line2D, str]] = []
    for i, run in enumerate(runs if compared else ()):
        cost = f" ({_total(run)})" if "costs" in kinds else ""
        handle = Line2D([], [], linewidth=1.6, **figures.line_style(i))
        entries.append((handle, figures.wrapped(run.label, 40) + cost))
    members = sum(len(run.failed) for run in runs)
    for name, marker in END_MARKS.items():
        count = sum(int(getattr(run, name).sum()) for run in runs)
        if not count:
            continue
        label = name
        if members > len(runs):
            label = f"{name}: {count} of {members}"
        elif name == "failed" and not compared:
            label = f"failed: {RESULTS[runs[0].trajectory.result]}"
        style = {"linestyle": "none", "markeredgewidth": 1.5, "color": figures.NEUTRAL}
        entries.append((Line2D([], [], **style, **marker), label))
    for name, color in _incident_colors(runs).items() if "controls" in kinds else ():
        color = figures.NEUTRAL if compared else color
        handle = Line2D([], [], linestyle="none", marker="|", color=color)
        entries.append((handle, _incident_label(name, runs)))
    entries += event_entries(runs) if "states" in kinds else []
    title = "" if compared else figures.wrapped(runs[0].label, 80)
    if not entries:
        figure.suptitle(title, fontsize=SIZE + 1)
        return
    # Lengths in characters: eleven fit an inch, and a handle takes six.
    lengths = [6 + max(map(len, label.split("\n"))) for _, label in entries]
    room = int(11 * figure.get_figwidth())
    columns = len(entries) if sum(lengths) <= room else room // max(lengths)
    style = {"title": title or None, "title_fontsize": SIZE + 1, "fontsize": SIZE}
    style |= {"ncols": max(1, columns), "handlelength": 1.8, "columnspacing": 1.6}
    figures.top_legend(figure, entries, **style)
