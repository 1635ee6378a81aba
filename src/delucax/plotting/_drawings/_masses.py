"""Masses on a line: free, and on springs and dampers."""

import math
from typing import Any

import numpy as np
from matplotlib.axes import Axes

from ...environments import Environment
from ...simulation import Trajectory
from ...systems import DoubleIntegrator, MassSpringDamper
from .._figure import NEUTRAL
from ._parts import (
    body,
    box,
    DARK,
    finite_states,
    GOAL,
    ground,
    largest_controls,
    push,
    shares,
    View,
    wheel,
)
from ._registry import register_drawing, system_of


COILS = 6


def _pushed(ax: Axes, at: float, side: float, share: float) -> None:
    """The force on a mass of a size, at its side."""
    start = at + math.copysign(0.58 * side, share)
    push(ax, (start, 0.65 * side), (1.5 * side * share, 0.0), 1.5 * side)


def _mass(ax: Axes, at: float, side: float) -> None:
    """A block on two rollers."""
    body(ax, box(side, 0.9 * side, 0.08 * side), (at, 0.65 * side))
    for place in (-0.28, 0.28):
        wheel(ax, (at + place * side, 0.1 * side), 0.1 * side)


def setup_double_integrator(
    ax: Axes, environment: Environment, trajectory: Trajectory
) -> dict[str, Any]:
    """The line, and a mark at its origin."""
    reach = np.abs(finite_states(trajectory)[:, 0]).max(initial=0.0)
    reach = float(np.clip(reach, 0.5, 10.0))
    side = 0.3 * reach
    ground(ax)
    ax.plot([0], [-0.25 * side], marker="^", color=GOAL, markersize=11)
    half = np.array([1.35 * reach + side, 1.2 * side])
    view = View(np.array([0.0, 0.5 * side]), half)
    view.show(ax)
    return {
        "side": side,
        "largest_force": float(largest_controls(environment, trajectory)[0]),
        "view": view,
    }


def draw_double_integrator(
    ax: Axes,
    x: np.ndarray,
    u: np.ndarray,
    side: float,
    largest_force: float,
    view: View,
) -> None:
    """A mass that rolls along the line."""
    place = float(x[0])
    _mass(ax, place, side)
    _pushed(ax, place, side, float(shares(u, largest_force)[0]))
    view.follow(ax, (place, view.centre[1]), side)


def setup_mass_spring_damper(
    ax: Axes, environment: Environment, trajectory: Trajectory
) -> dict[str, Any]:
    """The wall and the floor, and where the masses rest."""
    count = int(system_of(environment).masses)
    places = finite_states(trajectory)[:, :count]
    stretch = np.abs(np.diff(places, axis=1, prepend=0.0)).max(initial=0.0)
    stretch = float(stretch) if stretch > 0 else 1.0
    side = 0.75 * stretch
    rest = (side + 1.6 * stretch) * np.arange(1, count + 1) - side / 2
    ground(ax)
    ax.plot([0, 0], [0, 1.35 * side], color=NEUTRAL, lw=2)
    for height in np.linspace(0.1, 1.25, 6) * side:  # the wall's hatching
        ends = [height - 0.18 * side, height]
        ax.plot([-0.18 * side, 0], ends, color=NEUTRAL, lw=1, alpha=0.6)
    ax.plot(rest, np.full(count, -0.22 * side), "^", color=GOAL, markersize=11)
    right = rest[-1] + float(places[:, -1].max(initial=0.0)) + 2.3 * side
    ax.set(xlim=(-0.4 * side, right), ylim=(-0.7 * side, 1.7 * side))
    largest = float(largest_controls(environment, trajectory)[0])
    return {"rest": rest, "side": side, "largest_force": largest}


def spring(start: float, end: float, height: float, swing: float) -> np.ndarray:
    """The corners of a zigzag between two places on a line, shape `(n, 2)`."""
    lead = 0.12 * (end - start)
    xs = np.linspace(start + lead, end - lead, 2 * COILS + 1)
    ys = height + swing * np.array([0, *[1, -1] * COILS])[: 2 * COILS + 1]
    ys[-1] = height
    return np.array([[start, height], *zip(xs, ys, strict=True), [end, height]])


def _damper(
    ax: Axes, start: float, end: float, height: float, rest: float, size: float
) -> None:
    """A cup on the left and a piston on the right, which moves in it."""
    near, far = start + 0.12 * rest, start + 0.34 * rest
    cup = np.array([[far, size], [near, size], [near, -size], [far, -size]])
    share = np.clip((end - start) / rest - 0.3, 0.05, 1.3) / 1.4
    plate = near + share * (far - near)
    for points in (
        cup + [0, height],
        np.array([[start, height], [near, height]]),
        np.array([[plate, height + 0.7 * size], [plate, height - 0.7 * size]]),
        np.array([[plate, height], [end, height]]),
    ):
        ax.plot(*points.T, color=NEUTRAL, lw=1.6, zorder=1)


def draw_mass_spring_damper(
    ax: Axes,
    x: np.ndarray,
    u: np.ndarray,
    rest: np.ndarray,
    side: float,
    largest_force: float,
) -> None:
    """The chain from the wall, with the force on its last mass."""
    left, gap = 0.0, float(rest[0]) - side / 2
    for place in rest + x[: len(rest)]:
        right = float(place) - side / 2
        zigzag = spring(left, right, 0.85 * side, 0.14 * side)
        ax.plot(*zigzag.T, color=DARK, lw=1.8, zorder=1)
        _damper(ax, left, right, 0.42 * side, gap, 0.12 * side)
        _mass(ax, float(place), side)
        left = float(place) + side / 2
    last = float(rest[-1] + x[len(rest) - 1])
    _pushed(ax, last, side, float(shares(u, largest_force)[0]))


register_drawing(DoubleIntegrator, draw_double_integrator, setup_double_integrator)
register_drawing(MassSpringDamper, draw_mass_spring_damper, setup_mass_spring_damper)
