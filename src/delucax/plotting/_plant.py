"""A plant drawn on axes: what stays once, what moves again and again."""

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
from matplotlib.axes import Axes

from ..environments import Environment
from ..simulation import Trajectory
from ._drawings import Drawing
from ._figure import PALETTE


class Plant:
    """The drawing of the plant of an environment.

    The limits are those that the setup of the drawing chose, or that hold all of
    `moments`, pairs of state and control. Where the drawing leaves a path, that of all
    of `states` is drawn faint.
    """

    def __init__(
        self,
        ax: Axes,
        drawing: Drawing,
        environment: Environment,
        trajectory: Trajectory,
        moments: Iterable[tuple[np.ndarray, np.ndarray]],
        states: np.ndarray | None = None,
    ):
        self.ax, self.drawing = ax, drawing
        self.keywords: dict[str, Any] = {}
        ax.set_aspect("equal")
        ax.set_axis_off()
        if drawing.setup is not None:
            keywords = drawing.setup(ax, environment, trajectory)
            if keywords is not None and not isinstance(keywords, Mapping):
                raise ValueError(
                    "animate: the setup of a drawing must return a dictionary or "
                    f"None, got {type(keywords).__name__}."
                )
            self.keywords = dict(keywords or {})
        if states is not None:
            self._trace(states, 0.25)
        self.fixed = set(map(id, ax.get_children()))
        if drawing.setup is None:
            for x, u in moments:
                self.draw(x, u)
            ax.autoscale_view()
        # The limits stay as they are now, unless the draw function moves them.
        ax.set(xlim=ax.get_xlim(), ylim=ax.get_ylim())

    def _trace(self, states: np.ndarray, alpha: float) -> None:
        """The path that the plant has left, if it leaves one."""
        if self.drawing.trace is not None:
            path = self.drawing.trace(states, **self.keywords)
            color = PALETTE[0]
            self.ax.plot(*path.T, color=color, lw=1.8, alpha=alpha, zorder=1)

    def draw(
        self, x: np.ndarray, u: np.ndarray, past: np.ndarray | None = None
    ) -> None:
        """Draw one moment in the place of the one before, and the path of the `past`
        states."""
        for artist in self.ax.get_children():
            if id(artist) not in self.fixed:
                artist.remove()
        self.ax.set_prop_cycle(color=PALETTE)
        if past is not None:
            self._trace(past, 0.8)
        self.drawing.draw(self.ax, x, u, **self.keywords)
