"""Mechanical plants: links on hinges, carts and masses, and a car in a valley."""

import functools
import math
from collections.abc import Callable, Sequence

import numpy as np
from jaxtyping import Float

from ..._figures import color_of
from ._canvas import box, Canvas, Drawing, Episode, Points, rotation, Vector


def pendulum(canvas: Canvas, episode: Episode) -> Drawing:
    """A rod of length 1 with a bob, hinged at the origin. Angle 0 is upright, and the
    angle grows anticlockwise. The torque is an arc of up to 240 degrees about the
    hinge."""
    canvas.reach(1, room=1.25)
    canvas.line([(0, 1.06), (0, 1.16)], color=canvas.NEUTRAL, linewidth=2)

    def draw(x: Vector, u: Vector) -> None:
        angle = float(x[0])
        tip = np.array([-np.sin(angle), np.cos(angle)])
        canvas.link((0, 0), tip)
        canvas.disc(tip, 0.11)
        share = float(episode.shares(u)[0])
        canvas.torque((0, 0), 0.36, angle + np.pi / 2, share)
        canvas.joint((0, 0), 0.055)

    return Drawing(draw)


def arm_points(
    x: Float[np.ndarray, "*times states"],
    lengths: tuple[float, float],
    zero: float = 0.0,
) -> Float[np.ndarray, "*times 3 2"]:
    """The hinge, the elbow and the tip of two links. At angle 0 they are turned by
    `zero` from hanging."""
    first = x[..., 0] + zero
    both = first + x[..., 1]
    elbow = lengths[0] * np.stack([np.sin(first), -np.cos(first)], axis=-1)
    tip = elbow + lengths[1] * np.stack([np.sin(both), -np.cos(both)], axis=-1)
    return np.stack([np.zeros_like(elbow), elbow, tip], axis=-2)


def _draw_arm(canvas: Canvas, points: Points, reach: float, bob: float = 0.0) -> None:
    """Two links through three points, with bobs on the last two."""
    canvas.link(points[1], points[2], color=canvas.SECOND)
    canvas.link(points[0], points[1])
    if bob:
        canvas.disc(points[2], bob * reach, canvas.SECOND)
        canvas.disc(points[1], bob * reach, canvas.BODY)
    for point in points[:2]:
        canvas.joint(point, 0.028 * reach)


def acrobot(canvas: Canvas, episode: Episode) -> Drawing:
    """Two links that hang at angle 0, with the torque as an arc about the elbow, and
    the line that the tip must reach."""
    system = episode.system
    # The system does not hold the length of the second link. Take the centre of mass as
    # its middle.
    lengths = float(system.length_1), 2 * float(system.center_2)
    reach = sum(lengths)
    canvas.reach(reach)
    height = getattr(episode.environment.terminated, "goal_height", None)
    if height is not None:
        ends = [(-1.2 * reach, float(height)), (1.2 * reach, float(height))]
        canvas.line(ends, color=canvas.GOAL, lw=2, ls=canvas.LONG_DASHES)

    def draw(x: Vector, u: Vector) -> None:
        points = arm_points(x, lengths)
        _draw_arm(canvas, points, reach)
        share, outward = float(episode.shares(u)[0]), x[0] + x[1] - np.pi / 2
        canvas.torque(points[1], 0.16 * reach, outward, share)

    return Drawing(draw)


def reacher(canvas: Canvas, episode: Episode) -> Drawing:
    """Two links that lie along x at angle 0, with masses at their ends, and the torque
    as an arc about each joint. The hand leaves a path."""
    system = episode.system
    lengths = float(system.length_1), float(system.length_2)
    reach = sum(lengths)
    canvas.reach(reach)
    goal = getattr(episode.environment.cost, "goal", None)
    if goal is not None:
        canvas.goal(np.asarray(goal), 0.06 * reach)
    points = functools.partial(arm_points, lengths=lengths, zero=np.pi / 2)

    def draw(x: Vector, u: Vector) -> None:
        joints = points(x)
        _draw_arm(canvas, joints, reach, 0.045)
        for i, share in enumerate(episode.shares(u)):
            canvas.torque(joints[i], 0.16 * reach, x[: i + 1].sum(), float(share))

    return Drawing(draw, lambda states: points(states)[:, 2])


# The size of the cart under a pole, relative to the length of the pole.
WIDTH, HEIGHT, WHEEL = 0.56, 0.26, 0.08
HINGE = WHEEL + HEIGHT


