"""Cars as bicycles, from above, on a road along x."""

import math

import numpy as np

from ..figures import NEUTRAL
from ._canvas import box, Canvas, DARK, GOAL, rotation, View
from ._drawing import Drawing, Episode, Vector


LANES = 3


def car(canvas: Canvas, episode: Episode) -> Drawing:
    """A car with its front wheels steered, and its acceleration, on a road of three
    lanes, the middle one along `y = 0`; the view goes along with it."""
    ax, system = canvas.ax, episode.system
    front, rear = float(system.front), float(system.rear)
    base = front + rear
    lane = 1.25 * base
    edge = LANES * lane / 2
    ax.axhspan(-edge, edge, color=NEUTRAL, alpha=0.13, lw=0)
    for side in (-edge, edge):
        ax.axhline(side, color=NEUTRAL, lw=2)
    ax.axhline(0, color=GOAL, lw=1.5, alpha=0.7, zorder=0)
    ys = episode.states[:, 1]
    reach = float(np.clip(np.abs(ys).max(initial=0.0) + base, 1.25 * edge, 3 * edge))
    half = np.array([4.2 * base, reach])
    View(np.zeros(2), half).show(ax)

    width = 0.64 * base
    hood, boot = front + 0.3 * base, -rear - 0.28 * base
    chassis = box(hood - boot, 0.88 * width, 0.16 * base)
    tyre = box(0.26 * base, 0.1 * base, 0.03 * base)

    def draw(x: Vector, u: Vector) -> None:
        place, heading = np.asarray(x[:2], float), float(x[2])
        turned = rotation(heading)
        middle = place[0] + 0.6 * base
        View(np.array([middle, 0.0]), half).follow(ax, (middle, place[1]), base)
        _draw_dashes(canvas, middle, float(half[0]), base)
        axis = place + turned @ ((hood + boot) / 2, 0.0)
        for along, steering in ((front, float(u[1])), (-rear, 0.0)):
            for side in (-0.48, 0.48):
                at = place + turned @ (along, side * width)
                canvas.polygon(tyre, at, heading + steering, DARK, zorder=3)
        canvas.polygon(chassis, axis, heading)
        for near, far, inner in ((0.28, 0.02, 0.3), (-0.62, -0.5, 0.32)):
            corners = [(near, -0.36), (far, -inner), (far, inner), (near, 0.36)]
            glass = np.array(corners) * [base, width]
            canvas.polygon(glass, axis, heading, "white", alpha=0.55, zorder=4)
        canvas.disc(place, 0.05 * base, "white", zorder=4)
        share = float(episode.shares(u)[0])
        start = place + turned @ ((hood if share > 0 else boot), 0.0)
        ahead = turned @ (math.copysign(0.12 * base, share), 0)
        canvas.force(start + ahead, turned @ (1.2 * base * share, 0), 1.2 * base)

    return Drawing(draw, lambda states: states[:, :2])


def _draw_dashes(canvas: Canvas, middle: float, half: float, base: float) -> None:
    """The dashes between the lanes, which stay where they are on the road."""
    pitch = 2.4 * base
    first = math.floor((middle - half) / pitch)
    last = math.ceil((middle + half) / pitch)
    starts = pitch * np.arange(first, last + 1)
    dash = np.stack([starts, starts + 0.45 * pitch, np.full_like(starts, np.nan)], -1)
    for k in range(1, LANES):
        height = (k - LANES / 2) * 1.25 * base
        heights = np.full(dash.size, height)
        canvas.ax.plot(dash.ravel(), heights, color="white", lw=2.5)
