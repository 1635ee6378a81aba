"""Animations of trajectories."""

import dataclasses
import functools
import os
from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.lines import Line2D
from PIL import Image

from .._check import check_bool, check_count, check_instance, check_step
from .._figures import NEUTRAL
from ..environments import Environment
from ..simulation import Trajectory
from ._drawings._canvas import Episode
from ._export import check_path, compressed, html_player, write
from ._marks import event_color, mark_events
from ._path import with_events
from ._plot import control_bounds, draw_panel
from ._renderer import PlantArtist
from ._runs import as_runs, HELD, Panel, panels_of, Run


SIZE = 11.0
# In inches: the size without and with traces, the least height, the height of the text.
ALONE, BESIDE, LOWEST, HEADER = (5.0, 4.4), (10.0, 4.6), 1.5, 0.35
FLASH = 4  # the number of frames for which the name of an event is in colour


class Scene:
    """Draws the frames of an animation. Each frame shows one step of a trajectory.

    The frame nearest to an event shows the moment of the event instead, so that a ball
    is seen to touch the floor when it bounces.
    """

    def __init__(
        self,
        run: Run,
        environment: Environment,
        indices: Sequence[int],
        dpi: float | int,
        traces: bool = True,
    ):
        self.run, self.path = run, run.paths[0]
        self.rows = self._rows_of(np.asarray(indices))
        self.controls = np.asarray(run.trajectory.controls, float)
        panels = panels_of(run, None, grouped=True, where="animate") if traces else []
        step = np.diff(run.times[0]).max(initial=0.0) or 1.0
        self.decimals = int(np.clip(np.ceil(-np.log10(step) - 1e-3), 0, 3))

        width, height = BESIDE if traces else ALONE
        height = max(height, 1.2 * len(panels) + 0.8)
        self.figure = Figure((width, height), dpi)
        self.canvas = FigureCanvasAgg(self.figure)
        grid = self.figure.add_gridspec(1, 2 if traces else 1)
        self.lines: list[tuple[Line2D, Any]] = []
        if traces:
            self.lines = self._panels(panels, grid[0, 1].subgridspec(len(panels), 1))
        ax = self.figure.add_subplot(grid[0, 0])
        episode = Episode(environment, run.trajectory)
        visited = self.path.states[: self.path.samples[run.last[0]] + 1]
        moments = map(self._moment, self.rows.values())
        self.plant = PlantArtist(ax, episode, moments, visited)

        if not traces and self.plant.ax.get_aspect() == 1:  # no margin above and below
            left, right, low, high = self.plant.ax.axis()
            aspect = (high - low) / (right - left)
            height = min(height, max(LOWEST, width * aspect + HEADER))
            self.figure.set_size_inches(width, height)
        rect = (0, 0, 1, 1 - HEADER / height)
        self.figure.set_layout_engine(ConstrainedLayoutEngine(rect=rect, wspace=0.06))
        at = 1 - 0.1 / height
        # The time, the cost and the last event.
        self.texts = [
            self.figure.text(x / width, at, "", va="top", ha=side, fontsize=SIZE + 1)
            for x, side in ((0.2, "left"), (1.65, "left"), (width - 0.2, "right"))
        ]
        self.moving = [self.plant.ax, *self.texts, *(line for line, _ in self.lines)]
        for artist in self.moving:
            artist.set_animated(True)
        self.canvas.draw()
        self.figure.set_layout_engine("none")
        self.background = self.canvas.copy_from_bbox(self.figure.bbox)

    def _rows_of(self, indices: np.ndarray) -> dict[int, int]:
        """From each step to the row of the path that its frame shows."""
        path = self.path
        rows = path.samples[indices]
        times = path.times[rows]
        for jump in path.jumps:
            i = int(np.argmin(np.abs(times - path.times[jump])))
            if 0 < i < len(rows) - 1:  # the first and the last frame keep their steps
                rows[i] = jump
        return dict(zip(indices.tolist(), rows.tolist(), strict=True))

    def _moment(self, row: int) -> tuple[np.ndarray, np.ndarray]:
        step = min(int(self.path.steps[row]), len(self.controls) - 1)
        return self.path.states[row], self.controls[step]

    def _panels(self, panels: Sequence[Panel], grid: Any) -> list[tuple[Line2D, Any]]:
        """Draw faint traces of the whole run. Returns the lines that grow over them and
        the dots at their ends, each with its times and values."""
        lines, axes = [], []
        for i, panel in enumerate(panels):
            ax = self.figure.add_subplot(grid[i], sharex=axes[0] if axes else None)
            axes.append(ax)
            handles = draw_panel(ax, panel, [self.run], size=SIZE, faint=0.3)
            for handle, column in zip(handles, panel.columns, strict=True):
                ((times, values),) = self.run.lines(panel.kind, column)
                drawstyle = "steps-post" if panel.kind in HELD else "default"
                color = handle.get_color()
                grown = Line2D([], [], color=color, lw=1.8, drawstyle=drawstyle)
                dot = Line2D([], [], color=color, marker="o", markersize=6, ls="none")
                for line in (grown, dot):
                    ax.add_line(line)
                    lines.append((line, (times, values)))
            ax.tick_params(labelbottom=panel is panels[-1])
        of_states = [a for a, p in zip(axes, panels, strict=True) if p.kind == "states"]
        mark_events(of_states, [self.run])
        axes[-1].set_xlabel(self.run.time_label, fontsize=SIZE)
        self.figure.align_ylabels(axes)
        return lines

    def frame(self, k: int) -> np.ndarray:
        """The picture of step `k`, shape `(height, width, 3)`."""
        row = self.rows[k]
        time = self.path.times[row]
        unit = self.run.time_label.removeprefix("time").strip(" []")
        unit = f" {unit}" if unit not in ("", "steps") else ""
        self.texts[0].set_text(f"t = {time:.{self.decimals}f}{unit}")
        if "costs" in self.run.series:
            costs = self.run.series["costs"][0, :, 0]
            self.texts[1].set_text(f"cost so far {np.nansum(costs[:k]):.4g}")
        self._tell_event(row)
        for line, (times, values) in self.lines:
            # The last time has no cost: the dot stays at the last cost.
            shown = np.flatnonzero((times <= time) & np.isfinite(values))
            end = max(shown, default=-1) + 1  # 0 before the first finite value
            start = shown[-1:] if line.get_marker() == "o" else slice(end)
            line.set_data(times[start], values[start])
        past = self.path.times[: row + 1], self.path.states[: row + 1]
        self.plant.draw(*self._moment(row), past)
        self.canvas.restore_region(self.background)
        renderer = self.canvas.get_renderer()
        for artist in self.moving:
            artist.draw(renderer)
        return np.asarray(self.canvas.buffer_rgba())[..., :3].copy()

    def _tell_event(self, row: int) -> None:
        """Show the name of the last event and how often it has fired, in bold and in
        colour if it has just fired."""
        path, text = self.path, self.texts[2]
        count = int(np.searchsorted(path.jumps, row, side="right"))
        if not count:
            text.set_text("")
            return
        kind = int(path.kinds[count - 1])
        name = self.run.trajectory.event_names[kind].replace("_", " ")
        text.set_text(f"{name} {np.sum(path.kinds[:count] == kind)}")
        since = sum(
            path.jumps[count - 1] <= other <= row for other in self.rows.values()
        )
        text.set_color(event_color(kind) if since <= FLASH else NEUTRAL)
        text.set_fontweight("bold" if since <= FLASH else "normal")


