"""Cars seen from above, and plants that fly or turn in space."""

import math
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from matplotlib.collections import LineCollection

from ..._figures import color_of
from ._canvas import (
    box,
    Canvas,
    Drawing,
    Episode,
    Past,
    Point,
    Points,
    rotation,
    States,
    Vector,
    View,
)


LANES = 3


def car(canvas: Canvas, episode: Episode) -> Drawing:
    """A car with its steered front wheels and its acceleration, on a road of three
    lanes. The middle lane lies along `y = 0`, and the view follows the car."""
    ax, system = canvas.ax, episode.system
    front, rear = float(system.front), float(system.rear)
    base = front + rear
    edge = LANES * 1.25 * base / 2
    ax.axhspan(-edge, edge, color=canvas.NEUTRAL, alpha=0.13, lw=0)
    for side in (-edge, edge):
        ax.axhline(side, color=canvas.NEUTRAL, lw=2)
    ax.axhline(0, color=canvas.GOAL, lw=1.5, alpha=0.7, zorder=0)
    aside = np.abs(episode.states[:, 1]).max(initial=0.0)
    half = 4.2 * base, float(np.clip(aside + base, 1.25 * edge, 3 * edge))
    canvas.view((0.0, 0.0), half)

    draw_car = _car_of(canvas, front, rear)

    def draw(x: Vector, u: Vector) -> None:
        place = np.asarray(x[:2], float)
        middle = place[0] + 0.6 * base
        canvas.view((middle, 0.0), half).follow((middle, place[1]), base)
        _draw_dashes(canvas, middle, half[0], base)
        share = float(episode.shares(u)[0])
        draw_car(place, float(x[2]), steering=float(u[1]), share=share)

    return Drawing(draw, lambda states: states[:, :2])


def _car_of(canvas: Canvas, front: float, rear: float) -> Callable[..., None]:
    """A function `draw(place, heading, steering, share)` that draws a car from above.
    `share` is the force along the car, relative to the largest."""
    base = front + rear
    width = 0.64 * base
    hood, boot = front + 0.3 * base, -rear - 0.28 * base
    chassis = box(hood - boot, 0.88 * width, 0.16 * base)
    tyre = box(0.26 * base, 0.1 * base, 0.03 * base)
    rubber: dict[str, Any] = {"color": canvas.DARK, "zorder": 3}
    shine: dict[str, Any] = {"color": "white", "alpha": 0.55, "zorder": 4}

    def draw(place: Point, heading: float, steering: float, share: float) -> None:
        turned = rotation(heading)
        axis = place + turned @ ((hood + boot) / 2, 0.0)
        for along, angle in ((front, steering), (-rear, 0.0)):
            for side in (-0.48, 0.48):
                at = place + turned @ (along, side * width)
                canvas.polygon(tyre, at, heading + angle, **rubber)
        canvas.polygon(chassis, axis, heading)
        for near, far, inner in ((0.28, 0.02, 0.3), (-0.62, -0.5, 0.32)):
            corners = [(near, -0.36), (far, -inner), (far, inner), (near, 0.36)]
            glass = np.array(corners) * [base, width]
            canvas.polygon(glass, axis, heading, **shine)
        canvas.disc(place, 0.05 * base, "white", zorder=4)
        gap = (hood - boot) / 2 + 0.12 * base
        canvas.push(axis, gap, 1.2 * base, share, heading)

    return draw


def drifting_car(canvas: Canvas, episode: Episode) -> Drawing:
    """A car on an open field with a grid, with its steered wheels and the force of the
    rear tyre. Its velocities are integrated from the origin to find where it is."""
    front, rear = float(episode.system.front), float(episode.system.rear)
    base = front + rear
    half = np.full(2, 3.2 * base)
    draw_car = _car_of(canvas, front, rear)

    def draw(x: Vector, u: Vector, past: Past) -> None:
        times, states = past
        headings, course = _course(times, states)
        canvas.line(course, color=canvas.BODY, alpha=0.5, lw=2, zorder=1)
        view = canvas.view(course[-1], half)
        _draw_grid(canvas, view, 2 * base)
        steering, share = float(u[1]), float(episode.shares(u)[0])
        draw_car(course[-1], headings[-1], steering=steering, share=share)

    return Drawing(draw, walks=True)


