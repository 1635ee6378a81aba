"""The one problem that every contender simulates: Gymnasium's pendulum.

The angle is zero upright. One step of `Pendulum-v1`, with the torque `u` clipped first:

    speed' = clip(speed + (3 g / (2 l) sin(angle) + 3 u / (m l^2)) dt, -8, 8)
    angle' = angle + speed' dt
    cost   = wrap(angle)^2 + 0.1 speed^2 + 0.001 u^2      (of the state before the step)

This module needs NumPy only: peers in other virtual environments import it too.
"""

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np


GRAVITY = 10.0
MASS = 1.0
LENGTH = 1.0
DT = 0.05
MAX_TORQUE = 2.0
MAX_SPEED = 8.0

# The controller is u = -(gain[0] angle + gain[1] speed). A spring without damping
# keeps every lane swinging for ever. A controller that brought the state to rest would
# let libraries with a short cut for the sine of a tiny angle look fast.
GAIN = (0.5, 0.0)
# One chain starts here; lanes of a batch are drawn by `starts`.
START = (1.0, 0.0)

Workload = Literal["trajectory", "cost", "gradient", "free"]
Method = Literal["gym", "rk4", "tsit5"]


@dataclass(frozen=True)
class Case:
    """What to simulate.

    - `workload`: `"trajectory"` runs the controller and keeps states, controls and
      costs; `"cost"` runs the controller and keeps only the total cost; `"gradient"`
      is the value and gradient of the total cost with respect to the gain (of its mean
      over the lanes of a batch); `"free"` has no controller and no cost and keeps only
      the final state.
    - `steps`: time steps.
    - `lanes`: batch size, or `None` for one chain without a batch axis.
    - `method`: Gymnasium's own step, or the ODE without the bound on the speed by
      classical Runge-Kutta or Tsit5, the torque held over each step.
    """

    workload: Workload = "trajectory"
    steps: int = 1000
    lanes: int | None = None
    method: Method = "gym"

    @property
    def total_steps(self) -> int:
        """Simulated steps in one run, all lanes together."""
        return self.steps * (self.lanes or 1)

    @property
    def label(self) -> str:
        """A short name for tables."""
        lanes = "one chain" if self.lanes is None else f"{self.lanes} lanes"
        return f"{self.method}, {self.workload}, {lanes}"

    def named(self, values: Any) -> dict[str, np.ndarray]:
        """What a run returned, by name; time is the first axis.

        - `"trajectory"`: `angle` and `speed` at `steps + 1` times, `control` and `cost`
          at `steps`. Final states that a run returned apart are joined here.
        - `"cost"`: `total`. `"gradient"`: `total` and `gradient`. `"free"`: `angle` and
          `speed` at the end.
        """
        if self.workload == "cost":
            values = (values,)
        arrays = [np.asarray(value) for value in values]
        if self.workload == "trajectory" and len(arrays) == 6:
            *arrays, angle, speed = arrays
            arrays[0] = np.concatenate([arrays[0], angle[None]])
            arrays[1] = np.concatenate([arrays[1], speed[None]])
        names = {
            "trajectory": ("angle", "speed", "control", "cost"),
            "cost": ("total",),
            "gradient": ("total", "gradient"),
            "free": ("angle", "speed"),
        }[self.workload]
        return dict(zip(names, arrays, strict=True))

    def starts(self) -> tuple[np.ndarray, np.ndarray]:
        """Start angles and speeds, float32: scalars for one chain, else `[lanes]`."""
        if self.lanes is None:
            angle, speed = START
        else:
            generator = np.random.default_rng(0)
            angle = generator.uniform(-np.pi, np.pi, self.lanes)
            speed = generator.uniform(-1.0, 1.0, self.lanes)
        return np.asarray(angle, np.float32), np.asarray(speed, np.float32)


@dataclass(frozen=True)
class Episodes:
    """Whole episodes of a named task under a control that is held.

    - `task`: a name that `delucax.make` knows.
    - `steps`: of an episode.
    - `count`: how many episodes.
    - `batched`: all at once, as lanes of a batch; else one after the other.
    - `kept`: `"trajectory"` keeps states, controls and costs of each step, `"cost"` the
      total cost and the last state.
    """

    task: str
    steps: int
    count: int
    batched: bool = False
    kept: Literal["trajectory", "cost"] = "cost"

    @property
    def total_steps(self) -> int:
        """Simulated steps in one run."""
        return self.steps * self.count

    @property
    def label(self) -> str:
        """A short name for tables."""
        lanes = f"{self.count} lanes" if self.batched else "one chain"
        return f"{self.task}, {self.kept}, {lanes}"
