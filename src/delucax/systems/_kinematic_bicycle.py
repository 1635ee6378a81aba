"""A car as a bicycle whose wheels roll where they point."""

from typing import ClassVar

import jax.numpy as jnp
from jaxtyping import Array

from .._module import parameter, positive
from .._typing import Control, Disturbance, State, Time
from ..math import cos, sin
from ._base import AbstractSystem


class KinematicBicycle(AbstractSystem):
    r"""A car whose wheels roll without slip, as a bicycle about its centre of mass:

    `dx/dt = speed cos(heading + slip)`, `dy/dt = speed sin(heading + slip)`,
    `d(heading)/dt = speed sin(slip) / rear`, `d(speed)/dt = acceleration`,
    `tan(slip) = rear / (front + rear) tan(steering)`.

    The state is (x [m], y [m], heading [rad], speed [m/s]), the control is
    (acceleration [m/s^2], steering [rad]). Smooth for steering inside +-pi/2, where the
    tangent ends.

    **Arguments:**

    - `front`, `rear`: from the centre of mass to the axles [m], 1.105 and 1.738 by
        default.

    **Raises:** `ValueError` if a length is not positive.

    Source: Kong, Pfeiffer, Schildbach and Borrelli, 2015.

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp

        car = dlx.systems.KinematicBicycle()
        x, u = jnp.array([0.0, 0.0, 0.0, 10.0]), jnp.array([0.0, 0.1])
        car.vector_field(0.0, x, u, None)
        ```
    """

    front: Array = parameter(1.105, constraint=positive)
    rear: Array = parameter(1.738, constraint=positive)

    state_names: ClassVar = ("x", "y", "heading", "speed")
    angle_names: ClassVar = ("heading",)
    control_names: ClassVar = ("acceleration", "steering")
    state_units: ClassVar = ("m", "m", "rad", "m/s")
    control_units: ClassVar = ("m/s^2", "rad")

    def vector_field(self, t: Time, x: State, u: Control, w: Disturbance) -> State:
        share = self.rear / (self.front + self.rear)
        tangent = share * sin(u[1]) / cos(u[1])
        # Cosine and sine of the slip angle, from its tangent.
        along = (1 + tangent * tangent) ** -0.5
        across = tangent * along
        c, s, v = cos(x[2]), sin(x[2]), x[3]
        return jnp.stack(
            [
                v * (c * along - s * across),
                v * (s * along + c * across),
                v * across / self.rear,
                u[0],
            ]
        )

    def equilibrium(self) -> tuple[State, Control]:
        """Standing at the origin; a standing car is not controllable.

        **Returns:** the zero state and control.
        """
        return jnp.zeros(4), jnp.zeros(2)