def _cart_pole(
    canvas: Canvas,
    episode: Episode,
    lengths: Sequence[float],
    lean: Callable[[Vector], Vector],
    hangs: bool,
    bob: float = 0.0,
) -> Drawing:
    """A cart on its track, and a chain of poles that lean to the right by `lean(x)`,
    with a mass at the tip if `bob` is not 0. The track ends at the limits of the task,
    if it has any. The view reaches lower if `hangs`."""
    canvas.ground()
    whole, size = sum(lengths), sum(lengths) / len(lengths)
    end = getattr(episode.environment.terminated, "max_position", None)
    if end is None:
        positions = np.abs(episode.states[:, 0]).max(initial=0.0)
        reach = float(np.clip(positions, 1.2 * whole, 2.5 * whole))
    else:
        reach = float(end)
        for side in (-reach, reach):
            ends = [(side, -0.12 * size), (side, 0.12 * size)]
            canvas.line(ends, color=canvas.NEUTRAL, lw=2)
    low = HINGE * size - 1.2 * whole if hangs else -0.3 * size
    high = HINGE * size + 1.2 * whole
    half = reach + 0.5 * WIDTH * size, (high - low) / 2
    view = canvas.view((0.0, (high + low) / 2), half)
    width, radius = WIDTH * size, WHEEL * size
    middle = radius + HEIGHT * size / 2
    colors = canvas.SECOND, color_of(4)

    def draw(x: Vector, u: Vector) -> None:
        position = float(x[0])
        cart = box(width, HEIGHT * size, 0.05 * size)
        canvas.polygon(cart, (position, middle))
        for side in (-0.27, 0.27):
            canvas.wheel((position + side * width * 1.1, radius), radius)
        hinge = tip = np.array([position, HINGE * size])
        for length, angle, color in zip(lengths, lean(x), colors, strict=False):
            hinge = tip
            tip = hinge + length * np.array([math.sin(angle), math.cos(angle)])
            canvas.link(hinge, tip, width=7, color=color, zorder=3)
            canvas.joint(hinge, 0.045 * size)
        share, gap = float(episode.shares(u)[0]), width / 2 + 0.04 * size
        canvas.push((position, middle), gap, 0.6 * size, share)
        view.follow((position, view.centre[1]), 0.5 * width)
        if bob:
            canvas.disc(tip, bob * size, canvas.SECOND, zorder=3)

    return Drawing(draw)


def _hangs(angles: Float[np.ndarray, "times poles"]) -> bool:
    """Whether a pole hangs down at any time."""
    return bool(np.cos(angles).min(initial=1.0) < 0.3)


def cart_pole(canvas: Canvas, episode: Episode) -> Drawing:
    """A pole that leans to the right for positive angles."""
    lengths = [2 * float(episode.system.half_length)]
    hangs = _hangs(episode.states[:, 2:3])
    return _cart_pole(canvas, episode, lengths, lambda x: x[2:3], hangs)


def double_pendulum_cart(canvas: Canvas, episode: Episode) -> Drawing:
    """Two poles that lean to the right for positive angles."""
    lengths = [float(episode.system.length_1), float(episode.system.length_2)]
    hangs = _hangs(episode.states[:, 1:3])
    return _cart_pole(canvas, episode, lengths, lambda x: x[1:3], hangs)


def linear_cart_pole(canvas: Canvas, episode: Episode) -> Drawing:
    """A rod with a mass at its tip, which leans to the left for positive angles. Its
    length is the acceleration of the cart over that of the angle, for the same
    force."""
    B = np.asarray(episode.system.B, float).reshape(-1, 4, 1)
    cart, turning = B[0, 2:, 0]
    length = float(cart / turning) if turning * cart > 0 else 1.0
    lean = lambda x: -x[1:2]
    # The model holds only near the upright, so its pole never hangs.
    return _cart_pole(canvas, episode, [length], lean, hangs=False, bob=0.09)


COILS = 6


def _draw_mass(canvas: Canvas, at: float, side: float, share: float = 0.0) -> None:
    """A block on two rollers, and the force on it."""
    block = box(side, 0.9 * side, 0.08 * side)
    canvas.polygon(block, (at, 0.65 * side))
    for place in (-0.28, 0.28):
        canvas.wheel((at + place * side, 0.1 * side), 0.1 * side)
    canvas.push((at, 0.65 * side), 0.58 * side, 1.5 * side, share)


def double_integrator(canvas: Canvas, episode: Episode) -> Drawing:
    """A mass that rolls along a line, with a mark at the origin."""
    reach = np.abs(episode.states[:, 0]).max(initial=0.0)
    reach = float(np.clip(reach, 0.5, 10.0))
    side = 0.3 * reach
    canvas.ground()
    canvas.ax.plot([0], [-0.25 * side], marker="^", color=canvas.GOAL, markersize=11)
    view = canvas.view((0.0, 0.5 * side), (1.35 * reach + side, 1.2 * side))

    def draw(x: Vector, u: Vector) -> None:
        place = float(x[0])
        _draw_mass(canvas, place, side, float(episode.shares(u)[0]))
        view.follow((place, view.centre[1]), side)

    return Drawing(draw)


