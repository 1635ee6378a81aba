"""The butterfly, forced."""

from typing import ClassVar

import jax.numpy as jnp
from jaxtyping import Array

from .._module import parameter
from .._typing import Control, Disturbance, State, Time
from ._base import AbstractSystem


class Lorenz(AbstractSystem):
    """Lorenz's model of convection, forced,

    `dx/dt = sigma (y - x) + u`, `dy/dt = x (rho - z) - y`, `dz/dt = x y - beta z`.

    Chaotic at the default constants: two starts drift apart by a factor e in about 1.1.
    Smooth. The numbers have no units.

    **Arguments:**

    - `sigma`: 10 by default.
    - `rho`: 28 by default.
    - `beta`: 8/3 by default.

    **Raises:** `ValueError` if a number is not finite.

    Source: Lorenz, 1963; Kaiser, Kutz and Brunton, 2018, for where the control enters.

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp

        lorenz = dlx.systems.Lorenz()
        lorenz.vector_field(0.0, jnp.ones(3), jnp.zeros(1), None)
        ```
    """

    sigma: Array = parameter(10.0)
    rho: Array = parameter(28.0)
    beta: Array = parameter(8.0 / 3.0)

    state_names: ClassVar = ("x", "y", "z")
    control_names: ClassVar = ("u",)

    def vector_field(self, t: Time, x: State, u: Control, w: Disturbance) -> State:
        return jnp.stack(
            [
                self.sigma * (x[1] - x[0]) + u[0],
                x[0] * (self.rho - x[2]) - x[1],
                x[0] * x[1] - self.beta * x[2],
            ]
        )

    def equilibrium(self) -> tuple[State, Control]:
        """The centre of the right wing, `x = y = sqrt(beta (rho - 1))`, `z = rho - 1`;
        the origin where there are no wings (`rho <= 1`).

        **Returns:** the state, and no control.
        """
        winged = (self.rho > 1) & (self.beta > 0)
        height = jnp.where(winged, self.rho - 1, 0.0)
        square = jnp.where(winged, self.beta * height, 1.0)
        wing = jnp.where(winged, jnp.sqrt(square), 0.0)
        return jnp.stack([wing, wing, height]), jnp.zeros(1)
