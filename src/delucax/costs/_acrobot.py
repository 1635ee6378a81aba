"""A smooth cost for swinging the acrobot up."""

from jaxtyping import Array

from .._module import parameter
from .._typing import Control, RealScalar, Scalar, State
from ..math import cos
from ._base import AbstractCost


class AcrobotHeight(AbstractCost):
    """What the tip of the acrobot lacks in height, squared:

    `(2 + cos(angle_1) + cos(angle_1 + angle_2))^2 + velocity_weight (velocity_1^2 +
    velocity_2^2) + torque_weight torque^2`, and at the end `final_weight` times the
    part that is of the state.

    Smooth; 0 upright and at rest, 16 where both links hang at rest. The reward of
    Gym's Acrobot-v1 has no gradient, so this is for planning and policy gradients.

    **Arguments:**

    - `velocity_weight`: 0.01 by default.
    - `torque_weight`: 0.01 by default.
    - `final_weight`: 0 by default.

    !!! example

        ```python
        import delucax as dlx

        env = dlx.make("acrobot", cost=dlx.costs.AcrobotHeight(), terminated=None)
        ```
    """

    velocity_weight: Array = parameter(0.01)
    torque_weight: Array = parameter(0.01)
    final_weight: Array = parameter(0.0)

    def _state(self, x: State) -> Scalar:
        lack = 2 + cos(x[0]) + cos(x[0] + x[1])
        return lack * lack + self.velocity_weight * (x[2] * x[2] + x[3] * x[3])

    def __call__(self, t: RealScalar, x: State, u: Control) -> Scalar:
        return self._state(x) + self.torque_weight * (u[0] * u[0])

    def final(self, t: RealScalar, x: State) -> Scalar:
        return self.final_weight * self._state(x)
