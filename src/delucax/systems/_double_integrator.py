"""A mass on a line without friction."""

from typing import ClassVar

import jax.numpy as jnp
from jaxtyping import Array

from .._module import parameter, positive
from .._typing import Control, Disturbance, State, Time
from ._base import AbstractSystem


class DoubleIntegrator(AbstractSystem):
    """A mass pushed along a line,

    `m d2(position)/dt2 = force`.

    The state is (position [m], velocity [m/s]), the control is (force [N]).

    **Arguments:**

    - `mass`: m [kg], 1 by default.

    **Raises:** `ValueError` if the mass is not positive.

    Source: Åström and Murray, 2008.

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp

        mass = dlx.systems.DoubleIntegrator()
        mass.vector_field(0.0, jnp.array([1.0, 0.5]), jnp.ones(1), None)
        ```
    """

    mass: Array = parameter(1.0, constraint=positive)

    state_names: ClassVar = ("position", "velocity")
    control_names: ClassVar = ("force",)
    state_units: ClassVar = ("m", "m/s")
    control_units: ClassVar = ("N",)

    def vector_field(self, t: Time, x: State, u: Control, w: Disturbance) -> State:
        return jnp.stack([x[1], u[0] / self.mass])

    def equilibrium(self) -> tuple[State, Control]:
        return jnp.zeros(2), jnp.zeros(1)
