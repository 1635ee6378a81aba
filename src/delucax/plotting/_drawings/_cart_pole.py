"""The cart and the pole on it."""

import math
from collections.abc import Callable

import numpy as np

from ..figures import NEUTRAL
from ._canvas import box, Canvas, SECOND, View
from ._drawing import Drawing, Episode, Vector


# Of the cart, in lengths of the pole.
WIDTH, HEIGHT, WHEEL = 0.56, 0.26, 0.08
HINGE = WHEEL + HEIGHT


def _cart_pole(
    canvas: Canvas,
    episode: Episode,
    length: float,
    lean: Callable[[Vector], float],
    hangs: bool,
    bob: float = 0.0,
) -> Drawing:
    """A cart on its track, and a pole that leans to the right by `lean(x)`, with a mass
    at its tip if `bob` is not 0. The track ends where the task says, and the view goes
    lower if the pole hangs at times."""
    canvas.ground()
    end = getattr(episode.environment.terminated, "max_position", None)
    if end is None:
        positions = np.abs(episode.states[:, 0]).max(initial=0.0)
        reach = float(np.clip(positions, 1.2 * length, 2.5 * length))
    else:
        reach = float(end)
        for side in (-reach, reach):
            ends = [(side, -0.12 * length), (side, 0.12 * length)]
            canvas.line(ends, color=NEUTRAL, lw=2)
    low = HINGE - 1.2 if hangs else -0.3
    low, high = low * length, (HINGE + 1.2) * length
    half = np.array([reach + 0.5 * WIDTH * length, (high - low) / 2])
    view = View(np.array([0.0, (high + low) / 2]), half)
    view.show(canvas.ax)
    width, radius = WIDTH * length, WHEEL * length
    middle = radius + HEIGHT * length / 2

    def draw(x: Vector, u: Vector) -> None:
        position, angle = float(x[0]), lean(x)
        hinge = np.array([position, HINGE * length])
        cart = box(width, HEIGHT * length, 0.05 * length)
        canvas.polygon(cart, (position, middle))
        for side in (-0.27, 0.27):
            canvas.wheel((position + side * width * 1.1, radius), radius)
        tip = hinge + length * np.array([math.sin(angle), math.cos(angle)])
        canvas.link(hinge, tip, width=7, color=SECOND, zorder=3)
        canvas.joint(hinge, 0.045 * length)
        share = float(episode.shares(u)[0])
        side = position + math.copysign(width / 2 + 0.04 * length, share)
        canvas.force((side, middle), (0.6 * length * share, 0.0), 0.6 * length)
        view.follow(canvas.ax, (position, view.centre[1]), 0.5 * width)
        if bob:
            canvas.disc(tip, bob * length, SECOND, zorder=3)

    return Drawing(draw)


def cart_pole(canvas: Canvas, episode: Episode) -> Drawing:
    """A pole that leans to the right for positive angles."""
    length = 2 * float(episode.system.half_length)
    hangs = np.cos(episode.states[:, 2]).min(initial=1.0) < 0.3
    return _cart_pole(canvas, episode, length, lambda x: float(x[2]), bool(hangs))


def linear_cart_pole(canvas: Canvas, episode: Episode) -> Drawing:
    """A rod with a mass at its tip, which leans to the left for positive angles. Its
    length is found in how much more a force accelerates the cart than the angle."""
    B = np.asarray(episode.system.B, float).reshape(-1, 4, 1)
    cart, turning = B[0, 2:, 0]
    length = float(cart / turning) if turning * cart > 0 else 1.0
    lean = lambda x: -float(x[1])
    # The model is true near the upright alone, so its pole never hangs.
    return _cart_pole(canvas, episode, length, lean, hangs=False, bob=0.09)
