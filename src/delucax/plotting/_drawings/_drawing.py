"""What a drawing is made from, and what it is."""

import dataclasses
import functools
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from jaxtyping import Float

from ...dynamics import AbstractDynamics
from ...environments import Environment
from ...simulation import Trajectory
from ...systems import AbstractSystem
from ._canvas import Canvas, Points


Vector: TypeAlias = Float[np.ndarray, "_"]  # noqa: F821
States: TypeAlias = Float[np.ndarray, "times states"]


class Drawing(NamedTuple):
    """How the plant of one episode is drawn.

    - `draw(x, u)` draws one moment.
    - `path(states)` is where the plant has been, shape `(times, 2)`, if it leaves one.
    - `autoscale`: whether the limits of the axes are to fit all that is drawn.
    """

    draw: Callable[[Vector, Vector], Any]
    path: Callable[[States], Points] | None = None
    autoscale: bool = False


@dataclasses.dataclass(frozen=True)
class Episode:
    """The run that is drawn, in the terms that drawings ask for."""

    environment: Environment
    trajectory: Trajectory

    @functools.cached_property
    def system(self) -> Any:
        """The innermost system of the environment; its dynamics if they hold none."""
        return layers(self.environment)[-1]

    @functools.cached_property
    def states(self) -> States:
        """The states without those that are not finite; one of zeros if all are."""
        states = np.asarray(self.trajectory.states, float)
        finite = states[np.all(np.isfinite(states), axis=-1)]
        return finite if len(finite) else np.zeros_like(states[:1])

    @functools.cached_property
    def target(self) -> Vector | None:
        """The state that the cost draws to, the origin if it names none; or nothing."""
        targets = self.environment.cost.targets
        if targets is None:
            return None
        x, _ = targets
        zero = np.zeros(self.environment.state_size)
        return zero if x is None else np.asarray(x, float)

    def visited(self, columns: Sequence[int]) -> Float[np.ndarray, "_ columns"]:
        """Some entries of the states, and last of the target, if there is one."""
        states = self.states
        if self.target is not None:
            states = np.concatenate([states, self.target[None]])
        return states[:, list(columns)]

    @functools.cached_property
    def largest_controls(self) -> Vector:
        """What a full arrow stands for, one a control: its bound if it has one, else
        the largest that was applied, else 1."""
        bounds = self.environment.control_bounds
        largest = np.zeros(self.environment.control_size)
        if bounds is not None:
            low, high = (np.abs(np.asarray(end, float)) for end in bounds)
            largest = np.broadcast_to(np.maximum(low, high), largest.shape)
        applied = np.abs(np.asarray(self.trajectory.controls, float))
        applied = np.where(np.isfinite(applied), applied, 0.0).max(axis=0, initial=0.0)
        largest = np.where(np.isfinite(largest) & (largest > 0), largest, applied)
        return np.where(largest > 0, largest, 1.0)

    def shares(self, u: Vector) -> Vector:
        """Controls as shares of the largest, between -1 and 1."""
        return np.clip(u / self.largest_controls, -1, 1)


Setup: TypeAlias = Callable[[Canvas, Episode], Drawing]
"""Draws what stays, sets the limits of the axes, and returns what draws the rest."""


def layers(environment: Environment) -> list[Any]:
    """The dynamics and what they wrap, the innermost system last."""
    layers: list[Any] = [environment.dynamics]
    while True:
        inner = getattr(layers[-1], "system", getattr(layers[-1], "dynamics", None))
        if not isinstance(inner, AbstractSystem | AbstractDynamics):
            return layers
        layers.append(inner)
