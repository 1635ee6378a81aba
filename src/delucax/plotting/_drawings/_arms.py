"""Links on hinges: the pendulum, the acrobot and the reacher."""

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.patches import Circle

from ...environments import Environment
from ...simulation import Trajectory
from ...systems import Acrobot, Pendulum, Reacher
from .._figure import NEUTRAL
from ._parts import (
    BODY,
    disc,
    GOAL,
    joint,
    largest_controls,
    link,
    mark,
    SECOND,
    shares,
    turn,
)
from ._registry import add_drawing, Drawing, register_drawing, system_of


def setup_pendulum(
    ax: Axes, environment: Environment, trajectory: Trajectory
) -> dict[str, Any]:
    """The circle that the tip goes round, with a tick where it is upright."""
    ax.set(xlim=(-1.25, 1.25), ylim=(-1.25, 1.25))
    ax.add_artist(Circle((0, 0), 1, fill=False, color=NEUTRAL, alpha=0.25, lw=1))
    ax.plot([0, 0], [1.06, 1.16], color=NEUTRAL, linewidth=2)
    return {"largest_torque": float(largest_controls(environment, trajectory)[0])}


def draw_pendulum(
    ax: Axes, x: np.ndarray, u: np.ndarray, largest_torque: float = 2.0
) -> None:
    """A rod of length 1 with a bob, hinged at the origin, angle 0 upright and growing
    anticlockwise; the torque is an arc of up to 240 degrees about the hinge."""
    angle = float(x[0])
    tip = np.array([-np.sin(angle), np.cos(angle)])
    link(ax, (0, 0), tip)
    disc(ax, tip, 0.11)
    turn(ax, (0, 0), 0.36, angle + np.pi / 2, float(shares(u, largest_torque)[0]))
    joint(ax, (0, 0), 0.055)


def _reach(ax: Axes, lengths: tuple[float, float]) -> float:
    """The view of an arm of two links, and the circle that it reaches."""
    reach = sum(lengths)
    edge = 1.2 * reach
    ax.set(xlim=(-edge, edge), ylim=(-edge, edge))
    circle = Circle((0, 0), reach, fill=False, color=NEUTRAL, alpha=0.25, lw=1)
    ax.add_artist(circle)
    return reach


def _draw_arm(ax: Axes, points: np.ndarray, reach: float, bob: float) -> None:
    """Two links through three points, with bobs on the last two."""
    link(ax, points[1], points[2], color=SECOND)
    link(ax, points[0], points[1])
    if bob:
        disc(ax, points[2], bob * reach, color=SECOND)
        disc(ax, points[1], bob * reach, color=BODY)
    for point in points[:2]:
        joint(ax, point, 0.028 * reach)


def setup_acrobot(
    ax: Axes, environment: Environment, trajectory: Trajectory
) -> dict[str, Any]:
    """The circle that the tip reaches, and the line above which it is to come."""
    system = system_of(environment)
    # The second link has no length: its centre of mass is taken for its middle.
    lengths = float(system.length_1), 2 * float(system.center_2)
    reach = _reach(ax, lengths)
    goal = getattr(environment.terminated, "goal_height", None)
    if goal is not None:
        edge, height = 1.2 * reach, float(goal)
        ax.plot([-edge, edge], [height, height], color=GOAL, lw=2, ls=(0, (5, 3)))
    largest = float(largest_controls(environment, trajectory)[0])
    return {"lengths": lengths, "largest_torque": largest}


def acrobot_points(x: np.ndarray, lengths: tuple[float, float]) -> np.ndarray:
    """The hinge, the elbow and the tip, along the last axis but one."""
    first, both = x[..., 0], x[..., 0] + x[..., 1]
    elbow = lengths[0] * np.stack([np.sin(first), -np.cos(first)], axis=-1)
    tip = elbow + lengths[1] * np.stack([np.sin(both), -np.cos(both)], axis=-1)
    return np.stack([np.zeros_like(elbow), elbow, tip], axis=-2)


def draw_acrobot(
    ax: Axes,
    x: np.ndarray,
    u: np.ndarray,
    lengths: tuple[float, float],
    largest_torque: float,
) -> None:
    """Two links that hang at angle 0, with the torque as an arc about the elbow."""
    points, reach = acrobot_points(x, lengths), sum(lengths)
    _draw_arm(ax, points, reach, 0.0)
    share, outward = float(shares(u, largest_torque)[0]), x[0] + x[1] - np.pi / 2
    turn(ax, points[1], 0.16 * reach, outward, share)


def setup_reacher(
    ax: Axes, environment: Environment, trajectory: Trajectory
) -> dict[str, Any]:
    """The circle that the hand reaches, and the goal."""
    system = system_of(environment)
    lengths = float(system.length_1), float(system.length_2)
    reach = _reach(ax, lengths)
    goal = getattr(environment.cost, "goal", None)
    if goal is not None:
        mark(ax, np.asarray(goal), 0.06 * reach)
    largest = largest_controls(environment, trajectory)
    return {"lengths": lengths, "largest_torques": largest}


def reacher_points(x: np.ndarray, lengths: tuple[float, float]) -> np.ndarray:
    """The shoulder, the elbow and the hand, along the last axis but one."""
    quarter = np.zeros_like(x)
    quarter[..., 0] = np.pi / 2
    return acrobot_points(x + quarter, lengths)


def draw_reacher(
    ax: Axes,
    x: np.ndarray,
    u: np.ndarray,
    lengths: tuple[float, float],
    largest_torques: np.ndarray,
) -> None:
    """Two links along x at angle 0, with masses at their ends, and a torque as an arc
    about each joint."""
    points, reach = reacher_points(x, lengths), sum(lengths)
    _draw_arm(ax, points, reach, 0.045)
    first, second = shares(u, largest_torques)
    turn(ax, points[0], 0.16 * reach, x[0], float(first))
    turn(ax, points[1], 0.16 * reach, x[0] + x[1], float(second))


def trace_reacher(
    states: np.ndarray, lengths: tuple[float, float], largest_torques: np.ndarray
) -> np.ndarray:
    """Where the hand has been."""
    return reacher_points(states, lengths)[:, 2]


register_drawing(Pendulum, draw_pendulum, setup_pendulum)
register_drawing(Acrobot, draw_acrobot, setup_acrobot)
add_drawing(Drawing(draw_reacher, setup_reacher, trace_reacher), Reacher)
