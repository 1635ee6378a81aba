"""Plants that stay in place: a lung, a motor, and two tanks."""

import math

import numpy as np
from matplotlib.patches import Wedge

from ..._figures import color_of
from ._canvas import Canvas, Drawing, Episode, FULL_TURN, rotation, Vector


_VOLUMES = ("volume", "fast", "slow")
_PRESSURES = ("sensed pressure", "pipe", "pressure")
_SCALE = 60.0  # cmH2O at the top of the gauge


def lung(canvas: Canvas, episode: Episode) -> Drawing:
    """A lung whose size shows how full it is, a pressure gauge with the target
    pressures, and the openings of the valves."""
    environment, states = episode.environment, episode.states
    names = list(environment.dynamics.state_names)
    pressure = next((names.index(name) for name in _PRESSURES if name in names), 0)
    parts = [names.index(name) for name in _VOLUMES if name in names] or [pressure]
    low, high = states[:, parts].min(axis=0), states[:, parts].max(axis=0)
    span = np.where(high > low, high - low, 1.0)
    single = len(parts) == 1
    centres = [(0.0, 0.0)] if single else [(-0.5, 0.0), (0.5, 0.0)]
    largest, colors = 0.95 if single else 0.55, (canvas.BODY, canvas.SECOND)

    pipe = [(0, 0.95), (0, 1.45)]
    canvas.line(pipe, color=canvas.NEUTRAL, lw=9, solid_capstyle="butt", zorder=1)
    gauge = {"fill": False, "ec": canvas.NEUTRAL, "lw": 1.5, "zorder": 3}
    canvas.bar((1.36, -0.9), 0.22, 1.4, **gauge)
    waveform = getattr(environment.cost, "waveform", None)
    if waveform is not None:
        for level in (float(waveform.pip), float(waveform.peep)):
            height = -0.9 + 2.3 * level / _SCALE
            ends = [(1.13, height), (1.59, height)]
            canvas.line(ends, color=canvas.GOAL, lw=2, ls=canvas.SHORT_DASHES)
    canvas.ax.set(xlim=(-1.6, 1.75), ylim=(-1.2, 1.75))

    def draw(x: Vector, u: Vector) -> None:
        full = np.clip((x[parts] - low) / span, 0, 1)
        for centre, share, color in zip(centres, full, colors, strict=False):
            canvas.disc(centre, largest * (0.6 + 0.4 * share), color)
        level = 2.3 * float(np.clip(x[pressure] / _SCALE, 0, 1)) - 0.9
        canvas.bar((1.36, -0.9), 0.22, level, color=canvas.BODY, alpha=0.75)
        inflow, out = 0.6 * np.clip(u / [100, 1], 0, 1)
        flows = (-0.85, inflow, canvas.ACTION), (0.85 - out, out, canvas.NEUTRAL)
        for start, length, color in flows:  # arrows to the right, above the lung
            if length > 0.005:
                arrow = {"arrowstyle": "-|>", "color": color, "lw": 3}
                xy, tail = (start + length, 1.5), (start, 1.5)
                canvas.ax.annotate("", xy, tail, arrowprops=arrow, zorder=4)

    return Drawing(draw)


ROTOR, GAP, STATOR, SPEED = 0.68, 0.76, 1.0, 1.16
CURRENT = color_of(4)


