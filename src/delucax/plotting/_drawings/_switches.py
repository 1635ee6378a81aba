"""Plants that bounce, switch and stick: a ball, a room, a mass on a belt, a valve."""

import numpy as np

from ._canvas import box, Canvas, Drawing, Episode, Past, rotation, Vector
from ._mechanics import zigzag


def ball(canvas: Canvas, episode: Episode) -> Drawing:
    """A ball above the floor, a ruler that marks the top of each flight, and the height
    to reach."""
    cost = episode.environment.cost
    goals = [getattr(term, "height", None) for term in getattr(cost, "terms", [cost])]
    goals = [float(goal) for goal in goals if goal is not None]
    top = max(float(episode.states[:, 0].max(initial=0.0)), *goals, 1e-3)
    radius, side = 0.07 * top, 0.55 * top
    canvas.ground()
    for height in np.linspace(0, top, 11):
        ends = [(-side, height), (-side + 0.06 * top, height)]
        canvas.line(ends, color=canvas.NEUTRAL, lw=1)
    canvas.line([(-side, 0), (-side, top)], color=canvas.NEUTRAL, lw=1.5)
    for goal in goals:
        ends = [(-side, goal), (side, goal)]
        canvas.line(ends, color=canvas.GOAL, lw=2, ls=canvas.LONG_DASHES, zorder=0)
    view = canvas.view((0.0, 0.55 * top), (1.2 * side, 0.68 * top))

    def draw(x: Vector, u: Vector, past: Past) -> None:
        heights, speeds = past[1][:, 0], past[1][:, 1]
        # A flight has passed its top when the ball no longer rises.
        tops = np.flatnonzero((speeds[:-1] > 0) & (speeds[1:] <= 0))
        for height in np.maximum(heights[tops], heights[tops + 1]):
            ends = [(-0.95 * side, height), (-0.3 * side, height)]
            canvas.line(ends, color=canvas.BODY, lw=1.5, alpha=0.4, zorder=1)
        # The height in the state is that of the lowest point of the ball.
        middle = (0.0, float(x[0]) + radius)
        canvas.disc(middle, radius)
        share = float(episode.shares(u)[0])
        # Beside the ball and above its middle, so that it does not enter the floor.
        length = 0.25 * top * share
        start = 1.7 * radius, middle[1] + max(0.0, -length)
        canvas.force(start, (0, length), 0.25 * top)
        view.follow(np.array(middle), radius)

    return Drawing(draw, walks=True)


TUBE, BULB = (0.62, -0.55), 0.13


def thermostat(canvas: Canvas, episode: Episode) -> Drawing:
    """A house with a heater that glows while it is on, a thermometer with the band of
    the thermostat beside it, and the second source of heat as an arrow."""
    system, states = episode.system, episode.states
    low, high = float(system.low), float(system.high)
    ends = min(low, states[:, 0].min()), max(high, states[:, 0].max())
    middle = (ends[0] + ends[1]) / 2
    scale = 0.42 / max((ends[1] - ends[0]) / 2, 1e-6)
    height = lambda temperature: 0.2 + scale * (temperature - middle)

    walls = [(-1, 0.95), (-1, -0.9), (1, -0.9), (1, 0.95)]
    roof = [(-1.15, 0.83), (0, 1.45), (1.15, 0.83)]
    for corners in (walls, roof):
        canvas.line(corners, color=canvas.NEUTRAL, lw=4, solid_joinstyle="round")
    column, bottom = TUBE
    band = box(0.42, height(high) - height(low), 0.01)
    canvas.polygon(
        band, (column, height((low + high) / 2)), color=canvas.GOAL, alpha=0.25
    )
    style = {"size": 10, "va": "center", "color": "0.25"}
    for end in (low, high):
        canvas.ax.text(column - 0.26, height(end), f"{end:g}", ha="right", **style)
    tube = box(0.13, 1.42, 0.06)
    canvas.polygon(tube, (column, bottom + 0.71), color="white", zorder=2)
    outline = {"color": canvas.NEUTRAL, "lw": 1.5, "zorder": 4}
    canvas.line(np.concatenate([tube, tube[:1]]) + [column, bottom + 0.71], **outline)
    canvas.disc((column, bottom), BULB, canvas.BODY, zorder=5)
    canvas.view((0.0, 0.25), (1.45, 1.3))

    def draw(x: Vector, u: Vector) -> None:
        level = float(np.clip(height(float(x[0])), bottom, bottom + 1.4))
        canvas.bar((column, bottom), 0.07, level, color=canvas.BODY, zorder=3)
        is_on = round(float(x[1])) == 1
        color = canvas.ACTION if is_on else canvas.NEUTRAL
        for place in -0.75 + 0.13 * np.arange(5):
            rib = box(0.1, 0.42, 0.045)
            canvas.polygon(rib, (place, -0.6), color=color, alpha=1 if is_on else 0.5)
        if is_on:  # warm air rises from the heater
            ys = np.linspace(0, 0.4, 30)
            for place in (-0.7, -0.5, -0.28):
                wave = np.stack([place + 0.035 * np.sin(16 * ys), ys - 0.3], axis=-1)
                canvas.line(wave, color=color, lw=2, alpha=0.6)
        share = float(episode.shares(u)[0])
        canvas.force((0.1, -0.2), (0, 0.6 * share), 0.6)

    return Drawing(draw)


