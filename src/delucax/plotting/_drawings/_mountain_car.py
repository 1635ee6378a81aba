"""The car in its valley."""

import math
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.patches import Polygon

from ...environments import Environment
from ...simulation import Trajectory
from ...systems import MountainCar
from .._figure import NEUTRAL
from ._parts import (
    body,
    box,
    finite_states,
    GOAL,
    largest_controls,
    push,
    rotation,
    SECOND,
    shares,
    wheel,
)
from ._registry import register_drawing, system_of


LENGTH, HEIGHT, WHEEL = 0.17, 0.06, 0.028


def setup_mountain_car(
    ax: Axes, environment: Environment, trajectory: Trajectory
) -> dict[str, Any]:
    """The hills between the walls, and a flag at the goal."""
    system, dynamics = system_of(environment), environment.dynamics
    positions = finite_states(trajectory)[:, 0]
    low = min(float(getattr(dynamics, "min_position", -1.2)), positions.min())
    high = max(float(getattr(dynamics, "max_position", 0.6)), positions.max())
    low, high = max(low, -4.0) - 0.1, min(high, 4.0) + 0.1
    xs = np.linspace(low, high, 300)
    ys = np.asarray(system.height(xs), float)
    floor = ys.min() - 0.12
    ax.fill_between(xs, ys, floor, color=NEUTRAL, alpha=0.18, lw=0)
    ax.plot(xs, ys, color=NEUTRAL, lw=2)
    goal = getattr(environment.terminated, "goal_position", None)
    if goal is not None:
        place = float(goal)
        foot = float(np.interp(place, xs, ys))
        ax.plot([place, place], [foot, foot + 0.26], color=NEUTRAL, lw=2)
        flag = [(place, foot + 0.26), (place + 0.13, foot + 0.21), (place, foot + 0.16)]
        ax.add_artist(Polygon(flag, color=GOAL, lw=0))
    ax.set(xlim=(low, high), ylim=(floor, ys.max() + 0.3))
    largest = float(largest_controls(environment, trajectory)[0])
    return {"track": (xs, ys), "largest_push": largest}


def draw_mountain_car(
    ax: Axes,
    x: np.ndarray,
    u: np.ndarray,
    track: tuple[np.ndarray, np.ndarray],
    largest_push: float,
) -> None:
    """The car on the slope, pushed along it."""
    xs, ys = track
    place, slope = float(x[0]), np.gradient(ys, xs)
    foot = np.array([place, np.interp(place, xs, ys)])
    angle = math.atan(np.interp(place, xs, slope))
    turned = rotation(angle)
    for side in (-0.28, 0.28):
        wheel(ax, foot + turned @ (side * LENGTH, WHEEL), WHEEL)
    middle = foot + turned @ (0.0, 1.4 * WHEEL + HEIGHT / 2)
    body(ax, box(LENGTH, HEIGHT, 0.02), middle, angle)
    cabin = np.array([[-0.4, 0], [0.3, 0], [0.15, 1], [-0.28, 1]])
    roof = cabin * [LENGTH, 0.75 * HEIGHT] + [0.0, HEIGHT / 2]
    body(ax, roof, middle, angle, color=SECOND)
    share = float(shares(u, largest_push)[0])
    end = math.copysign(LENGTH / 2 + 0.015, share)
    reach = turned @ (0.22 * share, 0.0)
    push(ax, middle + turned @ (end, 0.0), reach, 0.22)


register_drawing(MountainCar, draw_mountain_car, setup_mountain_car)
