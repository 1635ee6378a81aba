"""The oscillator with a limit cycle."""

from typing import ClassVar

import jax.numpy as jnp
from jaxtyping import Array

from .._module import parameter
from .._typing import Control, Disturbance, State, Time
from ._base import AbstractSystem


class VanDerPol(AbstractSystem):
    """Van der Pol's oscillator, forced,

    `dx/dt = v`, `dv/dt = mu (1 - x^2) v - x + u`.

    Without control every motion but rest goes to one limit cycle, of amplitude near 2.
    Smooth; stiff for large mu. The numbers have no units.

    **Arguments:**

    - `mu`: the damping, 1 by default.

    **Raises:** `ValueError` if `mu` is not finite.

    Source: van der Pol, 1926.

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp

        oscillator = dlx.systems.VanDerPol(mu=2.0)
        oscillator.vector_field(0.0, jnp.ones(2), jnp.zeros(1), None)
        ```
    """

    mu: Array = parameter(1.0)

    state_names: ClassVar = ("x", "v")
    control_names: ClassVar = ("u",)

    def vector_field(self, t: Time, x: State, u: Control, w: Disturbance) -> State:
        damping = self.mu * (1 - x[0] * x[0])
        return jnp.stack([x[1], damping * x[1] - x[0] + u[0]])

    def equilibrium(self) -> tuple[State, Control]:
        return jnp.zeros(2), jnp.zeros(1)
