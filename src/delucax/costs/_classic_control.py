"""The costs of Gym's classic control tasks, and a smooth alternative."""

from collections.abc import Callable

import jax.numpy as jnp
from jaxtyping import Array

from .._module import function_field, parameter
from .._typing import Control, Real, RealScalar, Scalar, State
from ..math import cos, wrap
from ._base import AbstractCost


class Arrival(AbstractCost):
    r"""A sparse cost: a constant $a$ and an effort $b\, u^\top u$ per step, and a final
    cost $c$ if the last state is a goal.

    Most Gym tasks have a sparse cost of this kind. The gradient of a sparse cost with
    respect to the state is 0 almost everywhere, so gradient-based planners and policy
    gradients learn nothing from it.

    **Arguments:**

    - `reached`: a function `(t, x) -> bool` that says whether the state is a goal
        state. Usually `reached` is the `terminated` function of the environment. By
        default no state is a goal state.
    - `step_cost`: $a$, 1 by default.
    - `control_weight`: $b$, 0 by default.
    - `arrival_cost`: $c$, 0 by default. With a negative `arrival_cost`, the arrival at
        a goal is rewarded.

    **Raises:** `ValueError` if a number is not finite.

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp

        cost = dlx.costs.Arrival(lambda t, x: x[0] > 1, arrival_cost=-100.0)
        cost.final(0.0, jnp.array([1.5, 0.0]))
        ```

        ```text
        Array(-100., dtype=float32)
        ```
    """

    reached: Callable[[RealScalar, Array], Array] | None = function_field(
        None, of="t, x"
    )
    step_cost: Real = parameter(1.0)
    control_weight: Real = parameter(0.0)
    arrival_cost: Real = parameter(0.0)

    def __call__(self, t: RealScalar, x: State, u: Control) -> Scalar:
        effort = self.control_weight * sum(part * part for part in tuple(u))
        return (self.step_cost + effort).astype(x.dtype)

    def final(self, t: RealScalar, x: State) -> Scalar:
        if self.reached is None:
            return super().final(t, x)
        # A final cost is charged once, because the goal terminates the episode.
        return jnp.where(self.reached(t, x), self.arrival_cost, 0.0).astype(x.dtype)


class PendulumCost(AbstractCost):
    r"""The cost of Gym's pendulum.

    $$\operatorname{wrap}(\theta)^2 + a\, \dot\theta^2 + b\, \tau^2$$

    Here $\theta$ is the angle from upright and $\tau$ the torque. The cost is smooth,
    except that its slope jumps where the pendulum hangs straight down.

    **Arguments:**

    - `velocity_weight`: $a$, 0.1 by default.
    - `torque_weight`: $b$, 0.001 by default.

    **Raises:** `ValueError` if a number is not finite.

    Source: Gymnasium (Towers et al., 2023), minus the reward of `Pendulum-v1`.

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp

        dlx.costs.PendulumCost()(0.0, jnp.array([0.5, 0.0]), jnp.zeros(1))
        ```

        ```text
        Array(0.25, dtype=float32)
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
    r"""A smooth cost for the acrobot: the square of the vertical distance of its tip
    from its highest position.

    $$q(x) + b\, \tau^2, \qquad q(x) = (2 + \cos\theta_1 + \cos(\theta_1 + \theta_2))^2
    + a\, (\dot\theta_1^2 + \dot\theta_2^2)$$

    The final cost is $c\, q(x)$. The cost $q$ is 0 when both links are upright and at
    rest, and 16 when both links hang at rest. Use this cost for planning and policy
    gradients, because the reward of Gym's Acrobot-v1 has no gradient.

    **Arguments:**

    - `velocity_weight`: $a$, 0.01 by default.
    - `torque_weight`: $b$, 0.01 by default.
    - `final_weight`: $c$, 0 by default.

    **Raises:** `ValueError` if a number is not finite.

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp

        env = dlx.make("acrobot", cost=dlx.costs.AcrobotHeight(), terminated=None)
        env.cost(0.0, jnp.zeros(4), jnp.zeros(1))
        ```

        ```text
        Array(16., dtype=float32)
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
