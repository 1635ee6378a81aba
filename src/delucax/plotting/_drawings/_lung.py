"""A lung that fills, and the valves that fill and empty it."""

import numpy as np

from ..figures import NEUTRAL
from ._canvas import ACTION, BODY, Canvas, GOAL, SECOND, SHORT_DASHES
from ._drawing import Drawing, Episode, Vector


_VOLUMES = ("volume", "fast", "slow")
_PRESSURES = ("sensed pressure", "pipe", "pressure")
_SCALE = 60.0  # cmH2O at the top of the gauge
_WINDOW = 6  # that of a learned lung, unless another is given
# What the states of a lung may be called, which says that it is one.
STATE_NAMES = (
    ("inflow", "opening", "volume"),
    ("inflow", "opening", "fast", "slow"),
    ("inflow", "opening", "pipe", "volume"),
    (
        *(f"u_in[-{i + 1}]" for i in range(_WINDOW)),
        "pressure",
        *(f"pressure[-{i}]" for i in range(1, _WINDOW)),
        "step",
    ),
)


def lung(canvas: Canvas, episode: Episode) -> Drawing:
    """The lung as it is full, the gauge of the pressure with the levels asked for, and
    how far the valves are open."""
    environment, states = episode.environment, episode.states
    names = list(environment.dynamics.state_names)
    pressure = next((names.index(name) for name in _PRESSURES if name in names), 0)
    parts = [names.index(name) for name in _VOLUMES if name in names] or [pressure]
    low, high = states[:, parts].min(axis=0), states[:, parts].max(axis=0)
    span = np.where(high > low, high - low, 1.0)
    single = len(parts) == 1
    centres = [(0.0, 0.0)] if single else [(-0.5, 0.0), (0.5, 0.0)]
    largest = 0.95 if single else 0.55

    pipe = [(0, 0.95), (0, 1.45)]
    canvas.line(pipe, color=NEUTRAL, lw=9, solid_capstyle="butt", zorder=1)
    gauge = {"fill": False, "ec": NEUTRAL, "lw": 1.5, "zorder": 3}
    canvas.rectangle((1.25, -0.9), 0.22, 2.3, **gauge)
    waveform = getattr(environment.cost, "waveform", None)
    if waveform is not None:
        for level in (float(waveform.pip), float(waveform.peep)):
            height = -0.9 + 2.3 * level / _SCALE
            ends = [(1.13, height), (1.59, height)]
            canvas.line(ends, color=GOAL, lw=2, ls=SHORT_DASHES)
    canvas.ax.set(xlim=(-1.6, 1.75), ylim=(-1.2, 1.75))

    def draw(x: Vector, u: Vector) -> None:
        full = np.clip((x[parts] - low) / span, 0, 1)
        for centre, share, color in zip(centres, full, (BODY, SECOND), strict=False):
            canvas.disc(centre, largest * (0.6 + 0.4 * share), color)
        height = 2.3 * float(np.clip(x[pressure] / _SCALE, 0, 1))
        level = {"color": BODY, "lw": 0, "alpha": 0.75, "zorder": 2}
        canvas.rectangle((1.25, -0.9), 0.22, height, **level)
        inflow = 0.6 * float(np.clip(u[0] / 100, 0, 1)) if len(u) else 0.0
        out = 0.6 * float(np.clip(u[1], 0, 1)) if len(u) > 1 else 0.0
        if inflow > 0.005:
            _draw_flow(canvas, -0.85, inflow - 0.85, ACTION)
        if out > 0.005:
            _draw_flow(canvas, 0.85 - out, 0.85, NEUTRAL)

    return Drawing(draw)


def _draw_flow(canvas: Canvas, start: float, end: float, color: str) -> None:
    """An arrow to the right, above the lung."""
    arrow = {"arrowstyle": "-|>", "color": color, "lw": 3}
    canvas.ax.annotate(
        "", xy=(end, 1.5), xytext=(start, 1.5), arrowprops=arrow, zorder=4
    )
