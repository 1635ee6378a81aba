"""The building blocks of drawings: the episode, the canvas with shapes, the view."""

import dataclasses
import functools
import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.patches import Circle, Polygon, Rectangle

from ..._figures import color_of, NEUTRAL
from ...dynamics import AbstractDynamics
from ...environments import Environment
from ...simulation import Trajectory
from ...systems import AbstractSystem


Number: TypeAlias = float | int
Point: TypeAlias = Sequence[Number] | Float[np.ndarray, "2"]
Points: TypeAlias = Float[np.ndarray, "_ 2"]

FULL_TURN = math.radians(240)  # the sweep of the arrow of the largest torque


def rotation(angle: Number) -> Float[np.ndarray, "2 2"]:
    """The matrix that turns by an angle, anticlockwise."""
    c, s = math.cos(angle), math.sin(angle)
    return np.array([[c, -s], [s, c]])


def box(width: Number, height: Number, corner: Number) -> Points:
    """The corners of a rounded rectangle about the origin."""
    bend = np.linspace(0, np.pi / 2, 6)
    points = []
    for k, (x, y) in enumerate(((1, 1), (-1, 1), (-1, -1), (1, -1))):
        centre = np.array([x * (width / 2 - corner), y * (height / 2 - corner)])
        angles = bend + k * np.pi / 2
        points.append(centre + corner * np.stack([np.cos(angles), np.sin(angles)], -1))
    return np.concatenate(points)


def arc_arrow(
    radius: Number, start: Number, sweep: Number, slimness: Number = 1.0
) -> Points:
    """The corners of an arrow bent about the origin. It starts at the angle `start` and
    turns by `sweep`, both in radians."""
    width = 0.16 * radius / slimness
    head = min(0.5 / slimness, 0.6 * abs(sweep))  # the angle that the head takes up
    end = start + sweep - np.sign(sweep) * head
    angles = np.linspace(start, end, 40)
    along = np.stack([np.cos(angles), np.sin(angles)], axis=-1)
    reach = width * (0.6 + slimness * head)
    point = radius * np.array([[np.cos(start + sweep), np.sin(start + sweep)]])
    outer, inner = (radius + width / 2) * along, (radius - width / 2) * along
    base = [(radius + reach) * along[-1:], point, (radius - reach) * along[-1:]]
    return np.concatenate([outer, *base, inner[::-1]])


