"""The quadrotor in space, seen from aside and above."""

import math

import numpy as np
from jaxtyping import Float
from matplotlib.collections import LineCollection

from ..figures import color_of, NEUTRAL
from ._canvas import BODY, Canvas, SECOND, View
from ._drawing import Drawing, Episode, Vector


AZIMUTH, ELEVATION = math.radians(-62), math.radians(24)  # of the eye, far away
HORIZONTAL = np.array([math.cos(AZIMUTH), math.sin(AZIMUTH), 0.0])
RIGHT = np.array([-math.sin(AZIMUTH), math.cos(AZIMUTH), 0.0])
UP = -math.sin(ELEVATION) * HORIZONTAL + np.array([0.0, 0.0, math.cos(ELEVATION)])
SCREEN = np.stack([RIGHT, UP])  # the axes of the picture, in space
FRONT = color_of(4)
# Front, left, back and right, as the thrusts are ordered.
ARMS = np.array([[1, 0, 0], [0, 1, 0], [-1, 0, 0], [0, -1, 0]], float)
RIM = np.array(
    [[np.cos(a), np.sin(a), 0.0] for a in np.linspace(0, 2 * np.pi, 33)[:-1]]
)


def projected(points: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n 2"]:
    """Points in space as they lie in the picture."""
    return points @ SCREEN.T


def attitude(x: Vector) -> Float[np.ndarray, "3 3"]:
    """The rotation matrix from body to world of a state."""
    w, a, b, c = x[3:7] / (np.linalg.norm(x[3:7]) or 1.0)
    return np.array(
        [
            [1 - 2 * (b * b + c * c), 2 * (a * b - w * c), 2 * (a * c + w * b)],
            [2 * (a * b + w * c), 1 - 2 * (a * a + c * c), 2 * (b * c - w * a)],
            [2 * (a * c - w * b), 2 * (b * c + w * a), 1 - 2 * (a * a + b * b)],
        ]
    )


def quadrotor(canvas: Canvas, episode: Episode) -> Drawing:
    """Two crossed arms with four rotors, the front one in amber; their thrusts, or the
    thrust of all; a floor with a grid and the shadow on it, and the goal above it."""
    system, target = episode.system, episode.target
    visited = episode.visited((0, 1, 2))
    length = float(system.arm)
    low, high = visited.min(axis=0), visited.max(axis=0)
    middle = target[:3] if target is not None else visited[0]
    half = np.clip(0.5 * np.max(high - low) + 2 * length, 5 * length, 15 * length)
    centre = np.where(high - low < 2 * half, (low + high) / 2, middle)
    floor = float(max(low[2], centre[2] - half) - 2.5 * length)
    arm = max(length, 0.16 * float(half))  # seen from afar it is drawn larger

    ends = np.array([-half, half])
    lines = []
    for tick in np.linspace(-half, half, 7):
        for across in (np.full(2, tick), ends), (ends, np.full(2, tick)):
            flat = np.stack([*across, np.zeros(2)], axis=-1)
            lines.append(projected(flat + [*centre[:2], floor]))
    grid = LineCollection(lines, colors=NEUTRAL, alpha=0.3, linewidths=0.8, zorder=0)
    canvas.ax.add_collection(grid, autolim=False)
    if target is not None:
        stem = projected(np.stack([[*target[:2], floor], target[:3]]))
        canvas.line(stem, color=NEUTRAL, lw=1, ls=(0, (3, 3)), zorder=0)
        canvas.goal(projected(target[:3]), 0.35 * arm)
    near = np.clip(visited, centre - half, centre + half)
    corners = np.concatenate([*lines, projected(near) + [0, 2.5 * arm]])
    low, high = corners.min(axis=0), corners.max(axis=0)
    view = View((low + high) / 2, 0.52 * (high - low))
    view.show(canvas.ax)

    def draw(x: Vector, u: Vector) -> None:
        place, turned = np.asarray(x[:3], float), attitude(x)
        hubs = place + arm * ARMS @ turned.T
        discs = [hub + 0.48 * arm * (RIM + [0, 0, 0.3]) @ turned.T for hub in hubs]
        for rotor in (*discs, place + 0.3 * arm * RIM @ turned.T):
            shadow = projected(rotor * [1, 1, 0] + [0, 0, floor])
            canvas.polygon(shadow, color=NEUTRAL, alpha=0.3, zorder=1)
        # What is farther away is drawn first.
        order = np.argsort(hubs @ np.cross(RIGHT, UP))
        for i in order:
            color = FRONT if i == 0 else BODY
            canvas.link(projected(place), projected(hubs[i]), width=5, color=color)
        canvas.disc(projected(place), 0.24 * arm)
        for i in order:
            color = FRONT if i == 0 else SECOND
            canvas.polygon(projected(discs[i]), color=color, alpha=0.65)
        up, shares = turned[:, 2], episode.shares(u)
        if system.inputs == "rotors":
            thrusts = [(hubs[i], 2.8 * arm * shares[i]) for i in order]
        else:
            thrusts = [(place, 3 * arm * shares[0])]
        for foot, thrust in thrusts:
            start, along = projected(foot + 0.2 * arm * up), projected(thrust * up)
            canvas.force(start, along, 2 * arm)
        view.follow(canvas.ax, projected(place), 1.5 * arm)

    return Drawing(draw, lambda states: projected(states[:, :3]))
