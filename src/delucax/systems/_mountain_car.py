"""The underpowered car in a valley of Gym's MountainCar tasks."""

from typing import ClassVar

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike

from .._module import parameter
from .._typing import Control, Disturbance, State, Time
from ..math import cos, sin
from ._base import AbstractSystem


class MountainCar(AbstractSystem):
    r"""A car in a valley whose slopes are steeper than its motor can climb:

    `d(velocity)/dt = power push - gravity cos(3 position)`

    The state is (position, velocity), the control is (push). The unit of time is a
    step: Gym gives its constants for one step at a time, so Gym's arithmetic is
    semi-implicit Euler with `dt = 1`. Gravity acts along the position, not along the
    track. The vector field is smooth, and has no walls and no speed limit. The
    equilibrium that it names is the bottom of the valley, `position = -pi/6`.

    **Arguments:**

    - `power`: of the motor, 0.0015 by default, as in `MountainCarContinuous-v0`;
        `MountainCar-v0` has 0.001.
    - `gravity`: 0.0025 by default.

    **Raises:** `ValueError` if a number is not finite.

    Source: Moore, 1990; Gymnasium (Towers et al., 2023), `MountainCarContinuous-v0` and
    `MountainCar-v0`.

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp

        car = dlx.systems.MountainCar()
        car.vector_field(0.0, jnp.array([-0.5, 0.0]), jnp.ones(1), None)
        ```
    """

    power: Array = parameter(0.0015)
    gravity: Array = parameter(0.0025)

    state_names: ClassVar = ("position", "velocity")
    control_names: ClassVar = ("push",)
    state_units: ClassVar = ("", "1/step")
    time_unit: ClassVar = "steps"
    control_units: ClassVar = ("",)

    def acceleration(self, position: Array, push: Array) -> Array:
        """The acceleration.

        **Arguments:** `position`, `push`: scalars.

        **Returns:** d(velocity)/dt, a step being the unit of time.
        """
        return self.power * push - self.gravity * cos(3 * position)

    def height(self, position: ArrayLike) -> Array:
        """The height of the track, `0.45 sin(3 position) + 0.55`, as Gym draws it.

        **Arguments:** `position`: any shape.

        **Returns:** the height, of the same shape.
        """
        return 0.45 * sin(3 * jnp.asarray(position)) + 0.55

    def vector_field(self, t: Time, x: State, u: Control, w: Disturbance) -> State:
        return jnp.stack([x[1], self.acceleration(x[0], u[0])])

    def equilibrium(self) -> tuple[State, Control]:
        return jnp.array([-np.pi / 6, 0.0]), jnp.zeros(1)
