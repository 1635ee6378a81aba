"""Cars as bicycles, from above, on a road along x."""

import math
from typing import Any

import numpy as np
from matplotlib.axes import Axes

from ...environments import Environment
from ...simulation import Trajectory
from ...systems import DynamicBicycle, KinematicBicycle
from .._figure import NEUTRAL
from ._parts import (
    body,
    box,
    DARK,
    disc,
    finite_states,
    GOAL,
    largest_controls,
    push,
    rotation,
    shares,
    View,
)
from ._registry import add_drawing, Drawing, system_of


LANES = 3


def setup_car(
    ax: Axes, environment: Environment, trajectory: Trajectory
) -> dict[str, Any]:
    """A road of three lanes, the middle one along `y = 0`."""
    system = system_of(environment)
    front, rear = float(system.front), float(system.rear)
    base = front + rear
    lane = 1.25 * base
    edge = LANES * lane / 2
    ax.axhspan(-edge, edge, color=NEUTRAL, alpha=0.13, lw=0)
    for side in (-edge, edge):
        ax.axhline(side, color=NEUTRAL, lw=2)
    ax.axhline(0, color=GOAL, lw=1.5, alpha=0.7, zorder=0)
    ys = finite_states(trajectory)[:, 1]
    reach = float(np.clip(np.abs(ys).max(initial=0.0) + base, 1.25 * edge, 3 * edge))
    view = View(np.zeros(2), np.array([4.2 * base, reach]))
    view.show(ax)
    largest = float(largest_controls(environment, trajectory)[0])
    return {
        "front": front,
        "rear": rear,
        "largest_acceleration": largest,
        "view": view,
    }


def draw_car(
    ax: Axes,
    x: np.ndarray,
    u: np.ndarray,
    front: float,
    rear: float,
    largest_acceleration: float,
    view: View,
) -> None:
    """The car with its front wheels steered, and its acceleration; the view goes along
    with it."""
    place, heading = np.asarray(x[:2], float), float(x[2])
    base, turned = front + rear, rotation(heading)
    middle = place[0] + 0.6 * base
    seen = View(np.array([middle, 0.0]), view.half)
    seen.follow(ax, (middle, place[1]), base)
    _lines(ax, middle, float(view.half[0]), base)

    width = 0.64 * base
    hood, boot = front + 0.3 * base, -rear - 0.28 * base
    axis = place + turned @ ((hood + boot) / 2, 0.0)
    tyre = box(0.26 * base, 0.1 * base, 0.03 * base)
    for along, steering in ((front, float(u[1])), (-rear, 0.0)):
        for side in (-0.48, 0.48):
            at = place + turned @ (along, side * width)
            body(ax, tyre, at, heading + steering, color=DARK, zorder=3)
    body(ax, box(hood - boot, 0.88 * width, 0.16 * base), axis, heading, zorder=2)
    glass = {"color": "white", "alpha": 0.55, "zorder": 4}
    for near, far, inner in ((0.28, 0.02, 0.3), (-0.62, -0.5, 0.32)):
        corners = [(near, -0.36), (far, -inner), (far, inner), (near, 0.36)]
        body(ax, np.array(corners) * [base, width], axis, heading, **glass)
    disc(ax, place, 0.05 * base, color="white", zorder=4)
    share = float(shares(u[:1], largest_acceleration)[0])
    start = place + turned @ ((hood if share > 0 else boot), 0.0)
    along = math.copysign(0.12 * base, share)
    push(ax, start + turned @ (along, 0), turned @ (1.2 * base * share, 0), 1.2 * base)


def _lines(ax: Axes, middle: float, half: float, base: float) -> None:
    """The dashes between the lanes, which stay where they are on the road."""
    pitch = 2.4 * base
    first = math.floor((middle - half) / pitch)
    last = math.ceil((middle + half) / pitch)
    starts = pitch * np.arange(first, last + 1)
    dash = np.stack([starts, starts + 0.45 * pitch, np.full_like(starts, np.nan)], -1)
    for k in range(1, LANES):
        height = (k - LANES / 2) * 1.25 * base
        ax.plot(dash.ravel(), np.full(dash.size, height), color="white", lw=2.5)


def trace_car(states: np.ndarray, **keywords: Any) -> np.ndarray:
    """Where it has driven."""
    return states[:, :2]


add_drawing(Drawing(draw_car, setup_car, trace_car), KinematicBicycle, DynamicBicycle)