FASTEST, SLOWEST = 30.0, 5.0


@dataclasses.dataclass(frozen=True, eq=False, repr=False)
class Animation:
    """An animation, whose frames show the steps `indices` of a trajectory. They are
    drawn when they are first needed."""

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
        """Write the animation to a `.gif`, `.html` or `.mp4` file."""
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
    """Animate a trajectory: the moving plant, with plots of states, controls and costs.

    The type of the system decides how the plant looks. Register a drawing for your own
    system with [`delucax.plotting.register_drawing`][]. A system with two states and no
    drawing is shown as a dot in the plane of the states. Any other system without a
    drawing is shown as bars, one for each state and each control. The animation ends
    when the episode ends.

    If the system has events, the frame nearest to an event shows the moment just after
    the event, and the name of the event appears in colour. If the rollout did not keep
    its events, `animate` computes the steps again to locate the events. If the run had
    disturbances, the trajectory must hold them so that `animate` can do this.

    **Arguments:**

    - `environment`: the environment that was run.
    - `trajectory`: one trajectory with its states and controls.
    - `path`: the file to which `animate` saves the animation. The name of the file must
        end in `.gif`, `.html` (a page that needs no other file) or `.mp4` (needs
        ffmpeg). By default nothing is saved.
    - `fps`: frames per second. By default the animation plays in real time. If real
        time would mean fewer than 5 frames per second, the animation plays 5 frames per
        second, which is faster than real time.
    - `max_frames`: the largest number of frames, 100 by default. The frames are spread
        evenly over the steps.
    - `dpi`: pixels per inch, 60 by default. With 60 pixels per inch, the picture is 600
        pixels wide, or 300 without `traces`.
    - `traces`: whether to draw states, controls and costs beside the plant, True by
        default.

    **Returns:** an animation. A notebook plays the animation, and
    `animation.save(path)` writes it to a file. `len(animation)` is the number of
    frames, `animation.indices` holds the step that each frame shows, and
    `animation.fps` is the number of frames per second.

    **Raises:** `ValueError` if the trajectory is a batch, holds no states or controls,
    has no step, or does not fit the environment; if a number is not positive; if `path`
    has another ending, its folder does not exist, or it cannot be written; or if
    `path` ends in `.mp4` and ffmpeg is not installed.

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
    trajectory = with_events(environment, trajectory)
    max_frames = check_count(max_frames, "max_frames", where)
    check_step(dpi, where, "dpi")
    if fps is not None:
        check_step(fps, where, "fps")
    target = None if path is None else check_path(path, where)
    last = int(run.last[0])
    duration = float(run.times[0, last] - run.times[0, 0])
    frames = min(max_frames, last + 1)
    if fps is None and duration > 0:
        # Real time: cap the frames, but play at least 5 per second.
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
