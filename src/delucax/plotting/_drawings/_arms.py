"""Links on hinges: the pendulum, the acrobot and the reacher."""

import functools

import numpy as np
from jaxtyping import Float

from ._canvas import Canvas, Drawing, Episode, Points, Vector


def pendulum(canvas: Canvas, episode: Episode) -> Drawing:
    """A rod of length 1 with a bob, hinged at the origin, angle 0 upright and growing
    anticlockwise; the torque is an arc of up to 240 degrees about the hinge."""
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
    """The hinge, the elbow and the tip of two links, which are `zero` from hanging at
    angle 0."""
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
    the line above which the tip is to come."""
    system = episode.system
    # The second link has no length: its centre of mass is taken for its middle.
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
    """Two links along x at angle 0, with masses at their ends, and a torque as an arc
    about each joint; the hand leaves a path."""
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
        outward = np.cumsum(x[:2])
        for joint, start, share in zip(
            joints, outward, episode.shares(u), strict=False
        ):
            canvas.torque(joint, 0.16 * reach, start, float(share))

    return Drawing(draw, lambda states: points(states)[:, 2])
