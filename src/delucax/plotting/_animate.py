"""A trajectory as a moving picture."""

import dataclasses
import functools
import os

import numpy as np
from PIL import Image

from .._check import check_bool, check_count, check_instance, check_step
from ..environments import Environment
from ..simulation import Trajectory
from ._export import check_path, compressed, html_player, write
from ._plot import control_bounds
from ._runs import as_runs
from ._scene import Scene


FASTEST, SLOWEST = 30.0, 5.0


@dataclasses.dataclass(frozen=True, eq=False, repr=False)
class Animation:
    """A moving picture, made by [`delucax.animate`][]. A notebook plays it.

    `len(animation)` is the number of frames.

    **Attributes:**

    - `environment`, `trajectory`: what it shows.
    - `indices`: the step of the trajectory that each frame shows.
    - `fps`: frames a second.
    - `dpi`: pixels an inch.
    - `traces`: whether states, controls and costs are drawn beside the plant.

    !!! example

        ```python
        import delucax as dlx
        import jax

        env = dlx.make("pendulum")
        zero = dlx.controllers.Zero(1)
        trajectory = dlx.rollout(env, zero, key=jax.random.key(0), horizon=20)
        animation = dlx.animate(env, trajectory)
        len(animation), animation.fps
        ```
    """

    environment: Environment
    trajectory: Trajectory
    indices: tuple[int, ...]
    fps: float
    dpi: float
    traces: bool = True

    def __repr__(self) -> str:
        return f"Animation({len(self)} frames, {self.fps:.3g} a second)"

    def __len__(self) -> int:
        return len(self.indices)

    @functools.cached_property
    def _frames(self) -> list[Image.Image]:
        run = as_runs(self.trajectory, None, "trajectory", "Animation")[0]
        scene = Scene(run, self.environment, self.indices, self.dpi, self.traces)
        return compressed(scene.frame(k) for k in self.indices)

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the animation to a file.

        **Arguments:** `path`: where to; the ending chooses the form: `.gif`, `.html` (a
            page that needs nothing else) or `.mp4` (needs ffmpeg).

        **Raises:** `ValueError` if the ending is another, if the folder is not there or
        cannot be written to, or if there is no ffmpeg for an `.mp4`.
        """
        target = check_path(path, "Animation.save")
        write(target, self._frames, self.fps)

    def _repr_html_(self) -> str:
        return html_player(self._frames, self.fps)


def animate(
    environment: Environment,
    trajectory: Trajectory,
    *,
    path: str | os.PathLike[str] | None = None,
    fps: float | int | None = None,
    max_frames: int = 100,
    dpi: float | int = 60,
    traces: bool = True,
) -> Animation:
    """A moving picture of a trajectory: the plant, and its states, controls and costs.

    How the plant looks is found by the type of its system; every system of the library
    has a drawing, and [`delucax.plotting.register_drawing`][] gives one to yours. One
    that has none is shown as a dot in the plane of its two states, or, if it has more
    or fewer, as bars. It ends where the episode ends.

    **Arguments:**

    - `environment`: the environment that was run.
    - `trajectory`: one trajectory with its states and controls.
    - `path`: a file to save it to at once, ending in `.gif`, `.html` or `.mp4`. None by
        default.
    - `fps`: frames a second. By default it plays in real time, but with at least 5
        frames a second: a longer run plays faster than it was.
    - `max_frames`: the most frames, 100 by default; they are spread evenly over the
        steps.
    - `dpi`: pixels an inch, 60 by default: a picture 600 pixels wide, or half of that
        without `traces`.
    - `traces`: whether to draw states, controls and costs beside the plant, True by
        default.

    **Returns:** an [`delucax.plotting.Animation`][], which a notebook plays, and which
    has `save(path)`.

    **Raises:** `ValueError` if the trajectory is a batch, holds no states or controls,
    or is not of this environment; if a number is not positive; or if `path` cannot be
    written.

    !!! example

        ```python
        import delucax as dlx
        import jax
        import jax.numpy as jnp

        env = dlx.make("pendulum")
        linear = dlx.controllers.Linear(jnp.array([[20.0, 5.0]]))
        start = jnp.array([0.2, 0.0])
        trajectory = dlx.rollout(env, linear, key=jax.random.key(0), x0=start)
        animation = dlx.animate(env, trajectory, max_frames=50)
        ```
    """
    where = "animate"
    check_instance(trajectory, Trajectory, "trajectory", where)
    if trajectory.batch_shape:
        raise ValueError(
            f"{where}: trajectory must be one trajectory, got a batch of shape "
            f"{trajectory.batch_shape}; pick one, such as trajectory[0]."
        )
    if not trajectory.steps:
        raise ValueError(f"{where}: trajectory must have at least one step, got none.")
    run = as_runs(trajectory, None, "trajectory", where)[0]
    if "controls" not in run.series:
        raise ValueError(
            f"{where}: trajectory holds no controls; keep them in the rollout, such as "
            'keep=("states", "controls", "costs").'
        )
    control_bounds(environment, run, where)
    max_frames = check_count(max_frames, "max_frames", where)
    check_step(dpi, where, "dpi")
    if fps is not None:
        check_step(fps, where, "fps")
    target = None if path is None else check_path(path, where)
    last = int(run.last[0])
    duration = float(run.times[0, last] - run.times[0, 0])
    frames = min(max_frames, last + 1)
    if fps is None and duration > 0:
        # Real time; no more frames than it takes, and no slide show of a long run.
        frames = min(frames, max(2, round(FASTEST * duration) + 1))
        fps = min(max((frames - 1) / duration, SLOWEST), FASTEST)
    indices = np.unique(np.round(np.linspace(0, last, frames)).astype(int))
    animation = Animation(
        environment,
        trajectory,
        tuple(indices.tolist()),
        float(FASTEST if fps is None else fps),
        float(dpi),
        check_bool(traces, "traces", where),
    )
    if target is not None:
        write(target, animation._frames, animation.fps)
    return animation