@dataclasses.dataclass(frozen=True)
class Canvas:
    """Axes, the colours of drawings, and methods that draw shapes on the axes. Keywords
    are passed on to Matplotlib."""

    ax: Axes

    BODY, ACTION, GOAL, SECOND = color_of(0), color_of(1), color_of(2), color_of(5)
    DARK = "0.3"
    LONG_DASHES, SHORT_DASHES = (0, (5, 3)), (0, (3, 2))
    NEUTRAL = NEUTRAL

    def line(self, points: Any, **style: Any) -> None:
        """A line through points."""
        self.ax.plot(*np.asarray(points, float).T, **style)

    def circle(self, at: Point, radius: Number, **style: Any) -> None:
        """A circle."""
        self.ax.add_artist(Circle((float(at[0]), float(at[1])), radius, **style))

    def disc(self, at: Point, radius: Number, color: str = BODY, **style: Any) -> None:
        """A filled circle."""
        self.circle(at, radius, color=color, **{"lw": 0, "zorder": 2} | style)

    def bar(self, at: Point, width: Number, top: Number, **style: Any) -> None:
        """A filled bar that stands on the point `at` and reaches the height `top`."""
        corner, height = (at[0] - width / 2, float(at[1])), top - at[1]
        style = {"lw": 0, "zorder": 2} | style
        self.ax.add_artist(Rectangle(corner, width, height, **style))

    def polygon(
        self, corners: Points, at: Point = (0, 0), angle: Number = 0.0, **style: Any
    ) -> None:
        """A filled shape, turned by `angle` about its origin and moved to `at`."""
        points = np.asarray(at, float) + corners @ rotation(angle).T
        style = {"color": self.BODY, "lw": 0, "zorder": 2} | style
        self.ax.add_artist(Polygon(points, **style))

    def link(self, start: Point, end: Point, width: Number = 9, **style: Any) -> None:
        """A rod with round ends. The width is in points."""
        style = {"color": self.BODY, "zorder": 2} | style
        self.line([start, end], linewidth=width, solid_capstyle="round", **style)

    def joint(self, at: Point, radius: Number) -> None:
        """A hinge."""
        self.circle(at, radius, facecolor="white", edgecolor=self.NEUTRAL, zorder=4)

    def wheel(self, at: Point, radius: Number) -> None:
        """A wheel seen from the side."""
        self.disc(at, radius, self.DARK, zorder=3)
        self.disc(at, 0.4 * radius, "white", zorder=3)

    def goal(self, at: Point, radius: Number) -> None:
        """A goal in the plane: a ring around a dot."""
        self.circle(at, radius, fill=False, edgecolor=self.GOAL, lw=2, zorder=1)
        self.disc(at, 0.3 * radius, self.GOAL, zorder=1)

    def reach(self, radius: Number, room: Number = 1.2) -> None:
        """The circle about the origin that a tip moves on, and the view of it."""
        self.circle((0, 0), radius, fill=False, color=self.NEUTRAL, alpha=0.25, lw=1)
        self.view((0.0, 0.0), (room * radius, room * radius))

    def view(self, centre: Point, half: Point) -> "View":
        """Set the limits of the axes to a centre and half an extent."""
        view = View(self, np.asarray(centre, float), np.asarray(half, float))
        (left, low), (right, high) = view.centre - view.half, view.centre + view.half
        self.ax.set(xlim=(left, right), ylim=(low, high))
        return view

    def ground(self) -> None:
        """The ground at height 0, across the whole view."""
        self.ax.axhline(0, color=self.NEUTRAL, lw=2, zorder=0)

    def torque(
        self,
        at: Point,
        radius: Number,
        start: Number,
        share: Number,
        color: str = ACTION,
        slimness: Number = 1.0,
    ) -> None:
        """A torque, as an arrow about a point that starts at the angle `start`. `share`
        is the torque relative to the largest, which turns by 240 degrees."""
        if abs(share) > 0.01:
            arrow = arc_arrow(radius, start, FULL_TURN * share, slimness)
            self.polygon(arrow, at, color=color, zorder=3)

    def force(self, start: Point, vector: Point, full: Number, **style: Any) -> None:
        """A force, as a straight arrow along `vector`. `full` is the length of the
        largest force, which sets the width of the arrow."""
        x, y = (float(part) for part in vector)
        length = math.hypot(x, y)
        if length < 0.01 * full:
            return
        width, head = 0.11 * full, min(0.35 * full, 0.6 * length)
        barb, neck = width * (0.6 + 1.6 * head / full), length - head
        upper = np.array([[0, width / 2], [neck, width / 2], [neck, barb]])
        corners = np.concatenate([upper, [[length, 0]], upper[::-1] * [1, -1]])
        style = {"color": self.ACTION, "zorder": 3} | style
        self.polygon(corners, start, math.atan2(y, x), **style)

    def push(
        self, at: Point, gap: Number, full: Number, share: Number, angle: Number = 0.0
    ) -> None:
        """A force on a body, along `angle` or against it. `share` is the force relative
        to the largest, whose arrow is `full` long. The arrow starts `gap` from the
        point `at`, on the side to which the force points."""
        along = rotation(angle)[:, 0]
        start = np.asarray(at, float) + math.copysign(gap, share) * along
        self.force(start, full * share * along, full)


