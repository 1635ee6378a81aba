"""Pictures of a plant at one moment: on given axes, as an array, or in a window."""

from collections.abc import Iterable
from typing import Any, TypeAlias

import jax
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backend_bases import FigureManagerBase
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from .._figures import PALETTE
from ..controllers import Zero
from ..environments import Environment
from ..simulation import rollout
from ._drawings._canvas import Canvas, Episode, Past, States, Vector
from ._drawings._registry import drawing_for


Moments: TypeAlias = Iterable[tuple[Vector, Vector]]


class PlantArtist:
    """Draws the plant of an environment, moment by moment.

    The drawing sets the limits of the axes, or they fit all `moments`, pairs of state
    and control. If the drawing leaves a path, the path of all `states` is drawn
    faintly.
    """

    def __init__(
        self, ax: Axes, episode: Episode, moments: Moments, states: States | None = None
    ):
        self.ax = ax
        ax.set_aspect("equal")
        ax.set_axis_off()
        self.drawing = drawing_for(episode.environment)(Canvas(ax), episode)
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

    def draw(self, x: Vector, u: Vector, past: Past | None = None) -> None:
        """Draw one moment in place of the previous one. If `past` is given, the times
        and states up to now with `x` as the last, draw the path so far too."""
        for artist in self.ax.get_children():
            if id(artist) not in self._fixed:
                artist.remove()
        self.ax.set_prop_cycle(color=PALETTE)
        if past is not None:
            self._draw_path(past[1], 0.8)
        known = past or (np.zeros(1), x[None])
        self.drawing.draw(x, u, *([known] if self.drawing.walks else []))


_INCHES, _DPI = (5.0, 5.0), 100


class Renderer:
    """Draws the plant of an environment, one state at a time.

    The limits of the axes are chosen so that a rollout with zero control fits into the
    picture.

    **Arguments:**

    - `environment`: a [`delucax.Environment`][].
    - `window`: whether to also show each picture in a window; `False` by default.

    **Raises:** `RuntimeError` if `window` is true and no display is available.

    !!! example

        ```python
        import delucax as dlx
        import numpy as np

        renderer = dlx.plotting.Renderer(dlx.make("pendulum"))
        picture = renderer.frame(np.array([0.5, 0.0]), np.zeros(1))
        renderer.close()
        ```
    """

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
        # This rollout sets the limits of the axes.
        idle = Zero(environment.control_size)
        trajectory = rollout(environment, idle, key=jax.random.key(0), throw=False)
        states = np.asarray(trajectory.states, float)
        moments = zip(states, np.asarray(trajectory.controls, float), strict=False)
        self.dt = float(environment.dt)
        self.times: list[float] = []
        self.states: list[np.ndarray] = []
        ax = self.figure.add_subplot()
        self.plant = PlantArtist(ax, Episode(environment, trajectory), moments)

    def frame(self, x: np.ndarray, u: np.ndarray, step: int = 0) -> np.ndarray:
        """The picture at a state and a control.

        **Arguments:**

        - `x`: the state, shape `(n,)`.
        - `u`: the control, shape `(m,)`.
        - `step`: the number of steps since the start of the episode, 0 by default. A
            plant that moves on, such as a walker, moves by the pictures of the episode
            so far. An episode starts with a smaller number than that of the last
            picture.

        **Returns:** an array of shape `(height, width, 3)`.
        """
        time, state = self.dt * step, np.asarray(x, float)
        if self.times and time <= self.times[-1]:
            # The same picture again, or a new episode.
            kept = len(self.times) - 1 if time == self.times[-1] else 0
            del self.times[kept:], self.states[kept:]
        self.times.append(time)
        self.states.append(state)
        # Only for plants that move on: others would leave a path.
        past = (np.array(self.times), np.stack(self.states))
        given = [past] if self.plant.drawing.walks else []
        self.plant.draw(state, np.asarray(u, float), *given)
        canvas: Any = self.figure.canvas
        canvas.draw()
        if self.pyplot is not None:
            self.pyplot.pause(1e-3)  # updates the window
        return np.asarray(canvas.buffer_rgba())[..., :3].copy()

    def close(self) -> None:
        """Close the window, if one is open."""
        if self.pyplot is not None:
            self.pyplot.close(self.figure)