def motor(canvas: Canvas, episode: Episode) -> Drawing:
    """The stator, and the rotor with its magnets along d. The voltage and the current
    are arrows in the plane of d and q, and the speed is an arc about the stator."""
    ax, states, target = canvas.ax, episode.states, episode.target
    ax.set(xlim=(-1.4, 1.4), ylim=(-1.4, 1.4))
    style = {"width": STATOR - GAP, "color": canvas.NEUTRAL, "alpha": 0.25}
    ax.add_artist(Wedge((0, 0), STATOR, 0, 360, **style))
    canvas.circle((0, 0), ROTOR, color=canvas.NEUTRAL, alpha=0.12, lw=0)
    for start, color in ((-50, canvas.BODY), (130, canvas.SECOND)):
        style = {"width": 0.13, "color": color, "alpha": 0.8}
        ax.add_artist(Wedge((0, 0), ROTOR, start, start + 100, **style))
    style = {"size": 12, "ha": "center", "va": "center", "color": "0.25"}
    for name, axis in zip("dq", np.eye(2), strict=True):
        canvas.line([-0.5 * axis, 0.5 * axis], color=canvas.NEUTRAL, lw=1, alpha=0.5)
        x, y = 0.88 * axis
        ax.text(x, y, name, **style)
    largest = float(np.linalg.norm(states[:, :2], axis=1).max(initial=0.0)) or 1.0
    fastest = float(np.abs(episode.visited((2,))).max()) or 1.0
    if target is not None:
        angle = math.pi / 2 + FULL_TURN * float(target[2]) / fastest
        ends = np.outer([SPEED - 0.12, SPEED + 0.12], rotation(angle)[:, 0])
        canvas.line(ends, color=canvas.GOAL, lw=3, zorder=4)

    def draw(x: Vector, u: Vector) -> None:
        share = float(np.clip(x[2] / fastest, -1, 1))
        canvas.torque((0, 0), SPEED, math.pi / 2, share, canvas.BODY, slimness=2.5)
        canvas.force((0, 0), 0.6 * episode.shares(u), 0.6, zorder=2)
        canvas.force((0, 0), 0.6 * x[:2] / largest, 0.6, color=CURRENT)
        canvas.joint((0, 0), 0.06)

    return Drawing(draw)


HEIGHT, FALL = 1.0, 0.42  # the height of a tank, and the gap between the tanks
BOTTOMS = (HEIGHT + FALL, 0.0)
TOP = BOTTOMS[0] + 1.12 * HEIGHT


def two_tank(canvas: Canvas, episode: Episode) -> Drawing:
    """Two tanks with their levels, the target level, the flow out of each tank, and the
    flow from the pump. The width of a tank is the square root of its area."""
    system, target = episode.system, episode.target
    roots = np.sqrt([float(system.upper_area), float(system.lower_area)])
    widths = 1.1 * roots / roots.max()
    holes = np.sqrt([float(system.upper_outlet), float(system.lower_outlet)])
    holes = 0.09 * holes / holes.max()
    tallest = max(float(episode.states.max(initial=0.0)), 1e-6)
    if target is not None:
        tallest = max(tallest, 1.5 * float(target[1]))
        height, edge = HEIGHT * float(target[1]) / tallest, 0.5 * widths[1] + 0.14
        ends = [(-edge, height), (edge, height)]
        canvas.line(ends, color=canvas.GOAL, lw=2, ls=canvas.LONG_DASHES, zorder=4)
    for bottom, width, hole in zip(BOTTOMS, widths, holes, strict=True):
        for side, gap in ((-width / 2, -hole / 2), (width / 2, hole / 2)):
            walls = [(side, HEIGHT * 1.12), (side, 0), (gap, 0), (gap, -0.07)]
            style = {"lw": 2.5, "solid_joinstyle": "round", "zorder": 3}
            canvas.line(np.array(walls) + [0, bottom], color=canvas.NEUTRAL, **style)
    pipe = [(-0.75, TOP + 0.3), (0, TOP + 0.3), (0, TOP + 0.16)]
    canvas.line(pipe, color=canvas.NEUTRAL, lw=9, solid_capstyle="butt", zorder=3)
    canvas.ax.set(xlim=(-1.15, 1.15), ylim=(-0.5, TOP + 0.4))

    def draw(x: Vector, u: Vector) -> None:
        heights = HEIGHT * np.clip(x[:2] / tallest, 0.0, 1.12)
        share = float(episode.shares(u)[0])
        if share > 0.005:
            surface = BOTTOMS[0] + heights[0]
            canvas.bar((0, surface), 0.14 * share, TOP + 0.16, color=canvas.ACTION)
        # The upper stream falls to the lower level, the lower one out of the picture.
        ends = heights[1], -0.5
        for i, bottom in enumerate(BOTTOMS):
            top = bottom + heights[i]
            canvas.bar((0, bottom), widths[i], top, color=canvas.BODY, alpha=0.75)
            # By Torricelli's law the flow is proportional to the root of the level.
            stream = holes[i] * float(np.sqrt(heights[i] / HEIGHT))
            canvas.bar((0, ends[i]), stream, bottom, color=canvas.SECOND)

    return Drawing(draw)
