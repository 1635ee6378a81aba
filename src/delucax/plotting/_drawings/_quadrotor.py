"""The quadrotor in space, seen from aside and above."""

import math
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection

from ...environments import Environment
from ...simulation import Trajectory
from ...systems import Quadrotor
from .._figure import color_of, NEUTRAL
from ._parts import (
    BODY,
    body,
    disc,
    finite_states,
    largest_controls,
    link,
    mark,
    push,
    SECOND,
    shares,
    target_of,
    View,
)
from ._registry import add_drawing, Drawing, system_of


AZIMUTH, ELEVATION = math.radians(-62), math.radians(24)  # of the eye, far away
EYE = np.array(
    [
        [-math.sin(AZIMUTH), math.cos(AZIMUTH), 0.0],
        [
            -math.cos(AZIMUTH) * math.sin(ELEVATION),
            -math.sin(AZIMUTH) * math.sin(ELEVATION),
            math.cos(ELEVATION),
        ],
    ]
)
FRONT = color_of(4)
# Front, left, back and right, as the thrusts are ordered.
ARMS = np.array([[1, 0, 0], [0, 1, 0], [-1, 0, 0], [0, -1, 0]], float)
RIM = np.array(
    [[np.cos(a), np.sin(a), 0.0] for a in np.linspace(0, 2 * np.pi, 33)[:-1]]
)


def seen(points: np.ndarray) -> np.ndarray:
    """Points in space, `(..., 3)`, as they lie in the picture, `(..., 2)`."""
    return points @ EYE.T


def attitude(x: np.ndarray) -> np.ndarray:
    """The rotation matrix from body to world of a state."""
    w, a, b, c = x[3:7] / (np.linalg.norm(x[3:7]) or 1.0)
    return np.array(
        [
            [1 - 2 * (b * b + c * c), 2 * (a * b - w * c), 2 * (a * c + w * b)],
            [2 * (a * b + w * c), 1 - 2 * (a * a + c * c), 2 * (b * c - w * a)],
            [2 * (a * c - w * b), 2 * (b * c + w * a), 1 - 2 * (a * a + b * b)],
        ]
    )


def setup_quadrotor(
    ax: Axes, environment: Environment, trajectory: Trajectory
) -> dict[str, Any]:
    """A floor with a grid, and the goal above it."""
    system = system_of(environment)
    path = finite_states(trajectory)[:, :3]
    target = target_of(environment)
    if target is not None:
        path = np.concatenate([path, target[None, :3]])
    arm = float(system.arm)
    low, high = path.min(axis=0), path.max(axis=0)
    middle = target[:3] if target is not None else path[0]
    half = np.clip(0.5 * np.max(high - low) + 2 * arm, 5 * arm, 15 * arm)
    centre = np.where(high - low < 2 * half, (low + high) / 2, middle)
    floor = float(max(low[2], centre[2] - half) - 2.5 * arm)

    ticks = np.linspace(-half, half, 7)
    ends = np.array([-half, half])
    lines = []
    for tick in ticks:
        for across in (np.full(2, tick), ends), (ends, np.full(2, tick)):
            flat = np.stack([*across, np.zeros(2)], axis=-1)
            lines.append(seen(flat + [*centre[:2], floor]))
    grid = LineCollection(lines, colors=NEUTRAL, alpha=0.3, linewidths=0.8, zorder=0)
    ax.add_collection(grid, autolim=False)
    drawn = max(arm, 0.16 * float(half))  # seen from afar it is drawn larger
    if target is not None:
        foot = np.array([*target[:2], floor])
        stem = seen(np.stack([foot, target[:3]]))
        ax.plot(*stem.T, color=NEUTRAL, lw=1, ls=(0, (3, 3)), zorder=0)
        mark(ax, seen(target[:3]), 0.35 * drawn)
    near = np.clip(path, centre - half, centre + half)
    corners = np.concatenate([*lines, seen(near) + [0, 2.5 * drawn]])
    low, high = corners.min(axis=0), corners.max(axis=0)
    view = View((low + high) / 2, 0.52 * (high - low))
    view.show(ax)
    largest = largest_controls(environment, trajectory)
    rotors = system.inputs == "rotors"
    keywords = {"arm": drawn, "floor": floor, "view": view, "rotors": rotors}
    return {**keywords, "largest": largest if rotors else largest[0]}


def draw_quadrotor(
    ax: Axes,
    x: np.ndarray,
    u: np.ndarray,
    arm: float,
    floor: float,
    view: View,
    rotors: bool,
    largest: Any,
) -> None:
    """Two crossed arms with four rotors, the front one in amber; their thrusts, or the
    thrust of all; and the shadow on the floor."""
    place, turned = np.asarray(x[:3], float), attitude(x)
    hubs = place + arm * ARMS @ turned.T
    discs = [hub + 0.48 * arm * (RIM + [0, 0, 0.3]) @ turned.T for hub in hubs]
    for rotor in (*discs, place + 0.3 * arm * RIM @ turned.T):
        flat = rotor * [1, 1, 0] + [0, 0, floor]
        body(ax, seen(flat), color=NEUTRAL, alpha=0.3, zorder=1)
    # What is farther away is drawn first.
    away = np.cross(EYE[0], EYE[1])
    order = np.argsort(hubs @ away)
    for i in order:
        color = FRONT if i == 0 else BODY
        link(ax, seen(place), seen(hubs[i]), color=color, width=5)
    disc(ax, seen(place), 0.24 * arm, zorder=2)
    for i in order:
        color = FRONT if i == 0 else SECOND
        body(ax, seen(discs[i]), color=color, alpha=0.65)
    up = turned[:, 2]
    if rotors:
        for i in order:
            share = float(shares(u, largest)[i])
            start = hubs[i] + 0.2 * arm * up
            push(ax, seen(start), seen(2.8 * arm * share * up), 2.0 * arm)
    else:
        share = float(shares(u[:1], largest)[0])
        push(ax, seen(place + 0.2 * arm * up), seen(3 * arm * share * up), 2 * arm)
    view.follow(ax, seen(place), 1.5 * arm)


def trace_quadrotor(states: np.ndarray, **keywords: Any) -> np.ndarray:
    """Where it has flown, in the picture."""
    return seen(states[:, :3])


add_drawing(Drawing(draw_quadrotor, setup_quadrotor, trace_quadrotor), Quadrotor)