class View(NamedTuple):
    """A part of the plane: its `centre`, and `half` its extent, both of shape
    `(2,)`."""

    canvas: Canvas
    centre: Float[np.ndarray, "2"]
    half: Float[np.ndarray, "2"]

    def follow(self, at: Point, room: Number) -> None:
        """Set the limits to this part, moved as little as needed to keep `at` inside,
        at least `room` from the edge."""
        inner = np.maximum(self.half - room, 0.0)
        shift = at - np.clip(at, self.centre - inner, self.centre + inner)
        self.canvas.view(self.centre + shift, self.half)


Vector: TypeAlias = Float[np.ndarray, "_"]  # noqa: F821
States: TypeAlias = Float[np.ndarray, "times states"]
Past: TypeAlias = tuple[Float[np.ndarray, " times"], States]


class Drawing(NamedTuple):
    """How the plant of one episode is drawn.

    - `draw(x, u)`: draws one moment.
    - `path(states)`: the path that the plant leaves, shape `(times, 2)`; `None` if it
        leaves no path.
    - `autoscale`: whether the limits of the axes must fit all that is drawn.
    - `walks`: whether `draw` takes a third argument `past`, the times and states up to
        now, which tell how far the plant has moved.
    """

    draw: Callable[..., Any]
    path: Callable[[States], Points] | None = None
    autoscale: bool = False
    walks: bool = False


@dataclasses.dataclass(frozen=True)
class Episode:
    """The run that is drawn, and the values that drawings take from it."""

    environment: Environment
    trajectory: Trajectory

    @functools.cached_property
    def system(self) -> Any:
        """The innermost system of the environment, or the dynamics if they hold no
        system."""
        return layers(self.environment)[-1]

    @functools.cached_property
    def states(self) -> States:
        """The finite states; a single state of zeros if none is finite."""
        states = np.asarray(self.trajectory.states, float)
        finite = states[np.all(np.isfinite(states), axis=-1)]
        return finite if len(finite) else np.zeros_like(states[:1])

    @functools.cached_property
    def target(self) -> Vector | None:
        """The target state of the cost. It is the origin if the cost has only a target
        control, and `None` if it has no target."""
        if self.environment.cost.targets is None:
            return None
        x, _ = self.environment.cost.targets
        zero = np.zeros(self.environment.state_size)
        return zero if x is None else np.asarray(x, float)

    def visited(self, columns: Sequence[int]) -> Float[np.ndarray, "_ columns"]:
        """Some columns of the states, with the target as the last row if there is
        one."""
        states = self.states
        if self.target is not None:
            states = np.concatenate([states, self.target[None]])
        return states[:, list(columns)]

    @functools.cached_property
    def largest_controls(self) -> Vector:
        """The magnitude of each control whose arrow has full length: its bound, else
        the largest value that was applied, else 1."""
        bounds = self.environment.control_bounds or (0.0, 0.0)
        low, high = (np.abs(np.asarray(end, float)) for end in bounds)
        largest = np.broadcast_to(np.maximum(low, high), self.environment.control_size)
        applied = np.abs(np.asarray(self.trajectory.controls, float))
        applied = np.where(np.isfinite(applied), applied, 0.0).max(axis=0, initial=0.0)
        largest = np.where(np.isfinite(largest) & (largest > 0), largest, applied)
        return np.where(largest > 0, largest, 1.0)

    def shares(self, u: Vector) -> Vector:
        """Controls relative to the largest, clipped to [-1, 1]."""
        return np.clip(u / self.largest_controls, -1, 1)


Setup: TypeAlias = Callable[[Canvas, Episode], Drawing]
"""Draws what does not move, sets the limits of the axes, and returns the `Drawing`."""


def layers(environment: Environment) -> list[Any]:
    """The dynamics and what they wrap, the innermost system last."""
    layers: list[Any] = [environment.dynamics]
    while True:
        inner = getattr(layers[-1], "system", getattr(layers[-1], "dynamics", None))
        if not isinstance(inner, AbstractSystem | AbstractDynamics):
            return layers
        layers.append(inner)