def mass_spring_damper(canvas: Canvas, episode: Episode) -> Drawing:
    """A chain of masses attached to a wall, with marks at their rest positions, and the
    force on the last mass."""
    count = int(episode.system.masses)
    places = episode.states[:, :count]
    stretch = np.abs(np.diff(places, axis=1, prepend=0.0)).max(initial=0.0)
    stretch = float(stretch) if stretch > 0 else 1.0
    side = 0.75 * stretch
    rest = (side + 1.6 * stretch) * np.arange(1, count + 1) - side / 2
    gap = float(rest[0]) - side / 2
    canvas.ground()
    canvas.line([(0, 0), (0, 1.35 * side)], color=canvas.NEUTRAL, lw=2)
    for height in np.linspace(0.1, 1.25, 6) * side:  # the wall's hatching
        ends = [(-0.18 * side, height - 0.18 * side), (0, height)]
        canvas.line(ends, color=canvas.NEUTRAL, lw=1, alpha=0.6)
    marks = np.full(count, -0.22 * side)
    canvas.ax.plot(rest, marks, "^", color=canvas.GOAL, markersize=11)
    right = rest[-1] + float(places[:, -1].max(initial=0.0)) + 2.3 * side
    canvas.ax.set(xlim=(-0.4 * side, right), ylim=(-0.7 * side, 1.7 * side))

    def draw(x: Vector, u: Vector) -> None:
        left = 0.0
        shares = [*[0.0] * (count - 1), float(episode.shares(u)[0])]
        for place, share in zip(rest + x[:count], shares, strict=True):
            right = place - side / 2
            spring = zigzag(left, right, 0.85 * side, 0.14 * side)
            canvas.line(spring, color=canvas.DARK, lw=1.8, zorder=1)
            _draw_damper(canvas, left, right, 0.42 * side, gap, 0.12 * side)
            _draw_mass(canvas, place, side, share)
            left = place + side / 2

    return Drawing(draw)


def zigzag(start: float, end: float, height: float, swing: float) -> Points:
    """The corners of a spring between two places on a line."""
    lead = 0.12 * (end - start)
    xs = np.linspace(start + lead, end - lead, 2 * COILS + 1)
    ys = height + swing * np.array([0, *[1, -1] * (COILS - 1), 1, 0])
    return np.array([[start, height], *zip(xs, ys, strict=True), [end, height]])


def _draw_damper(
    canvas: Canvas, start: float, end: float, height: float, rest: float, size: float
) -> None:
    """A cup on the left and a piston on the right that moves in the cup."""
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
        canvas.line(points, color=canvas.NEUTRAL, lw=1.6, zorder=1)


CAR_LENGTH, CAR_HEIGHT, CAR_WHEEL = 0.17, 0.06, 0.028


def mountain_car(canvas: Canvas, episode: Episode) -> Drawing:
    """A car on hilly ground, with the force along the slope, and a flag at the goal."""
    ax, environment = canvas.ax, episode.environment
    positions = episode.states[:, 0]
    low = getattr(environment.dynamics, "min_position", -1.2)
    high = getattr(environment.dynamics, "max_position", 0.6)
    low = max(min(float(low), positions.min()), -4.0) - 0.1
    high = min(max(float(high), positions.max()), 4.0) + 0.1
    xs = np.linspace(low, high, 300)
    ys = np.asarray(episode.system.height(xs), float)
    slopes = np.gradient(ys, xs)
    floor = ys.min() - 0.12
    ax.fill_between(xs, ys, floor, color=canvas.NEUTRAL, alpha=0.18, lw=0)
    ax.plot(xs, ys, color=canvas.NEUTRAL, lw=2)
    goal = getattr(environment.terminated, "goal_position", None)
    if goal is not None:
        foot = np.array([float(goal), float(np.interp(float(goal), xs, ys))])
        canvas.line([foot, foot + [0, 0.26]], color=canvas.NEUTRAL, lw=2)
        flag = np.array([(0, 0.26), (0.13, 0.21), (0, 0.16)])
        canvas.polygon(flag, foot, color=canvas.GOAL, zorder=1)
    ax.set(xlim=(low, high), ylim=(floor, ys.max() + 0.3))

    def draw(x: Vector, u: Vector) -> None:
        place = float(x[0])
        foot = np.array([place, np.interp(place, xs, ys)])
        angle = math.atan(np.interp(place, xs, slopes))
        turned = rotation(angle)
        for side in (-0.28, 0.28):
            canvas.wheel(foot + turned @ (side * CAR_LENGTH, CAR_WHEEL), CAR_WHEEL)
        middle = foot + turned @ (0.0, 1.4 * CAR_WHEEL + CAR_HEIGHT / 2)
        canvas.polygon(box(CAR_LENGTH, CAR_HEIGHT, 0.02), middle, angle)
        cabin = np.array([[-0.4, 0], [0.3, 0], [0.15, 1], [-0.28, 1]])
        roof = cabin * [CAR_LENGTH, 0.75 * CAR_HEIGHT] + [0.0, CAR_HEIGHT / 2]
        canvas.polygon(roof, middle, angle, color=canvas.SECOND)
        share = float(episode.shares(u)[0])
        canvas.push(middle, CAR_LENGTH / 2 + 0.015, 0.22, share, angle)

    return Drawing(draw)