def _course(times: Vector, states: States) -> tuple[Vector, Points]:
    """The headings and places of a car with the states (vx, vy, yaw rate), which starts
    at (0, 0) along x."""
    steps = np.diff(times)
    middle = (states[1:] + states[:-1]) / 2
    headings = np.append(0.0, np.cumsum(steps * middle[:, 2]))
    between = (headings[1:] + headings[:-1]) / 2
    c, s, vx, vy = np.cos(between), np.sin(between), middle[:, 0], middle[:, 1]
    moves = steps * np.stack([c * vx - s * vy, s * vx + c * vy])
    return headings, np.cumsum(np.insert(moves, 0, 0.0, axis=1), axis=1).T


def _draw_grid(canvas: Canvas, view: View, pitch: float) -> None:
    """Draw the lines of a grid that is fixed to the ground."""
    low, high = view.centre - view.half, view.centre + view.half
    style: dict[str, Any] = {"color": canvas.NEUTRAL, "alpha": 0.25, "lw": 1}
    for column, line in enumerate((canvas.ax.axvline, canvas.ax.axhline)):
        first = math.ceil(low[column] / pitch) * pitch
        for at in np.arange(first, high[column], pitch):
            line(float(at), zorder=0, **style)


def _draw_dashes(canvas: Canvas, middle: float, half: float, base: float) -> None:
    """Draw the dashes between the lanes, which are fixed to the road."""
    pitch = 2.4 * base
    first = math.floor((middle - half) / pitch)
    last = math.ceil((middle + half) / pitch)
    starts = pitch * np.arange(first, last + 1)
    dash = np.stack([starts, starts + 0.45 * pitch, np.full_like(starts, np.nan)], -1)
    for k in range(1, LANES):
        heights = np.full(dash.size, (k - LANES / 2) * 1.25 * base)
        canvas.ax.plot(dash.ravel(), heights, color="white", lw=2.5)


def planar_quadrotor(canvas: Canvas, episode: Episode) -> Drawing:
    """A body with a rotor at each end and the thrust above each rotor, the goal, and
    the wind if there is one."""
    system, target = episode.system, episode.target
    visited = episode.visited((0, 1))
    length = float(system.length)
    low, high = visited.min(axis=0), visited.max(axis=0)
    half = 0.5 * float(np.max(high - low)) + 2 * length
    # The centre of the run, or its end if the run is too large to show.
    centre = (low + high) / 2 if half <= 20 * length else visited[-1]
    half = np.full(2, min(max(half, 4 * length), 20 * length))
    view = canvas.view(centre, half)
    arm = max(length, 0.16 * float(half[0]))  # drawn larger in a wide view
    if target is not None:
        canvas.goal(target[:2], 0.3 * arm)
    if system.wind is not None:
        _draw_wind(canvas, system.wind, view)
    weight = float(system.mass * system.gravity)
    largest = np.maximum(episode.largest_controls, 0.5 * weight)

    def draw(x: Vector, u: Vector) -> None:
        centre = np.asarray(x[:2], float)
        _draw_two_rotors(canvas, centre, float(x[2]), arm, np.clip(u / largest, -1, 1))
        view.follow(centre, 1.5 * arm)

    return Drawing(draw, lambda states: states[:, :2])


def _draw_two_rotors(
    canvas: Canvas, centre: Point, angle: float, arm: float, shares: Vector
) -> None:
    """Draw a body with a rotor at each end, and above each rotor its thrust relative to
    the largest."""
    turned = rotation(angle)
    canvas.polygon(box(2 * arm, 0.16 * arm, 0.07 * arm), centre, angle)
    canvas.disc(centre, 0.2 * arm)
    canvas.disc(centre, 0.09 * arm, "white", zorder=3)
    blade, up = turned @ (0.42 * arm, 0.0), turned @ (0.0, 0.1 * arm)
    for side, share in zip((-1, 1), shares, strict=True):
        foot = centre + turned @ (0.92 * side * arm, 0.0)
        hub = centre + turned @ (0.92 * side * arm, 0.26 * arm)
        canvas.link(foot, hub, width=2, color=canvas.DARK)
        canvas.link(hub - blade, hub + blade, width=3.5, color=canvas.SECOND)
        canvas.force(hub + up, turned @ (0.0, 1.5 * arm * share), 1.5 * arm)


