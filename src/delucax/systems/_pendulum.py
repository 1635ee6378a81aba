"""The torque-driven pendulum of Gym's Pendulum-v1."""

from typing import ClassVar

import jax.numpy as jnp
from jaxtyping import Array

from .._module import parameter, positive
from .._typing import Control, Disturbance, State, Time
from ..math import sin
from ._base import AbstractSystem


class Pendulum(AbstractSystem):
    r"""A uniform rod hinged at one end, driven by a torque at the hinge:

    `d2(angle)/dt2 = 3 g / (2 l) sin(angle) + 3 torque / (m l^2) - d(angle)/dt b`

    with `angle = 0` upright. The state is (angle [rad], velocity [rad/s]), the control
    is (torque [N m]). The vector field is smooth.

    **Arguments:**

    - `mass`: m [kg], 1 by default.
    - `length`: l [m], 1 by default.
    - `gravity`: g [m/s^2], 10 by default, as in Gym.
    - `damping`: viscous friction b [1/s], 0 by default.

    **Raises:** `ValueError` if a mass or length is not positive, or a number is not
    finite.

    Source: Gymnasium (Towers et al., 2023), `Pendulum-v1`.

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp

        pendulum = dlx.systems.Pendulum(length=1.2)
        pendulum.vector_field(0.0, jnp.array([0.1, 0.0]), jnp.zeros(1), None)
        ```
    """

    mass: Array = parameter(1.0, constraint=positive)
    length: Array = parameter(1.0, constraint=positive)
    gravity: Array = parameter(10.0)
    damping: Array = parameter(0.0)

    state_names: ClassVar = ("angle", "velocity")
    angle_names: ClassVar = ("angle",)
    control_names: ClassVar = ("torque",)
    state_units: ClassVar = ("rad", "rad/s")
    control_units: ClassVar = ("N m",)

    def acceleration(self, angle: Array, velocity: Array, torque: Array) -> Array:
        """The angular acceleration.

        **Arguments:** `angle` [rad], `velocity` [rad/s], `torque` [N m]: scalars.

        **Returns:** d2(angle)/dt2 [rad/s^2].
        """
        weight = 3 * self.gravity / (2 * self.length) * sin(angle)
        drive = 3 / (self.mass * self.length**2) * torque
        return weight + drive - self.damping * velocity

    def vector_field(self, t: Time, x: State, u: Control, w: Disturbance) -> State:
        return jnp.stack([x[1], self.acceleration(x[0], x[1], u[0])])

    def equilibrium(self) -> tuple[State, Control]:
        return jnp.zeros(2), jnp.zeros(1)