def stick_slip(canvas: Canvas, episode: Episode) -> Drawing:
    """A block on a belt over two turning rollers, held by a spring. The block is dark
    while it sticks. A mark shows its target."""
    belt, places = float(episode.system.belt), episode.states[:, 0]
    reach = float(max(np.abs(places).max(initial=0.0), 1e-3))
    side, roller = 0.9 * reach, 0.35 * reach
    wall, end = -3.2 * reach, 2.6 * reach
    canvas.line([(wall, 0), (wall, 1.5 * side)], color=canvas.NEUTRAL, lw=2)
    for height in np.linspace(0.1, 1.4, 6) * side:
        ends = [(wall - 0.18 * side, height - 0.18 * side), (wall, height)]
        canvas.line(ends, color=canvas.NEUTRAL, lw=1, alpha=0.6)
    start = wall + 1.2 * reach
    for sign in (1, -1):
        edge = [(start, sign * roller - roller), (end, sign * roller - roller)]
        canvas.line(edge, color=canvas.NEUTRAL, lw=3)
    for place in (start, end):
        canvas.circle((place, -roller), roller, fc="white", ec=canvas.NEUTRAL, lw=3)
    if episode.target is not None:
        canvas.ax.plot(
            [float(episode.target[0])], [-3.1 * roller], "^", color=canvas.GOAL, ms=11
        )
    half = (end - wall) / 2 + 0.8 * reach
    middle = (wall + end) / 2 + 0.2 * reach
    canvas.view((middle, 0.15 * reach), (half, 0.62 * half))

    def draw(x: Vector, u: Vector, past: Past) -> None:
        moved = belt * float(past[0][-1])
        gap = 0.45 * reach
        marks = start + np.arange(moved % gap, end - start, gap)
        for mark in marks:
            ends = [(mark, 0), (mark, -0.25 * roller)]
            canvas.line(ends, color=canvas.NEUTRAL, lw=2)
        for place in (start, end):
            spoke = roller * rotation(-moved / roller)[:, 0]
            centre = np.array([place, -roller])
            ends = [centre - 0.7 * spoke, centre + 0.7 * spoke]
            canvas.line(ends, color=canvas.NEUTRAL, lw=2, zorder=4)
        at = float(x[0])
        spring = zigzag(wall, at - side / 2, 0.55 * side, 0.16 * side)
        canvas.line(spring, color=canvas.DARK, lw=1.8, zorder=1)
        sticks = round(float(x[2])) == 0
        color = canvas.DARK if sticks else canvas.BODY
        block = box(side, 0.9 * side, 0.08 * side)
        canvas.polygon(block, (at, 0.49 * side), color=color)
        share = float(episode.shares(u)[0])
        canvas.push((at, 0.49 * side), 0.58 * side, 1.1 * side, share)

    return Drawing(draw, walks=True)


DISC, CAP, STEM = 0.12, 1.65, 1.7  # in units of the valve's travel


def valve(canvas: Canvas, episode: Episode) -> Drawing:
    """A disc on a stem between its seat and its stop, with the spring, the flow through
    the port, and the force on the stem. The seat and the stop are green while the disc
    rests on them."""
    seat, stop = -0.06, 1.06 + DISC
    for sign in (-1, 1):
        wall = np.array([(0.75, -0.45), (0.75, CAP), (0.1, CAP)]) * [sign, 1]
        canvas.line(wall, color=canvas.NEUTRAL, lw=4, zorder=1)
    canvas.view((0.0, 1.2), (1.6, 1.7))

    def draw(x: Vector, u: Vector) -> None:
        place, mode = float(x[0]), round(float(x[2]))
        for own, height, inner in ((1, seat, 0.3), (2, stop, 0.42)):
            color = canvas.GOAL if mode == own else canvas.NEUTRAL
            for sign in (-1, 1):
                ledge = [(sign * 0.72, height), (sign * inner, height)]
                canvas.line(ledge, color=color, lw=6, solid_capstyle="butt", zorder=1)
        opening = float(np.clip(place, 0, 1))
        if opening > 0.01:
            canvas.bar((0, -0.45), 0.58 * opening, 0.0, color=canvas.SECOND, zorder=0)
        top = place + DISC
        canvas.polygon(box(1.0, DISC, 0.03), (0, top - DISC / 2))
        canvas.bar((0, top), 0.09, top + STEM, color=canvas.BODY)
        spring = zigzag(top, CAP, 0.0, 0.2)[:, ::-1]
        canvas.line(spring, color=canvas.DARK, lw=1.8, zorder=3)
        share = float(episode.shares(u)[0])
        canvas.force((0.3, top + STEM - 0.6), (0, 0.55 * share), 0.55)

    return Drawing(draw)
