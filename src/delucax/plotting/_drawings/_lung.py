"""A lung that fills, and the valves that fill and empty it."""

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.patches import Circle, Rectangle

from ...environments import Environment
from ...simulation import Trajectory
from .._figure import NEUTRAL
from ._parts import ACTION, BODY, finite_states, GOAL, SECOND
from ._registry import add_linear_drawing, Drawing


_VOLUMES = ("volume", "fast", "slow")
_SCALE = 60.0  # cmH2O at the top of the gauge


def setup_lung(
    ax: Axes, environment: Environment, trajectory: Trajectory
) -> dict[str, Any]:
    """The windpipe, the gauge of the pressure, and the levels asked for."""
    names = list(environment.dynamics.state_names)
    wanted = ("sensed pressure", "pipe", "pressure")
    pressure = next((names.index(name) for name in wanted if name in names), 0)
    states = finite_states(trajectory)
    volumes = [names.index(name) for name in _VOLUMES if name in names]
    parts = volumes or [pressure]
    low, high = states[:, parts].min(axis=0), states[:, parts].max(axis=0)
    ax.plot([0, 0], [0.95, 1.45], color=NEUTRAL, lw=9, solid_capstyle="butt", zorder=1)
    ax.add_artist(
        Rectangle((1.25, -0.9), 0.22, 2.3, fill=False, ec=NEUTRAL, lw=1.5, zorder=3)
    )
    waveform = getattr(environment.cost, "waveform", None)
    if waveform is not None:
        for level in (float(waveform.pip), float(waveform.peep)):
            height = -0.9 + 2.3 * level / _SCALE
            ax.plot([1.13, 1.59], [height] * 2, color=GOAL, lw=2, ls=(0, (3, 2)))
    ax.set(xlim=(-1.6, 1.75), ylim=(-1.2, 1.75))
    return {"pressure": pressure, "parts": parts, "low": low, "high": high}


def draw_lung(
    ax: Axes,
    x: np.ndarray,
    u: np.ndarray,
    pressure: int,
    parts: list[int],
    low: np.ndarray,
    high: np.ndarray,
) -> None:
    """The lung as it is full, the pressure, and how far the valves are open."""
    span = np.where(high > low, high - low, 1.0)
    full = np.clip((x[parts] - low) / span, 0, 1)
    centres = [(0.0, 0.0)] if len(parts) == 1 else [(-0.5, 0.0), (0.5, 0.0)]
    largest = 0.95 if len(parts) == 1 else 0.55
    for centre, share, color in zip(centres, full, (BODY, SECOND), strict=False):
        ax.add_artist(
            Circle(centre, largest * (0.6 + 0.4 * share), color=color, lw=0, zorder=2)
        )
    height = 2.3 * float(np.clip(x[pressure] / _SCALE, 0, 1))
    ax.add_artist(
        Rectangle((1.25, -0.9), 0.22, height, color=BODY, lw=0, alpha=0.75, zorder=2)
    )
    inflow = 0.6 * float(np.clip(u[0] / 100, 0, 1)) if len(u) else 0.0
    out = 0.6 * float(np.clip(u[1], 0, 1)) if len(u) > 1 else 0.0
    for share, sign, color in ((inflow, -1, ACTION), (out, 1, NEUTRAL)):
        if share > 0.005:
            tail = (sign * 0.85, 1.5)
            head = (sign * (0.85 - share), 1.5)
            ends = (head, tail) if sign > 0 else (tail, head)
            ax.annotate(
                "",
                xy=ends[1],
                xytext=ends[0],
                arrowprops={"arrowstyle": "-|>", "color": color, "lw": 3},
                zorder=4,
            )


_CONTROLS = ("u_in", "u_out")
_WINDOW = 6  # that of a learned lung, unless another is given
_LEARNED = (
    *(f"u_in[-{i + 1}]" for i in range(_WINDOW)),
    "pressure",
    *(f"pressure[-{i}]" for i in range(1, _WINDOW)),
    "step",
)
for _states in (
    ("inflow", "opening", "volume"),
    ("inflow", "opening", "fast", "slow"),
    ("inflow", "opening", "pipe", "volume"),
    _LEARNED,
):
    add_linear_drawing(Drawing(draw_lung, setup_lung), _states, _CONTROLS)
