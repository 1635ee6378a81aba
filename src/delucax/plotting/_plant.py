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
    `moments`, pairs of state and control.
    """

    def __init__(
        self,
        ax: Axes,
        drawing: Drawing,
        environment: Environment,
        trajectory: Trajectory,
        moments: Iterable[tuple[np.ndarray, np.ndarray]],
    ):
        self.ax, self.draw_function = ax, drawing.draw
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
        self.fixed = set(map(id, ax.get_children()))
        if drawing.setup is None:
            for x, u in moments:
                self.draw(x, u)
            ax.autoscale_view()
        # The limits stay as they are now, unless the draw function moves them.
        ax.set(xlim=ax.get_xlim(), ylim=ax.get_ylim())

    def draw(self, x: np.ndarray, u: np.ndarray) -> None:
        """Draw one moment in the place of the one before."""
        for artist in self.ax.get_children():
            if id(artist) not in self.fixed:
                artist.remove()
        self.ax.set_prop_cycle(color=PALETTE)
        self.draw_function(self.ax, x, u, **self.keywords)
