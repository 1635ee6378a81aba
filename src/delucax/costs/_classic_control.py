"""Costs of Gym's classic control, and smooth ones in their place."""

from collections.abc import Callable

import jax.numpy as jnp
from jaxtyping import Array

from .._module import function_field, parameter
from .._typing import Control, Real, RealScalar, Scalar, State
from ..math import cos, wrap
from ._base import AbstractCost


class Arrival(AbstractCost):
    """`step_cost + control_weight u'u` per step, and `arrival_cost` once, if the last
    state is a goal.

    The costs of most Gym tasks. It is sparse: the gradient with respect to the state is
    0 almost everywhere.

    **Arguments:**

    - `reached`: `(t, x) -> bool`, whether the state is a goal; usually the `terminated`
        of the environment. Never by default.
    - `step_cost`: 1 by default.
    - `control_weight`: 0 by default.
    - `arrival_cost`: 0 by default; a reward is negative.

    **Raises:** `ValueError` if a number is not finite.

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp

        cost = dlx.costs.Arrival(lambda t, x: x[0] > 1, arrival_cost=-100.0)
        cost.final(0.0, jnp.array([1.5, 0.0]))
        ```
    """

    reached: Callable[[RealScalar, Array], Array] | None = function_field(None)
    step_cost: Real = parameter(1.0)
    control_weight: Real = parameter(0.0)
    arrival_cost: Real = parameter(0.0)

    def __call__(self, t: RealScalar, x: State, u: Control) -> Scalar:
        effort = self.control_weight * sum(part * part for part in tuple(u))
        return (self.step_cost + effort).astype(x.dtype)

    def final(self, t: RealScalar, x: State) -> Scalar:
        if self.reached is None:
            return super().final(t, x)
        # Once, at the end: the goal terminates the episode.
        return jnp.where(self.reached(t, x), self.arrival_cost, 0.0).astype(x.dtype)


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

    velocity_weight: Real = parameter(0.1)
    torque_weight: Real = parameter(0.001)

    def __call__(self, t: RealScalar, x: State, u: Control) -> Scalar:
        angle = wrap(x[0])
        return (
            angle * angle
            + self.velocity_weight * (x[1] * x[1])
            + self.torque_weight * (u[0] * u[0])
        )


class AcrobotHeight(AbstractCost):
    """The squared height deficit of the tip of the acrobot:

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

    velocity_weight: Real = parameter(0.01)
    torque_weight: Real = parameter(0.01)
    final_weight: Real = parameter(0.0)

    def _state(self, x: State) -> Scalar:
        lack = 2 + cos(x[0]) + cos(x[0] + x[1])
        return lack * lack + self.velocity_weight * (x[2] * x[2] + x[3] * x[3])

    def __call__(self, t: RealScalar, x: State, u: Control) -> Scalar:
        return self._state(x) + self.torque_weight * (u[0] * u[0])

    def final(self, t: RealScalar, x: State) -> Scalar:
        return self.final_weight * self._state(x)
