"""The cost of Gym's Pendulum-v1."""

from jaxtyping import Array

from .._module import parameter
from .._typing import Control, RealScalar, Scalar, State
from ..math import wrap
from ._base import AbstractCost


class PendulumCost(AbstractCost):
    """`wrap(angle)^2 + velocity_weight velocity^2 + torque_weight torque^2`.

    Smooth but for the jump of the slope where the pendulum hangs straight down.

    **Arguments:**

    - `velocity_weight`: 0.1 by default.
    - `torque_weight`: 0.001 by default.

    Source: Gymnasium (Towers et al., 2023), minus the reward of `Pendulum-v1`.

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp

        dlx.costs.PendulumCost()(0.0, jnp.array([0.5, 0.0]), jnp.zeros(1))
        ```
    """

    velocity_weight: Array = parameter(0.1)
    torque_weight: Array = parameter(0.001)

    def __call__(self, t: RealScalar, x: State, u: Control) -> Scalar:
        angle = wrap(x[0])
        return (
            angle * angle
            + self.velocity_weight * (x[1] * x[1])
            + self.torque_weight * (u[0] * u[0])
        )
