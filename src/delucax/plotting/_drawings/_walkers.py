"""A rimless wheel and two walkers, on their slopes."""

import math
from collections.abc import Callable

import numpy as np
from jaxtyping import Float

from ._canvas import Canvas, Drawing, Episode, Past, Point, Vector


# The least drop of the angle between the legs at a step. It tells a step from legs that
# swing back past each other between two samples.
LEAST_DROP = 0.15


def _downhill(slope: float) -> Float[np.ndarray, "2"]:
    return np.array([math.cos(slope), -math.sin(slope)])


def _spoke(angle: float, length: float) -> Float[np.ndarray, "2"]:
    """The vector from the foot to the hip of a leg that leans to the left by
    `angle`."""
    return length * np.array([-math.sin(angle), math.cos(angle)])


class _Slope:
    """The hatched ground, and a view that follows the hip. In lengths of the leg, the
    view reaches `wide` to both sides, 0.4 below the foot and `above` over the hip."""

    def __init__(
        self, canvas: Canvas, angle: float, length: float, wide: float, above: float
    ):
        self.canvas, self.angle = canvas, angle
        half = (1.4 + above) / 2
        self.middle = np.array([0.0, (above - 1.4) / 2 * length])
        centre = np.array([0.9, 1.0]) * length + self.middle
        self.view = canvas.view(centre, (wide * length, half * length))
        line = {"slope": -math.tan(angle), "color": canvas.NEUTRAL, "lw": 2}
        canvas.ax.axline((0, 0), **line, zorder=1)

    def follow(self, hip: Point) -> None:
        """Move the view to a hip, and draw the hatching in it."""
        canvas, half = self.canvas, self.view.half[0]
        self.view.follow(np.asarray(hip) + self.middle, 0.55 * half)
        along, down = _downhill(self.angle), _downhill(self.angle + math.pi / 2)
        gap = 0.08 * half
        first = int((float(np.dot(hip, along)) - 2.6 * half) / gap)
        starts = gap * np.arange(first, first + 65)[:, None] * along
        ends = starts + 0.7 * gap * (down - along)
        blank = np.full_like(starts, np.nan)
        strokes = np.stack([starts, ends, blank], axis=1).reshape(-1, 2)
        canvas.line(strokes, color=canvas.NEUTRAL, lw=1, alpha=0.6, zorder=0)


def rimless_wheel(canvas: Canvas, episode: Episode) -> Drawing:
    """A wheel of spokes that stands on one of them, one spoke in another colour, and
    the torque as an arc about the hub."""
    system = episode.system
    length, half, slope = (float(a) for a in (system.length, system.half, system.slope))
    ground = _Slope(canvas, slope, length, wide=2.1, above=1.15)
    chord = 2 * length * math.sin(half) * _downhill(slope)
    count = max(2, round(math.pi / half))

    def draw(x: Vector, u: Vector, past: Past) -> None:
        _, states = past
        # Between samples the wheel turns by less than half a jump, so that rounding
        # counts the jumps.
        turned = np.round(np.diff(states[:, 0]) / (2 * half))
        steps = -int(np.nansum(turned))
        foot = steps * chord
        hub = foot + _spoke(-float(x[0]), length)
        for i in range(count):
            spoke = _spoke(-float(x[0]) + 2 * half * (i - steps), length)
            color = canvas.BODY if i else canvas.SECOND
            canvas.link(hub, hub - spoke, width=5, color=color, zorder=2 + (not i))
        canvas.disc(hub, 0.13 * length, canvas.DARK, zorder=4)
        share = -float(episode.shares(u)[0])
        canvas.torque(hub, 0.42 * length, math.pi / 2, share)
        ground.follow(hub)

    return Drawing(draw, walks=True)


Legs = Callable[[Float[np.ndarray, "*times states"]], Float[np.ndarray, "*times 2"]]


def _walker(
    canvas: Canvas,
    episode: Episode,
    legs: Legs,
    length: float,
    slope: float,
    mass: float | None,
) -> Drawing:
    """Two legs with the swing and stance angles `legs(states)`, which are measured from
    the vertical to the left. `mass` is the distance of the masses from the feet."""
    ground = _Slope(canvas, slope, length, wide=1.8, above=0.25)

    def draw(x: Vector, u: Vector, past: Past) -> None:
        swing, stance = legs(past[1]).T
        gap = swing - stance
        strikes = (gap[:-1] > 0) & (gap[1:] < 0) & (gap[:-1] - gap[1:] > LEAST_DROP)
        strikes = np.flatnonzero(strikes)
        # A step moves the foot from the stance foot to the swing foot, as they were
        # just before.
        leads = [np.sin(swing) - np.sin(stance), np.cos(stance) - np.cos(swing)]
        foot = length * np.sum(np.stack(leads, axis=-1)[strikes], axis=0)
        swing, stance = (float(a) for a in legs(x))
        hip = foot + _spoke(stance, length)
        colors = (canvas.BODY, canvas.SECOND)
        # The legs swap their roles at each step, but keep their colours.
        own = colors if len(strikes) % 2 == 0 else colors[::-1]
        for angle, color in zip((stance, swing), own, strict=True):
            tip = hip - _spoke(angle, length)
            canvas.link(hip, tip, width=7, color=color, zorder=2 + (angle == stance))
            if mass is not None:
                canvas.disc(tip + _spoke(angle, mass), 0.08 * length, color, zorder=4)
        canvas.disc(hip, 0.11 * length, canvas.DARK, zorder=4)
        share = float(episode.shares(u)[0])
        canvas.torque(hip, 0.3 * length, swing - math.pi / 2, -share)
        ground.follow(hip)

    return Drawing(draw, walks=True)


def compass_gait(canvas: Canvas, episode: Episode) -> Drawing:
    """The legs with their masses, and the torque on the swing leg as an arc about the
    hip."""
    system = episode.system
    lower, upper, slope = (float(a) for a in (system.lower, system.upper, system.slope))
    legs = lambda states: states[..., :2]
    return _walker(canvas, episode, legs, lower + upper, slope, lower)


def simplest_walker(canvas: Canvas, episode: Episode) -> Drawing:
    """The legs, and the torque on the swing leg as an arc about the hip."""
    slope = float(episode.system.slope)

    def legs(states):
        stance = states[..., 0] - slope
        return np.stack([stance - states[..., 2], stance], axis=-1)

    return _walker(canvas, episode, legs, 1.0, slope, None)
