"""A plant drawn on axes: what stays once, what moves again and again."""

from collections.abc import Iterable

import numpy as np
from matplotlib.axes import Axes

from ..environments import Environment
from ..simulation import Trajectory
from ._drawings import Canvas, drawing_for, Episode, States, Vector
from .figures import PALETTE


class PlantArtist:
    """Draws the plant of an environment, moment by moment.

    The limits are those that the drawing chose, or that hold all of `moments`, pairs of
    state and control. Where the drawing leaves a path, that of all of `states` is drawn
    faint.
    """

    def __init__(
        self,
        ax: Axes,
        environment: Environment,
        trajectory: Trajectory,
        moments: Iterable[tuple[Vector, Vector]],
        states: States | None = None,
    ):
        self.ax = ax
        ax.set_aspect("equal")
        ax.set_axis_off()
        set_up = drawing_for(environment)
        self.drawing = set_up(Canvas(ax), Episode(environment, trajectory))
        self._draw_path(states, 0.25)
        self._fixed = set(map(id, ax.get_children()))
        if self.drawing.autoscale:
            for x, u in moments:
                self.draw(x, u)
            ax.autoscale_view()
        # The limits stay as they are now, unless the draw function moves them.
        ax.set(xlim=ax.get_xlim(), ylim=ax.get_ylim())

    def _draw_path(self, states: States | None, alpha: float) -> None:
        if states is not None and self.drawing.path is not None:
            path = np.asarray(self.drawing.path(states))
            self.ax.plot(*path.T, color=PALETTE[0], lw=1.8, alpha=alpha, zorder=1)

    def draw(self, x: Vector, u: Vector, past: States | None = None) -> None:
        """Draw one moment in the place of the one before, and the path of the `past`
        states."""
        for artist in self.ax.get_children():
            if id(artist) not in self._fixed:
                artist.remove()
        self.ax.set_prop_cycle(color=PALETTE)
        self._draw_path(past, 0.8)
        self.drawing.draw(x, u)
