"""What drawings are made of: links, joints, bodies, arrows, marks, and the view."""

import math
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.patches import Circle, Polygon

from ...environments import Environment
from ...simulation import Trajectory
from .._figure import color_of, NEUTRAL


BODY, ACTION, GOAL, SECOND = color_of(0), color_of(1), color_of(2), color_of(5)
DARK = "0.3"
FULL_TURN = math.radians(240)  # the sweep of the arrow of the largest torque


def rotation(angle: float) -> np.ndarray:
    """The matrix that turns by an angle, anticlockwise."""
    c, s = math.cos(angle), math.sin(angle)
    return np.array([[c, -s], [s, c]])


def box(width: float, height: float, corner: float) -> np.ndarray:
    """The corners of a rounded rectangle about the origin."""
    bend = np.linspace(0, np.pi / 2, 6)
    points = []
    for k, (x, y) in enumerate(((1, 1), (-1, 1), (-1, -1), (1, -1))):
        centre = np.array([x * (width / 2 - corner), y * (height / 2 - corner)])
        angles = bend + k * np.pi / 2
        points.append(centre + corner * np.stack([np.cos(angles), np.sin(angles)], -1))
    return np.concatenate(points)


def body(
    ax: Axes,
    corners: np.ndarray,
    at: Any = (0.0, 0.0),
    angle: float = 0.0,
    *,
    color: Any = BODY,
    alpha: float | None = None,
    zorder: float | int = 2,
) -> None:
    """A filled shape, turned about its origin and put somewhere."""
    points = np.asarray(at, float) + corners @ rotation(angle).T
    ax.add_artist(Polygon(points, color=color, lw=0, alpha=alpha, zorder=zorder))


def disc(
    ax: Axes, at: Any, radius: float, *, color: Any = BODY, zorder: float | int = 2
) -> None:
    """A filled circle."""
    x, y = at
    ax.add_artist(
        Circle((float(x), float(y)), radius, color=color, lw=0, zorder=zorder)
    )


def link(
    ax: Axes,
    start: Any,
    end: Any,
    *,
    color: Any = BODY,
    width: float | int = 9,
    zorder: float | int = 2,
) -> None:
    """A rod with round ends, of a width in points."""
    (x, y), (to_x, to_y) = start, end
    ax.plot(
        [x, to_x],
        [y, to_y],
        color=color,
        linewidth=width,
        solid_capstyle="round",
        zorder=zorder,
    )


def joint(ax: Axes, at: Any, radius: float) -> None:
    """A hinge."""
    x, y = at
    ax.add_artist(
        Circle(
            (float(x), float(y)),
            radius,
            facecolor="white",
            edgecolor=NEUTRAL,
            zorder=4,
        )
    )


def wheel(ax: Axes, at: Any, radius: float) -> None:
    """A wheel seen from the side."""
    disc(ax, at, radius, color=DARK, zorder=3)
    disc(ax, at, 0.4 * radius, color="white", zorder=3)


def mark(ax: Axes, at: Any, radius: float) -> None:
    """A goal in the plane: a ring around a dot."""
    x, y = float(at[0]), float(at[1])
    ring = Circle((x, y), radius, fill=False, edgecolor=GOAL, lw=2, zorder=1)
    ax.add_artist(ring)
    disc(ax, (x, y), 0.3 * radius, color=GOAL, zorder=1)


def arc_arrow(
    radius: float, start: float, sweep: float, slimness: float = 1.0
) -> np.ndarray:
    """The corners of an arrow bent about the origin: from the angle `start`, through
    `sweep`, both in radians."""
    width = 0.16 * radius / slimness
    head = min(
        0.5 / slimness, 0.6 * abs(sweep)
    )  # the angle that the head takes of the sweep
    end = start + sweep - np.sign(sweep) * head
    angles = np.linspace(start, end, 40)
    along = np.stack([np.cos(angles), np.sin(angles)], axis=-1)
    reach = width * (0.6 + slimness * head)
    point = radius * np.array([[np.cos(start + sweep), np.sin(start + sweep)]])
    outer, inner = (radius + width / 2) * along, (radius - width / 2) * along
    base = [(radius + reach) * along[-1:], point, (radius - reach) * along[-1:]]
    return np.concatenate([outer, *base, inner[::-1]])


