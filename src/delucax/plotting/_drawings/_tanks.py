"""The two tanks, one above the other."""

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.patches import Rectangle

from ...environments import Environment
from ...simulation import Trajectory
from ...systems import TwoTank
from .._figure import NEUTRAL
from ._parts import (
    ACTION,
    BODY,
    finite_states,
    GOAL,
    largest_controls,
    SECOND,
    shares,
    target_of,
)
from ._registry import register_drawing, system_of


HEIGHT, FALL = 1.0, 0.42  # of a tank, and of the water between them


def setup_two_tank(
    ax: Axes, environment: Environment, trajectory: Trajectory
) -> dict[str, Any]:
    """The tanks, as wide as the roots of their areas, and the level to hold."""
    system = system_of(environment)
    roots = np.sqrt([float(system.upper_area), float(system.lower_area)])
    widths = 1.1 * roots / roots.max()
    holes = np.sqrt([float(system.upper_outlet), float(system.lower_outlet)])
    holes = 0.09 * holes / holes.max()
    levels = finite_states(trajectory)
    target = target_of(environment)
    tallest = max(float(levels.max(initial=0.0)), 1e-6)
    if target is not None:
        tallest = max(tallest, 1.5 * float(target[1]))
    bottoms = np.array([HEIGHT + FALL, 0.0])
    for bottom, width, hole in zip(bottoms, widths, holes, strict=True):
        side, gap = width / 2, hole / 2
        for k in (-1, 1):
            walls = [(k * side, HEIGHT * 1.12), (k * side, 0), (k * gap, 0)]
            walls = np.array([*walls, (k * gap, -0.07)]) + [0, bottom]
            ax.plot(*walls.T, color=NEUTRAL, lw=2.5, solid_joinstyle="round", zorder=3)
    if target is not None:
        height = HEIGHT * float(target[1]) / tallest
        ends = [-0.5 * widths[1] - 0.14, 0.5 * widths[1] + 0.14]
        ax.plot(ends, [height] * 2, color=GOAL, lw=2, ls=(0, (5, 3)), zorder=4)
    top = bottoms[0] + 1.12 * HEIGHT
    pipe = [[-0.75, top + 0.3], [0, top + 0.3], [0, top + 0.16]]
    ax.plot(*np.array(pipe).T, color=NEUTRAL, lw=9, solid_capstyle="butt", zorder=3)
    ax.set(xlim=(-1.15, 1.15), ylim=(-0.5, top + 0.4))
    largest = float(largest_controls(environment, trajectory)[0])
    return {
        "widths": widths,
        "holes": holes,
        "tallest": tallest,
        "largest_flow": largest,
    }


def _water(
    ax: Axes, width: float, low: float, high: float, color: Any, alpha: float
) -> None:
    """Water of a width about the middle."""
    corner, height = (-width / 2, low), high - low
    ax.add_artist(
        Rectangle(corner, width, height, color=color, alpha=alpha, lw=0, zorder=2)
    )


def draw_two_tank(
    ax: Axes,
    x: np.ndarray,
    u: np.ndarray,
    widths: np.ndarray,
    holes: np.ndarray,
    tallest: float,
    largest_flow: float,
) -> None:
    """The levels, what runs out of each tank, and what the pump pours in."""
    heights = HEIGHT * np.clip(x[:2] / tallest, 0.0, 1.12)
    upper = HEIGHT + FALL
    share = float(shares(u, largest_flow)[0])
    if share > 0.005:
        top, surface = upper + 1.12 * HEIGHT + 0.16, upper + heights[0]
        _water(ax, 0.14 * share, surface, top, ACTION, 1.0)
    for bottom, level, width, hole in zip(
        (upper, 0.0), heights, widths, holes, strict=True
    ):
        _water(ax, width, bottom, bottom + level, BODY, 0.75)
        # By Torricelli's law the stream is as the root of the level.
        stream = hole * float(np.sqrt(level / HEIGHT))
        end = heights[1] if bottom else -0.5
        _water(ax, stream, end, bottom, SECOND, 1.0)


register_drawing(TwoTank, draw_two_tank, setup_two_tank)