def slung_load(canvas: Canvas, episode: Episode) -> Drawing:
    """A planar quadrotor, the load on its cable, and the goal of the load."""
    system, target = episode.system, episode.target
    visited, cable = episode.visited((0, 1)), float(system.cable)
    low, high = visited.min(axis=0), visited.max(axis=0) + [0, cable]
    half = 0.5 * float(np.max(high - low)) + cable
    # The centre of the run, or its end if the run is too large to show.
    centre = (low + high) / 2 if half <= 10 * cable else visited[-1]
    view = canvas.view(centre, np.full(2, min(half, 10 * cable)))
    arm = max(float(system.arm), 0.12 * float(view.half[0]))
    if target is not None:
        canvas.goal(target[:2], 0.3 * arm)

    def draw(x: Vector, u: Vector) -> None:
        load, swing = np.asarray(x[:2], float), float(x[3])
        centre = load + cable * np.array([-math.sin(swing), math.cos(swing)])
        canvas.line([centre, load], color=canvas.DARK, lw=1.5)
        canvas.disc(load, 0.2 * arm, canvas.SECOND, zorder=3)
        _draw_two_rotors(canvas, centre, float(x[2]), arm, episode.shares(u))
        view.follow(load, 1.5 * arm)

    return Drawing(draw, lambda states: states[:, :2])


def _draw_wind(canvas: Canvas, wind: Callable[..., Array], view: View) -> None:
    """Draw arrows of the force of the wind at time 0 on a body at rest."""
    side = np.linspace(-0.9, 0.9, 9) * view.half[0]
    places = np.stack(np.meshgrid(side, side), axis=-1).reshape(-1, 2) + view.centre
    states = jnp.zeros((len(places), 6)).at[:, :2].set(places)
    forces = np.asarray(jax.vmap(lambda x: wind(jnp.zeros(()), x))(states), float)
    strongest = np.linalg.norm(forces, axis=-1).max() or 1.0
    arrows = forces * (0.25 * view.half[0] / strongest)
    style: dict[str, Any] = {"color": canvas.NEUTRAL, "alpha": 0.35, "zorder": 0}
    style |= {"angles": "xy", "scale_units": "xy", "scale": 1.0, "width": 0.005}
    canvas.ax.quiver(*places.T, *arrows.T, pivot="middle", **style)


AZIMUTH, ELEVATION = math.radians(-62), math.radians(24)  # the direction of the eye
HORIZONTAL = np.array([math.cos(AZIMUTH), math.sin(AZIMUTH), 0.0])
RIGHT = np.array([-math.sin(AZIMUTH), math.cos(AZIMUTH), 0.0])
UP = -math.sin(ELEVATION) * HORIZONTAL + np.array([0.0, 0.0, math.cos(ELEVATION)])
SCREEN = np.stack([RIGHT, UP])  # the axes of the picture, in space
FRONT = color_of(4)
# Front, left, back and right: the order of the thrusts.
ARMS = np.array([[1, 0, 0], [0, 1, 0], [-1, 0, 0], [0, -1, 0]], float)
RIM = np.array(
    [[np.cos(a), np.sin(a), 0.0] for a in np.linspace(0, 2 * np.pi, 33)[:-1]]
)