def turn(
    ax: Axes,
    at: Any,
    radius: float,
    start: float,
    share: float,
    *,
    color: Any = ACTION,
    slimness: float = 1.0,
) -> None:
    """A torque, by its share of the largest: an arrow about a point of up to 240
    degrees, from the angle `start`."""
    if abs(share) > 0.01:
        arrow = arc_arrow(radius, start, FULL_TURN * share, slimness)
        body(ax, arrow, at, color=color, zorder=3)


def push(
    ax: Axes,
    start: Any,
    vector: Any,
    full: float,
    *,
    color: Any = ACTION,
    zorder: float | int = 3,
) -> None:
    """A force: a straight arrow along `vector`, its width that of one whose largest
    length is `full`."""
    x, y = (float(part) for part in vector)
    length = math.hypot(x, y)
    if length < 0.01 * full:
        return
    width, head = 0.11 * full, min(0.35 * full, 0.6 * length)
    reach, neck = width * (0.4 + 1.6 * head / full), length - head
    corners = np.array(
        [
            [0, width / 2],
            [neck, width / 2],
            [neck, reach + 0.2 * width],
            [length, 0],
            [neck, -reach - 0.2 * width],
            [neck, -width / 2],
            [0, -width / 2],
        ]
    )
    body(ax, corners, start, math.atan2(y, x), color=color, zorder=zorder)


def ground(ax: Axes) -> None:
    """The ground at height 0, across the whole view."""
    ax.axhline(0, color=NEUTRAL, lw=2, zorder=0)


def shares(u: np.ndarray, largest: Any) -> np.ndarray:
    """Controls as shares of the largest, between -1 and 1."""
    return np.clip(u / largest, -1, 1)


def largest_controls(environment: Environment, trajectory: Trajectory) -> np.ndarray:
    """What a full arrow stands for, one a control: its bound if it has one, else the
    largest that was applied, else 1."""
    size = environment.control_size
    largest = np.zeros(size)
    if environment.control_bounds is not None:
        low, high = (np.abs(np.asarray(e, float)) for e in environment.control_bounds)
        largest = np.broadcast_to(np.maximum(low, high), (size,))
    applied = np.abs(np.asarray(trajectory.controls, float))
    applied = np.where(np.isfinite(applied), applied, 0.0).max(axis=0, initial=0.0)
    largest = np.where(np.isfinite(largest) & (largest > 0), largest, applied)
    return np.where(largest > 0, largest, 1.0)


def finite_states(trajectory: Trajectory) -> np.ndarray:
    """The states without those that are not finite; a state of zeros if all are."""
    states = np.asarray(trajectory.states, float)
    found = states[np.all(np.isfinite(states), axis=-1)]
    return found if len(found) else np.zeros_like(states[:1])


def target_of(environment: Environment) -> np.ndarray | None:
    """The state that the cost draws to, the origin if it names none; or nothing."""
    targets = environment.cost.targets
    if targets is None:
        return None
    x, _ = targets
    return np.zeros(environment.state_size) if x is None else np.asarray(x, float)


class View(NamedTuple):
    """A part of the plane: `centre` and half of its extent, `half`, each `(2,)`."""

    centre: np.ndarray
    half: np.ndarray

    def show(self, ax: Axes) -> None:
        """Set the limits to this part."""
        low, high = self.centre - self.half, self.centre + self.half
        ax.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]))

    def follow(self, ax: Axes, at: Any, room: float) -> None:
        """Set the limits to this part, moved only as far as keeps `at` inside, `room`
        from the edge."""
        at = np.asarray(at, float)
        inner = np.maximum(self.half - room, 0.0)
        shift = at - np.clip(at, self.centre - inner, self.centre + inner)
        View(self.centre + shift, self.half).show(ax)


def square_view(points: np.ndarray, least: float, most: float, room: float) -> View:
    """A square around all points with some `room`, its half between `least` and `most`;
    where that is too small, about the last of them."""
    low, high = points.min(axis=0), points.max(axis=0)
    half = 0.5 * float(np.max(high - low)) + room
    centre = (low + high) / 2 if half <= most else points[-1]
    return View(centre, np.full(2, min(max(half, least), most)))
