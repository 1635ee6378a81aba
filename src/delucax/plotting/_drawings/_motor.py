"""The synchronous motor, seen along its shaft by one who turns with its rotor."""

import math
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.patches import Circle, Wedge

from ...environments import Environment
from ...simulation import Trajectory
from ...systems import PermanentMagnetMotor
from .._figure import color_of, NEUTRAL
from ._parts import (
    BODY,
    finite_states,
    FULL_TURN,
    GOAL,
    joint,
    largest_controls,
    push,
    SECOND,
    shares,
    target_of,
    turn,
)
from ._registry import register_drawing


ROTOR, GAP, STATOR, SPEED = 0.68, 0.76, 1.0, 1.16
CURRENT = color_of(4)


def setup_motor(
    ax: Axes, environment: Environment, trajectory: Trajectory
) -> dict[str, Any]:
    """The stator, and the rotor with its magnets along d."""
    ax.set(xlim=(-1.4, 1.4), ylim=(-1.4, 1.4))
    ring = Wedge((0, 0), STATOR, 0, 360, width=STATOR - GAP, color=NEUTRAL, alpha=0.25)
    ax.add_artist(ring)
    ax.add_artist(Circle((0, 0), ROTOR, color=NEUTRAL, alpha=0.12, lw=0))
    for start, color in ((-50, BODY), (130, SECOND)):
        magnet = Wedge(
            (0, 0), ROTOR, start, start + 100, width=0.13, color=color, alpha=0.8
        )
        ax.add_artist(magnet)
    for name, place in (("d", (1.0, 0.0)), ("q", (0.0, 1.0))):
        x, y = np.array(place)
        ax.plot(
            [-0.5 * x, 0.5 * x], [-0.5 * y, 0.5 * y], color=NEUTRAL, lw=1, alpha=0.5
        )
        ax.text(
            0.88 * x, 0.88 * y, name, size=12, ha="center", va="center", color="0.25"
        )
    states = finite_states(trajectory)
    current = float(np.linalg.norm(states[:, :2], axis=1).max(initial=0.0)) or 1.0
    target = target_of(environment)
    speeds = np.abs(states[:, 2])
    if target is not None:
        speeds = np.append(speeds, abs(target[2]))
    fastest = float(speeds.max()) or 1.0
    if target is not None:
        angle = math.pi / 2 + FULL_TURN * float(target[2]) / fastest
        tick = np.array([SPEED - 0.12, SPEED + 0.12])
        ax.plot(
            tick * math.cos(angle), tick * math.sin(angle), color=GOAL, lw=3, zorder=4
        )
    return {
        "largest_current": current,
        "fastest": fastest,
        "largest_voltages": largest_controls(environment, trajectory),
    }


def draw_motor(
    ax: Axes,
    x: np.ndarray,
    u: np.ndarray,
    largest_current: float,
    fastest: float,
    largest_voltages: np.ndarray,
) -> None:
    """The voltage and the current, as arrows in the plane of d and q, and the speed, as
    an arc about the stator."""
    share = float(np.clip(x[2] / fastest, -1, 1))
    turn(ax, (0, 0), SPEED, math.pi / 2, share, color=BODY, slimness=2.5)
    push(ax, (0, 0), 0.6 * shares(u, largest_voltages), 0.6, zorder=2)
    field = 0.6 * x[:2] / largest_current
    push(ax, (0, 0), field, 0.6, color=CURRENT, zorder=3)
    joint(ax, (0, 0), 0.06)


register_drawing(PermanentMagnetMotor, draw_motor, setup_motor)
