"""The car in its valley."""

import math

import numpy as np

from ..figures import NEUTRAL
from ._canvas import box, Canvas, GOAL, rotation, SECOND
from ._drawing import Drawing, Episode, Vector


LENGTH, HEIGHT, WHEEL = 0.17, 0.06, 0.028


def mountain_car(canvas: Canvas, episode: Episode) -> Drawing:
    """The car on the slope, pushed along it, between hills and walls, and a flag at
    the goal."""
    ax, environment = canvas.ax, episode.environment
    positions = episode.states[:, 0]
    low = getattr(environment.dynamics, "min_position", -1.2)
    high = getattr(environment.dynamics, "max_position", 0.6)
    low = max(min(float(low), positions.min()), -4.0) - 0.1
    high = min(max(float(high), positions.max()), 4.0) + 0.1
    xs = np.linspace(low, high, 300)
    ys = np.asarray(episode.system.height(xs), float)
    slopes = np.gradient(ys, xs)
    floor = ys.min() - 0.12
    ax.fill_between(xs, ys, floor, color=NEUTRAL, alpha=0.18, lw=0)
    ax.plot(xs, ys, color=NEUTRAL, lw=2)
    goal = getattr(environment.terminated, "goal_position", None)
    if goal is not None:
        foot = np.array([float(goal), float(np.interp(float(goal), xs, ys))])
        canvas.line([foot, foot + [0, 0.26]], color=NEUTRAL, lw=2)
        flag = np.array([(0, 0.26), (0.13, 0.21), (0, 0.16)])
        canvas.polygon(flag, foot, color=GOAL, zorder=1)
    ax.set(xlim=(low, high), ylim=(floor, ys.max() + 0.3))

    def draw(x: Vector, u: Vector) -> None:
        place = float(x[0])
        foot = np.array([place, np.interp(place, xs, ys)])
        angle = math.atan(np.interp(place, xs, slopes))
        turned = rotation(angle)
        for side in (-0.28, 0.28):
            canvas.wheel(foot + turned @ (side * LENGTH, WHEEL), WHEEL)
        middle = foot + turned @ (0.0, 1.4 * WHEEL + HEIGHT / 2)
        canvas.polygon(box(LENGTH, HEIGHT, 0.02), middle, angle)
        cabin = np.array([[-0.4, 0], [0.3, 0], [0.15, 1], [-0.28, 1]])
        roof = cabin * [LENGTH, 0.75 * HEIGHT] + [0.0, HEIGHT / 2]
        canvas.polygon(roof, middle, angle, SECOND)
        share = float(episode.shares(u)[0])
        end = turned @ (math.copysign(LENGTH / 2 + 0.015, share), 0.0)
        canvas.force(middle + end, turned @ (0.22 * share, 0.0), 0.22)

    return Drawing(draw)
