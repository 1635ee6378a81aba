"""One moment of a plant as a picture, or in a window."""

from typing import Any

import jax
import numpy as np
from matplotlib.backend_bases import FigureManagerBase
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from ..controllers import Zero
from ..environments import Environment
from ..simulation import rollout
from ._plant_artist import PlantArtist


_INCHES, _DPI = (5.0, 5.0), 100


class Renderer:
    """Draws the plant of an environment, state by state; in a `window` too if asked."""

    def __init__(self, environment: Environment, window: bool = False):
        self.pyplot: Any = None
        if window:
            import matplotlib.pyplot as plt

            self.pyplot = plt
            self.figure = plt.figure(figsize=_INCHES, dpi=_DPI, layout="constrained")
            manager: Any = self.figure.canvas.manager
            if type(manager).show is FigureManagerBase.show:
                plt.close(self.figure)
                raise RuntimeError(
                    "render_mode='human' needs a display, and Matplotlib's backend "
                    f"here, {plt.get_backend()!r}, opens no window; render_mode="
                    "'rgb_array' draws without one."
                )
        else:
            self.figure = Figure(_INCHES, _DPI, layout="constrained")
            FigureCanvasAgg(self.figure)
        # A run that says how far things move.
        idle, key = Zero(environment.control_size), jax.random.key(0)
        trajectory = rollout(environment, idle, key=key, throw=False)
        states = np.asarray(trajectory.states, float)
        moments = zip(states, np.asarray(trajectory.controls, float), strict=False)
        ax = self.figure.add_subplot()
        self.plant = PlantArtist(ax, environment, trajectory, moments)

    def frame(self, x: np.ndarray, u: np.ndarray) -> np.ndarray:
        """The picture at a state and a control, shape `(height, width, 3)`."""
        self.plant.draw(np.asarray(x, float), np.asarray(u, float))
        canvas: Any = self.figure.canvas
        canvas.draw()
        if self.pyplot is not None:
            self.pyplot.pause(1e-3)  # shows it, where there is a screen
        return np.asarray(canvas.buffer_rgba())[..., :3].copy()

    def close(self) -> None:
        """Close the window, if there is one."""
        if self.pyplot is not None:
            self.pyplot.close(self.figure)
