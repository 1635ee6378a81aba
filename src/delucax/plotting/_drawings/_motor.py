"""The synchronous motor, seen along its shaft by one who turns with its rotor."""

import math

import numpy as np
from matplotlib.patches import Wedge

from ..figures import color_of, NEUTRAL
from ._canvas import BODY, Canvas, FULL_TURN, GOAL, SECOND
from ._drawing import Drawing, Episode, Vector


ROTOR, GAP, STATOR, SPEED = 0.68, 0.76, 1.0, 1.16
CURRENT = color_of(4)


def motor(canvas: Canvas, episode: Episode) -> Drawing:
    """The stator, and the rotor with its magnets along d; the voltage and the current,
    as arrows in the plane of d and q, and the speed, as an arc about the stator."""
    ax, states, target = canvas.ax, episode.states, episode.target
    ax.set(xlim=(-1.4, 1.4), ylim=(-1.4, 1.4))
    ring = Wedge((0, 0), STATOR, 0, 360, width=STATOR - GAP, color=NEUTRAL, alpha=0.25)
    ax.add_artist(ring)
    canvas.circle((0, 0), ROTOR, color=NEUTRAL, alpha=0.12, lw=0)
    for start, color in ((-50, BODY), (130, SECOND)):
        style = {"width": 0.13, "color": color, "alpha": 0.8}
        ax.add_artist(Wedge((0, 0), ROTOR, start, start + 100, **style))
    for name, x, y in (("d", 1.0, 0.0), ("q", 0.0, 1.0)):
        ends = [(-0.5 * x, -0.5 * y), (0.5 * x, 0.5 * y)]
        canvas.line(ends, color=NEUTRAL, lw=1, alpha=0.5)
        style = {"size": 12, "ha": "center", "va": "center", "color": "0.25"}
        ax.text(0.88 * x, 0.88 * y, name, **style)
    largest = float(np.linalg.norm(states[:, :2], axis=1).max(initial=0.0)) or 1.0
    fastest = float(np.abs(episode.visited((2,))).max()) or 1.0
    if target is not None:
        angle = math.pi / 2 + FULL_TURN * float(target[2]) / fastest
        ray = np.array([math.cos(angle), math.sin(angle)])
        ends = [(SPEED - 0.12) * ray, (SPEED + 0.12) * ray]
        canvas.line(ends, color=GOAL, lw=3, zorder=4)

    def draw(x: Vector, u: Vector) -> None:
        share = float(np.clip(x[2] / fastest, -1, 1))
        canvas.torque((0, 0), SPEED, math.pi / 2, share, BODY, slimness=2.5)
        canvas.force((0, 0), 0.6 * episode.shares(u), 0.6, zorder=2)
        canvas.force((0, 0), 0.6 * x[:2] / largest, 0.6, CURRENT, zorder=3)
        canvas.joint((0, 0), 0.06)

    return Drawing(draw)
