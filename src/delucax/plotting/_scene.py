"""The figure of an animation: what stays is drawn once, what moves once a frame."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.lines import Line2D

from ..environments import Environment
from ._drawings import drawing_for, PHASE
from ._plant import Plant
from ._plot import draw_panel
from ._runs import HELD, Panel, panels_of, Run, time_label


SIZE = 11.0


class Scene:
    """Draws the frames of an animation, one step of a trajectory each."""

    def __init__(
        self,
        run: Run,
        environment: Environment,
        indices: Sequence[int],
        dpi: float | int,
    ):
        self.run = run
        self.states = np.asarray(run.trajectory.states, float)
        self.controls = np.asarray(run.trajectory.controls, float)
        drawing = drawing_for(environment)
        if drawing is None and self.states.shape[1] > 1:
            drawing = PHASE
        panels = panels_of(run, None, grouped=True, where="animate")
        step = np.diff(run.times[0]).max(initial=0.0) or 1.0
        self.decimals = int(np.clip(np.ceil(-np.log10(step) - 1e-3), 0, 3))

        size = (6.0 if drawing is None else 10.0, max(4.6, 1.2 * len(panels) + 0.8))
        room = 0.35 / size[1]  # at the top, for the texts
        layout = ConstrainedLayoutEngine(rect=(0, 0, 1, 1 - room))
        self.figure = Figure(size, dpi, layout=layout)
        self.canvas = FigureCanvasAgg(self.figure)
        self.texts = [
            self.figure.text(
                x / size[0], 1 - 0.1 / size[1], "", va="top", fontsize=SIZE + 1
            )
            for x in (0.2, 2.0)
        ]
        grid = self.figure.add_gridspec(1, 1 if drawing is None else 2)
        self.lines = self._panels(panels, grid[0, -1].subgridspec(len(panels), 1))
        self.plant: Plant | None = None
        if drawing is not None:
            ax = self.figure.add_subplot(grid[0, 0])
            moments = map(self._moment, indices)
            self.plant = Plant(ax, drawing, environment, run.trajectory, moments)

        moving = [*self.texts, *(line for line, _ in self.lines)]
        self.moving = moving if self.plant is None else [self.plant.ax, *moving]
        for artist in self.moving:
            artist.set_animated(True)
        self.canvas.draw()
        self.figure.set_layout_engine("none")
        self.background = self.canvas.copy_from_bbox(self.figure.bbox)

    def _moment(self, k: int) -> tuple[np.ndarray, np.ndarray]:
        return self.states[k], self.controls[min(k, len(self.controls) - 1)]

    def _panels(self, panels: Sequence[Panel], grid: Any) -> list[tuple[Line2D, Any]]:
        """Faint traces of the whole run; the lines over them that grow, and their dots,
        each with the values that it shows."""
        lines, axes = [], []
        for i, panel in enumerate(panels):
            ax = self.figure.add_subplot(grid[i], sharex=axes[0] if axes else None)
            axes.append(ax)
            handles = draw_panel(ax, panel, [self.run], size=SIZE, faint=0.3)
            for handle, column in zip(handles, panel.columns, strict=True):
                values = self.run.series[panel.kind][0, :, column]
                drawstyle = "steps-post" if panel.kind in HELD else "default"
                color = handle.get_color()
                grown = Line2D([], [], color=color, lw=1.8, drawstyle=drawstyle)
                dot = Line2D([], [], color=color, marker="o", markersize=6, ls="none")
                for line in (grown, dot):
                    ax.add_line(line)
                    lines.append((line, values))
            ax.tick_params(labelbottom=panel is panels[-1])
        axes[-1].set_xlabel(time_label(self.run), fontsize=SIZE)
        self.figure.align_ylabels(axes)
        return lines

    def frame(self, k: int) -> np.ndarray:
        """The picture of step `k`, shape `(height, width, 3)`."""
        times = self.run.times[0]
        unit = " s" if "[s]" in time_label(self.run) else ""
        self.texts[0].set_text(f"t = {times[k]:.{self.decimals}f}{unit}")
        if "costs" in self.run.series:
            costs = self.run.series["costs"][0, :, 0]
            self.texts[1].set_text(f"cost so far {np.nansum(costs[:k]):.4g}")
        for line, values in self.lines:
            if line.get_marker() == "o":
                # Costs have no value at the end; their dot stays at the last one.
                i = k - 1 if k and np.isnan(values[k]) else k
                line.set_data(times[i : i + 1], values[i : i + 1])
            else:
                line.set_data(times[: k + 1], values[: k + 1])
        if self.plant is not None:
            self.plant.draw(*self._moment(k))
        self.canvas.restore_region(self.background)
        renderer = self.canvas.get_renderer()
        for artist in self.moving:
            artist.draw(renderer)
        return np.asarray(self.canvas.buffer_rgba())[..., :3].copy()
