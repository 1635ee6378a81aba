"""The figures of the study."""

from pathlib import Path
from typing import Any

import equinox as eqx
import numpy as np
from matplotlib import rc_context
from matplotlib.axes import Axes

from ... import lung
from ..._figures import color_of, NEUTRAL, NotebookFigure, style_axes
from ..._module import unstack
from ...environments import Environment
from ...plotting import animate
from ._report import mean_error, PID_ROWS, Rows
from ._stages import SHOWN


_SIZE = 9.0
_STYLE: Any = {
    "axes.labelsize": _SIZE,
    "axes.titlesize": _SIZE + 1,
    "legend.fontsize": _SIZE - 1,
    "legend.frameon": False,
}
_ORDER = ("best PID", "MLP", "MLP for all", "MPC", "PID + MLP", "CNN")


@rc_context(_STYLE)
def tracking_figure(
    envs: Environment, shown: dict[str, Any], names: list[str], rows: Rows
) -> NotebookFigure:
    """Breaths of some lungs under several controllers, and all their errors."""
    count = len(names)
    lungs = sorted({0, count // 2, count - 1})
    figure = NotebookFigure(figsize=(9.5, 6.2), layout="constrained")
    panels: Any = [lungs, ["errors"] * len(lungs)]
    axes: Any = figure.subplot_mosaic(panels, height_ratios=(1.15, 1))
    cost: Any = envs.cost
    waveform = lung.BreathWaveform.at_pip(unstack(cost)[0].waveform, SHOWN)
    for i in lungs:
        ax = axes[i]
        for k, (label, runs) in enumerate(shown.items()):
            pressure = np.asarray(runs.states[i, :, cost.index])
            times = float(envs.dt[i]) * np.arange(len(pressure))
            ax.plot(times, pressure, color=_color(label, k), lw=1.5, label=label)
        times = np.linspace(0, 2.99, 600)
        target = np.asarray(waveform.pressure(times))
        ax.plot(times, target, color="0.2", lw=1, ls=(0, (4, 2)), label="target")
        style_axes(ax, size=_SIZE)
        ax.set(title=names[i], xlabel="time [s]", xlim=(0, 1.6))
    axes[lungs[0]].set_ylabel("pressure [cmH2O]")
    axes[lungs[-1]].legend()
    ax = axes["errors"]

    chosen = ("MLP for all", "MPC", "CNN", "PID + MLP", "MLP", "least error")
    of = lambda label: [mean_error(rows, label, "unseen", name) for name in names]
    errors = {label: of(label) for label in (*PID_ROWS, *chosen)}
    # The errors of controllers that were not run are NaN.
    bars = {"best PID": np.nanmin([errors[label] for label in PID_ROWS], axis=0)}
    bars |= {label: errors[label] for label in chosen if np.isfinite(errors[label][0])}
    colors = {label: _color(label, k) for k, label in enumerate(bars)}
    _draw_bars(ax, bars, colors | {"least error": NEUTRAL})
    ax.set_xticks(np.arange(count), names)
    ax.legend(ncols=len(bars), loc="upper center")
    most = 1.25 * float(np.max(list(bars.values())))
    ax.set(ylabel="mean |error| [cmH2O]", ylim=(0, most))
    return figure


def _draw_bars(ax: Axes, bars: dict[str, Any], colors: dict[str, str]) -> None:
    """Draw the bars of several labels side by side, in a group for each lung."""
    width = 0.8 / len(bars)
    for k, (label, values) in enumerate(bars.items()):
        place = np.arange(len(values)) + (k - (len(bars) - 1) / 2) * width
        ax.bar(place, values, width, color=colors[label], label=label)
    style_axes(ax, size=_SIZE)


def _color(label: str, index: int) -> str:
    """The colour of a controller, the same in all parts of the figure."""
    return color_of(_ORDER.index(label) if label in _ORDER else index)


@rc_context(_STYLE)
def simulator_figure(
    test: lung.Breaths, models: dict[str, Any], names: list[str], table: Rows
) -> NotebookFigure:
    """A test breath as the simulators predict it, and the errors of the simulators."""
    figure = NotebookFigure(figsize=(9.5, 3.6), layout="constrained")
    left, right = figure.subplots(1, 2, width_ratios=(1, 1.5))
    middle = len(names) // 2
    # A breath that reaches about 30 cmH2O.
    breath = int(np.argmin(np.abs(np.max(test.pressure[middle], axis=-1) - 30)))
    u, read = test.u_in[middle, breath], np.asarray(test.pressure[middle, breath])
    times = float(np.ravel(test.dt)[0]) * np.arange(len(u))
    left.plot(times, read, ".", color=NEUTRAL, ms=4, label="read")
    if test.truth is not None:
        truth = np.asarray(test.truth[middle, breath])
        left.plot(times, truth, color="0.2", lw=1, label="true")
    for k, (label, model) in enumerate(models.items()):
        if label in ("learned", "single compartment", "balloon"):
            predict = eqx.filter_jit(unstack(model)[middle].predict)
            pressure = np.asarray(predict(u))
            left.plot(times, pressure, color=color_of(k), lw=1.5, label=label)
    left.set(xlabel="time [s]", ylabel="pressure [cmH2O]")
    left.set_title(f"{names[middle]}, from its controls alone")
    left.legend()
    style_axes(left, size=_SIZE)
    errors = {(row["simulator"], row["lung"]): row["mae"] for row in table}
    bars = {label: [errors[label, name] for name in names] for label in models}
    _draw_bars(right, bars, {label: color_of(k) for k, label in enumerate(models)})
    right.set(yscale="log", ylabel="open-loop mean |error| [cmH2O]")
    right.set_xticks(np.arange(len(names)), names, rotation=30)
    right.set_ylim(top=4 * max(errors.values()))
    right.legend(ncols=3, loc="upper center")
    return figure


def draw_breath(path: Path, envs: Environment, runs: Any) -> None:
    """Save an animation of a breath in the middle one of the lungs."""
    middle = len(envs.dt) // 2
    env = lung.BreathWaveform.at_pip(unstack(envs)[middle], SHOWN)
    animate(env, unstack(runs)[middle], path=path, max_frames=40)