def projected(points: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n 2"]:
    """Project points in space onto the picture."""
    return points @ SCREEN.T


def quadrotor(canvas: Canvas, episode: Episode) -> Drawing:
    """Two crossed arms with four rotors, the front one in amber, and their thrusts, or
    the total thrust if the inputs are a wrench. Also a floor with a grid and the shadow
    on it, and the goal above the floor."""
    system, target = episode.system, episode.target
    visited = episode.visited((0, 1, 2))
    length = float(system.arm)
    low, high = visited.min(axis=0), visited.max(axis=0)
    middle = target[:3] if target is not None else visited[0]
    half = np.clip(0.5 * np.max(high - low) + 2 * length, 5 * length, 15 * length)
    centre = np.where(high - low < 2 * half, (low + high) / 2, middle)
    floor = float(max(low[2], centre[2] - half) - 2.5 * length)
    arm = max(length, 0.16 * float(half))  # drawn larger in a wide view

    ends = np.array([-half, half])
    lines = []
    for tick in np.linspace(-half, half, 7):
        for across in (np.full(2, tick), ends), (ends, np.full(2, tick)):
            flat = np.stack([*across, np.zeros(2)], axis=-1)
            lines.append(projected(flat + [*centre[:2], floor]))
    style = {"colors": canvas.NEUTRAL, "alpha": 0.3, "linewidths": 0.8, "zorder": 0}
    canvas.ax.add_collection(LineCollection(lines, **style), autolim=False)
    if target is not None:
        stem = projected(np.stack([[*target[:2], floor], target[:3]]))
        canvas.line(stem, color=canvas.NEUTRAL, lw=1, ls=(0, (3, 3)), zorder=0)
        canvas.goal(projected(target[:3]), 0.35 * arm)
    near = np.clip(visited, centre - half, centre + half)
    corners = np.concatenate([*lines, projected(near) + [0, 2.5 * arm]])
    low, high = corners.min(axis=0), corners.max(axis=0)
    view = canvas.view((low + high) / 2, 0.52 * (high - low))

    def draw(x: Vector, u: Vector) -> None:
        place = np.asarray(x[:3], float)
        turned = system.rotation(system.project(jnp.asarray(x)))
        turned = np.asarray(turned, float).reshape(3, 3)
        hubs = place + arm * ARMS @ turned.T
        discs = [hub + 0.48 * arm * (RIM + [0, 0, 0.3]) @ turned.T for hub in hubs]
        for rotor in (*discs, place + 0.3 * arm * RIM @ turned.T):
            shadow = projected(rotor * [1, 1, 0] + [0, 0, floor])
            canvas.polygon(shadow, color=canvas.NEUTRAL, alpha=0.3, zorder=1)
        # The arms that are farther away are drawn first.
        order = np.argsort(hubs @ np.cross(RIGHT, UP))
        for i in order:
            color = FRONT if i == 0 else canvas.BODY
            canvas.link(projected(place), projected(hubs[i]), width=5, color=color)
        canvas.disc(projected(place), 0.24 * arm)
        for i in order:
            color = FRONT if i == 0 else canvas.SECOND
            canvas.polygon(projected(discs[i]), color=color, alpha=0.65)
        up, shares = turned[:, 2], episode.shares(u)
        thrusts = [(hubs[i], 2.8 * arm * shares[i]) for i in order]
        if system.inputs == "wrench":
            thrusts = [(place, 3 * arm * shares[0])]
        for foot, thrust in thrusts:
            start, along = projected(foot + 0.2 * arm * up), projected(thrust * up)
            canvas.force(start, along, 2 * arm)
        view.follow(projected(place), 1.5 * arm)

    return Drawing(draw, lambda states: projected(states[:, :3]))


def furuta(canvas: Canvas, episode: Episode) -> Drawing:
    """An arm that turns in the horizontal plane, and a pendulum at its end, seen from
    above at an angle. The voltage is an arc about the motor."""
    arm, length = float(episode.system.arm_length), 2 * float(episode.system.center)
    reach = arm + length
    canvas.view((0.0, 0.0), (1.15 * reach, 1.15 * reach))
    canvas.polygon(projected(arm * RIM), color=canvas.NEUTRAL, alpha=0.15, zorder=0)
    base = projected(np.array([[0.0, 0.0, -0.5 * reach], [0.0, 0.0, 0.0]]))
    canvas.link(*base, width=14, color=canvas.NEUTRAL, zorder=0)

    def draw(x: Vector, u: Vector) -> None:
        out = arm * np.array([math.cos(x[0]), math.sin(x[0]), 0.0])
        hub, hinge = np.zeros(2), projected(out)
        tip = projected(_tips(x[None], arm, length))[0]
        canvas.link(hub, hinge)
        canvas.link(hinge, tip, width=7, color=canvas.SECOND, zorder=3)
        canvas.joint(hinge, 0.03 * reach)
        canvas.joint(hub, 0.03 * reach)
        canvas.torque(hub, 0.2 * reach, math.pi / 2, float(episode.shares(u)[0]))

    return Drawing(draw, lambda states: projected(_tips(states, arm, length)))


def _tips(states: States, arm: float, length: float) -> Float[np.ndarray, "times 3"]:
    """The tip of the pendulum at the end of an arm, in space."""
    turn, angle = states[:, 0], states[:, 1]
    c, s, aside = np.cos(turn), np.sin(turn), length * np.sin(angle)
    flat = [arm * c - aside * s, arm * s + aside * c]
    return np.stack([*flat, length * np.cos(angle)], axis=-1)
