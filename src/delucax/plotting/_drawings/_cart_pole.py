"""The cart and the pole on it."""

import math
from typing import Any

import numpy as np
from matplotlib.axes import Axes

from ...environments import Environment
from ...simulation import Trajectory
from ...systems import CartPole
from .._figure import NEUTRAL
from ._parts import (
    body,
    box,
    disc,
    finite_states,
    ground,
    joint,
    largest_controls,
    link,
    push,
    SECOND,
    shares,
    View,
    wheel,
)
from ._registry import add_linear_drawing, Drawing, register_drawing, system_of


# Of the cart, in lengths of the pole.
WIDTH, HEIGHT, WHEEL = 0.56, 0.26, 0.08
HINGE = WHEEL + HEIGHT


def _track(
    ax: Axes,
    environment: Environment,
    trajectory: Trajectory,
    length: float,
    angles: np.ndarray,
) -> dict[str, Any]:
    """The track, its ends where the task has some, and how far to see."""
    ground(ax)
    end = getattr(environment.terminated, "max_position", None)
    if end is None:
        positions = np.abs(finite_states(trajectory)[:, 0]).max(initial=0.0)
        reach = float(np.clip(positions, 1.2 * length, 2.5 * length))
    else:
        reach = float(end)
        for side in (-reach, reach):
            ax.plot([side, side], [-0.12 * length, 0.12 * length], color=NEUTRAL, lw=2)
    hangs = np.cos(angles).min(initial=1.0) < 0.3
    low = HINGE - 1.2 if hangs else -0.3
    low, high = low * length, (HINGE + 1.2) * length
    half = np.array([reach + 0.5 * WIDTH * length, (high - low) / 2])
    view = View(np.array([0.0, (high + low) / 2]), half)
    view.show(ax)
    return {
        "length": length,
        "largest_force": float(largest_controls(environment, trajectory)[0]),
        "view": view,
    }


def setup_cart_pole(
    ax: Axes, environment: Environment, trajectory: Trajectory
) -> dict[str, Any]:
    """The track of the cart."""
    length = 2 * float(system_of(environment).half_length)
    angles = finite_states(trajectory)[:, 2]
    return _track(ax, environment, trajectory, length, angles)


def _draw(
    ax: Axes,
    position: float,
    angle: float,
    u: np.ndarray,
    length: float,
    largest_force: float,
    view: View,
) -> np.ndarray:
    """The cart, its force, and a pole that leans to the right by `angle`; returns the
    tip of the pole."""
    width, radius = WIDTH * length, WHEEL * length
    hinge = np.array([position, HINGE * length])
    middle = radius + HEIGHT * length / 2
    body(ax, box(width, HEIGHT * length, 0.05 * length), (position, middle))
    for side in (-0.27, 0.27):
        wheel(ax, (position + side * width * 1.1, radius), radius)
    tip = hinge + length * np.array([math.sin(angle), math.cos(angle)])
    link(ax, hinge, tip, color=SECOND, width=7, zorder=3)
    joint(ax, hinge, 0.045 * length)
    share = float(shares(u, largest_force)[0])
    side = position + math.copysign(width / 2 + 0.04 * length, share)
    push(ax, (side, middle), (0.6 * length * share, 0.0), 0.6 * length)
    view.follow(ax, (position, view.centre[1]), 0.5 * width)
    return tip


def draw_cart_pole(
    ax: Axes,
    x: np.ndarray,
    u: np.ndarray,
    length: float,
    largest_force: float,
    view: View,
) -> None:
    """A pole that leans to the right for positive angles."""
    _draw(ax, float(x[0]), float(x[2]), u, length, largest_force, view)


def setup_linear_cart_pole(
    ax: Axes, environment: Environment, trajectory: Trajectory
) -> dict[str, Any]:
    """The track of the cart. The length of the rod is found in how much more a force
    accelerates the cart than the angle."""
    B = np.asarray(system_of(environment).B, float).reshape(-1, 4, 1)
    cart, turning = B[0, 2:, 0]
    length = float(cart / turning) if turning * cart > 0 else 1.0
    angles = np.zeros(1)  # near the upright is all that it is true of
    return _track(ax, environment, trajectory, length, angles)


def draw_linear_cart_pole(
    ax: Axes,
    x: np.ndarray,
    u: np.ndarray,
    length: float,
    largest_force: float,
    view: View,
) -> None:
    """A rod with a mass at its tip, which leans to the left for positive angles."""
    tip = _draw(ax, float(x[0]), -float(x[1]), u, length, largest_force, view)
    disc(ax, tip, 0.09 * length, color=SECOND, zorder=3)


register_drawing(CartPole, draw_cart_pole, setup_cart_pole)
add_linear_drawing(
    Drawing(draw_linear_cart_pole, setup_linear_cart_pole),
    ("position", "angle", "velocity", "spin"),
    ("force",),
)
