"""Masses on a line: free, and on springs and dampers."""

import math

import numpy as np

from ..figures import NEUTRAL
from ._canvas import box, Canvas, DARK, GOAL, Points, View
from ._drawing import Drawing, Episode, Vector


COILS = 6


def _draw_mass(canvas: Canvas, at: float, side: float) -> None:
    """A block on two rollers."""
    block = box(side, 0.9 * side, 0.08 * side)
    canvas.polygon(block, (at, 0.65 * side))
    for place in (-0.28, 0.28):
        canvas.wheel((at + place * side, 0.1 * side), 0.1 * side)


def _draw_force(canvas: Canvas, at: float, side: float, share: float) -> None:
    """The force on a mass, at its side."""
    start = at + math.copysign(0.58 * side, share)
    canvas.force((start, 0.65 * side), (1.5 * side * share, 0.0), 1.5 * side)


def double_integrator(canvas: Canvas, episode: Episode) -> Drawing:
    """A mass that rolls along a line, with a mark at the origin."""
    reach = np.abs(episode.states[:, 0]).max(initial=0.0)
    reach = float(np.clip(reach, 0.5, 10.0))
    side = 0.3 * reach
    canvas.ground()
    canvas.ax.plot([0], [-0.25 * side], marker="^", color=GOAL, markersize=11)
    half = np.array([1.35 * reach + side, 1.2 * side])
    view = View(np.array([0.0, 0.5 * side]), half)
    view.show(canvas.ax)

    def draw(x: Vector, u: Vector) -> None:
        place = float(x[0])
        _draw_mass(canvas, place, side)
        _draw_force(canvas, place, side, float(episode.shares(u)[0]))
        view.follow(canvas.ax, (place, view.centre[1]), side)

    return Drawing(draw)


def mass_spring_damper(canvas: Canvas, episode: Episode) -> Drawing:
    """A chain of masses from the wall, with marks where they rest, and the force on
    the last of them."""
    count = int(episode.system.masses)
    places = episode.states[:, :count]
    stretch = np.abs(np.diff(places, axis=1, prepend=0.0)).max(initial=0.0)
    stretch = float(stretch) if stretch > 0 else 1.0
    side = 0.75 * stretch
    rest = (side + 1.6 * stretch) * np.arange(1, count + 1) - side / 2
    gap = float(rest[0]) - side / 2
    canvas.ground()
    canvas.line([(0, 0), (0, 1.35 * side)], color=NEUTRAL, lw=2)
    for height in np.linspace(0.1, 1.25, 6) * side:  # the wall's hatching
        ends = [(-0.18 * side, height - 0.18 * side), (0, height)]
        canvas.line(ends, color=NEUTRAL, lw=1, alpha=0.6)
    marks = np.full(count, -0.22 * side)
    canvas.ax.plot(rest, marks, "^", color=GOAL, markersize=11)
    right = rest[-1] + float(places[:, -1].max(initial=0.0)) + 2.3 * side
    canvas.ax.set(xlim=(-0.4 * side, right), ylim=(-0.7 * side, 1.7 * side))

    def draw(x: Vector, u: Vector) -> None:
        left, place = 0.0, 0.0
        for place in map(float, rest + x[:count]):
            right = place - side / 2
            spring = zigzag(left, right, 0.85 * side, 0.14 * side)
            canvas.line(spring, color=DARK, lw=1.8, zorder=1)
            _draw_damper(canvas, left, right, 0.42 * side, gap, 0.12 * side)
            _draw_mass(canvas, place, side)
            left = place + side / 2
        _draw_force(canvas, place, side, float(episode.shares(u)[0]))

    return Drawing(draw)


def zigzag(start: float, end: float, height: float, swing: float) -> Points:
    """The corners of a spring between two places on a line."""
    lead = 0.12 * (end - start)
    xs = np.linspace(start + lead, end - lead, 2 * COILS + 1)
    ys = height + swing * np.array([0, *[1, -1] * COILS])[: 2 * COILS + 1]
    ys[-1] = height
    return np.array([[start, height], *zip(xs, ys, strict=True), [end, height]])


def _draw_damper(
    canvas: Canvas, start: float, end: float, height: float, rest: float, size: float
) -> None:
    """A cup on the left and a piston on the right, which moves in it."""
    near, far = start + 0.12 * rest, start + 0.34 * rest
    cup = np.array([[far, size], [near, size], [near, -size], [far, -size]])
    share = np.clip((end - start) / rest - 0.3, 0.05, 1.3) / 1.4
    plate = near + share * (far - near)
    for points in (
        cup + [0, height],
        [[start, height], [near, height]],
        [[plate, height + 0.7 * size], [plate, height - 0.7 * size]],
        [[plate, height], [end, height]],
    ):
        canvas.line(points, color=NEUTRAL, lw=1.6, zorder=1)
