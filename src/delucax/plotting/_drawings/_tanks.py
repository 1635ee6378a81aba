"""The two tanks, one above the other."""

import numpy as np

from ..figures import NEUTRAL
from ._canvas import ACTION, BODY, Canvas, GOAL, LONG_DASHES, SECOND
from ._drawing import Drawing, Episode, Vector


HEIGHT, FALL = 1.0, 0.42  # of a tank, and of the water between them
BOTTOMS = (HEIGHT + FALL, 0.0)
TOP = BOTTOMS[0] + 1.12 * HEIGHT


def two_tank(canvas: Canvas, episode: Episode) -> Drawing:
    """The tanks, as wide as the roots of their areas; their levels, and the one to
    hold; what runs out of each, and what the pump pours in."""
    system, target = episode.system, episode.target
    roots = np.sqrt([float(system.upper_area), float(system.lower_area)])
    widths = 1.1 * roots / roots.max()
    holes = np.sqrt([float(system.upper_outlet), float(system.lower_outlet)])
    holes = 0.09 * holes / holes.max()
    tallest = max(float(episode.states.max(initial=0.0)), 1e-6)
    if target is not None:
        tallest = max(tallest, 1.5 * float(target[1]))
    for bottom, width, hole in zip(BOTTOMS, widths, holes, strict=True):
        for side, gap in ((-width / 2, -hole / 2), (width / 2, hole / 2)):
            walls = [(side, HEIGHT * 1.12), (side, 0), (gap, 0), (gap, -0.07)]
            style = {"lw": 2.5, "solid_joinstyle": "round", "zorder": 3}
            canvas.line(np.array(walls) + [0, bottom], color=NEUTRAL, **style)
    if target is not None:
        height, edge = HEIGHT * float(target[1]) / tallest, 0.5 * widths[1] + 0.14
        ends = [(-edge, height), (edge, height)]
        canvas.line(ends, color=GOAL, lw=2, ls=LONG_DASHES, zorder=4)
    pipe = [(-0.75, TOP + 0.3), (0, TOP + 0.3), (0, TOP + 0.16)]
    canvas.line(pipe, color=NEUTRAL, lw=9, solid_capstyle="butt", zorder=3)
    canvas.ax.set(xlim=(-1.15, 1.15), ylim=(-0.5, TOP + 0.4))

    def draw(x: Vector, u: Vector) -> None:
        heights = HEIGHT * np.clip(x[:2] / tallest, 0.0, 1.12)
        share = float(episode.shares(u)[0])
        if share > 0.005:
            surface = BOTTOMS[0] + heights[0]
            _draw_water(canvas, 0.14 * share, surface, TOP + 0.16, ACTION)
        # The upper stream falls to the lower level, the lower one out of the picture.
        ends = heights[1], -0.5
        for i, bottom in enumerate(BOTTOMS):
            top = bottom + heights[i]
            _draw_water(canvas, widths[i], bottom, top, BODY, alpha=0.75)
            # By Torricelli's law the stream is as the root of the level.
            stream = holes[i] * float(np.sqrt(heights[i] / HEIGHT))
            _draw_water(canvas, stream, ends[i], bottom, SECOND)

    return Drawing(draw)


def _draw_water(
    canvas: Canvas,
    width: float,
    low: float,
    high: float,
    color: str,
    alpha: float = 1.0,
) -> None:
    """Water of a width about the middle."""
    style = {"color": color, "alpha": alpha, "lw": 0, "zorder": 2}
    canvas.rectangle((-width / 2, low), width, high - low, **style)
