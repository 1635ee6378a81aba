"""The figure of an animation: what stays is drawn once, what moves once a frame."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.lines import Line2D

from ..environments import Environment
from ._plant_artist import PlantArtist
from ._plot import draw_panel
from ._runs import HELD, Panel, panels_of, Run


SIZE = 11.0
# Inches: without the traces and with them, the least height, and what the texts take.
ALONE, BESIDE, LOWEST, HEADER = (5.0, 4.4), (10.0, 4.6), 1.5, 0.35


class Scene:
    """Draws the frames of an animation, one step of a trajectory each."""

    def __init__(
        self,
        run: Run,
        environment: Environment,
        indices: Sequence[int],
        dpi: float | int,
        traces: bool = True,
    ):
        self.run = run
        self.states = np.asarray(run.trajectory.states, float)
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
            stack = grid[0, 1].subgridspec(len(panels), 1)
            self.lines = self._panels(panels, stack)
        self.plant = PlantArtist(
            self.figure.add_subplot(grid[0, 0]),
            environment,
            run.trajectory,
            map(self._moment, indices),
            self.states[: int(run.last[0]) + 1],
        )

        if not traces and self.plant.ax.get_aspect() == 1:  # no higher than it must be
            left, right, low, high = self.plant.ax.axis()
            aspect = (high - low) / (right - left)
            height = min(height, max(LOWEST, width * aspect + HEADER))
            self.figure.set_size_inches(width, height)
        rect = (0, 0, 1, 1 - HEADER / height)
        self.figure.set_layout_engine(ConstrainedLayoutEngine(rect=rect, wspace=0.06))
        at = 1 - 0.1 / height
        self.texts = [
            self.figure.text(x / width, at, "", va="top", fontsize=SIZE + 1)
            for x in (0.2, 2.0)
        ]
        lines = [line for line, _ in self.lines]
        self.moving = [self.plant.ax, *self.texts, *lines]
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
        axes[-1].set_xlabel(self.run.time_label, fontsize=SIZE)
        self.figure.align_ylabels(axes)
        return lines

    def frame(self, k: int) -> np.ndarray:
        """The picture of step `k`, shape `(height, width, 3)`."""
        times = self.run.times[0]
        unit = self.run.time_label.removeprefix("time").strip(" []")
        unit = f" {unit}" if unit not in ("", "steps") else ""
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
        self.plant.draw(*self._moment(k), self.states[: k + 1])
        self.canvas.restore_region(self.background)
        renderer = self.canvas.get_renderer()
        for artist in self.moving:
            artist.draw(renderer)
        return np.asarray(self.canvas.buffer_rgba())[..., :3].copy()
