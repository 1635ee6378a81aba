"""Swing up and hold a pendulum: Gym's Pendulum-v1."""

from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from .._check import check_range
from .._module import parameter, positive
from .._typing import Control, State, Vector
from ..costs import PendulumCost
from ..dynamics import Discretized
from ..math import clip, cos, sin
from ..systems import Pendulum
from ._gym import AbstractGymStep
from ._task import task
from ._uniform_state import UniformState


class GymPendulum(AbstractGymStep):
    """Gym's arithmetic for the pendulum, which clips between its half-steps:

    `velocity_next = clip(velocity + acceleration dt, -max_speed, max_speed)`,
    `angle_next = angle + velocity_next dt`; then `w` is added.

    Not smooth where the speed meets its limit: the gradient through the velocity is 0
    beyond it. The smooth variant is [`delucax.Discretized`][] of the same system. The
    angle is not wrapped.

    **Arguments:**

    - `system`: the pendulum.
    - `dt`: the step, 0.05 by default.
    - `max_speed`: 8 by default.

    **Raises:** `ValueError` if `dt` or `max_speed` is not positive.

    Source: Gymnasium (Towers et al., 2023), `Pendulum-v1`.

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp

        dynamics = dlx.environments.GymPendulum(dlx.systems.Pendulum())
        dynamics(0.0, jnp.array([0.1, 0.0]), jnp.zeros(1))
        ```
    """

    system: Pendulum
    dt: Array = parameter(0.05, constraint=positive)
    max_speed: Array = parameter(8.0, constraint=positive)

    def gym_step(self, x: State, u: Control) -> State:
        angle, velocity = x[0], x[1]
        acceleration = self.system.acceleration(angle, velocity, u[0])
        velocity = velocity + acceleration * self.dt
        velocity = clip(velocity, -self.max_speed, self.max_speed)
        angle = angle + velocity * self.dt
        return jnp.stack([angle, velocity])


def pendulum_features(x: State) -> Vector:
    """Cosine and sine of the angle, and the velocity: what Gymnasium users see.

    **Arguments:** `x`: (angle, velocity).

    **Returns:** (cos(angle), sin(angle), velocity).

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp

        dlx.environments.pendulum_features(jnp.array([0.1, 0.0]))
        ```
    """
    return jnp.stack([cos(x[0]), sin(x[0]), x[1]])


@task(Pendulum, gym=GymPendulum, dt=0.05, horizon=200)
def pendulum(
    dynamics: GymPendulum | Discretized, *, max_torque: Any = 2.0
) -> dict[str, Any]:
    """Swing up a pendulum and hold it upright with a torque too weak to lift it at
    once.

    State (angle, velocity) with angle 0 upright; control (torque). Starts with the
    angle uniform over the circle and the velocity in +-1. Cost
    `wrap(angle)^2 + 0.1 velocity^2 + 0.001 torque^2` a step. Never terminates.

    Not smooth where the speed meets the limit of Gym's arithmetic; a `solver` gives the
    smooth variant. The slope of the cost jumps where the pendulum hangs straight down.

    **Arguments:**

    - `system`: a [`delucax.systems.Pendulum`][]; made of `others` by default.
    - `dt`: the control interval, 0.05 by default.
    - `horizon`: steps an episode, 200 by default.
    - `max_torque`: 2 by default.
    - `solver`: a Diffrax solver in place of Gym's arithmetic; there is no speed limit
        then.
    - `substeps`: solver steps an interval, with `solver`.
    - `**others`: arguments of [`delucax.systems.Pendulum`][], of
        [`delucax.environments.GymPendulum`][], such as `max_speed`, without a `solver`,
        or of [`delucax.Environment`][], such as `disturbance`.

    **Returns:** an [`delucax.Environment`][].

    **Raises:** `ValueError` on illegal numbers, `substeps` without `solver`, or
        `max_speed` with it.

    Source: Gymnasium (Towers et al., 2023), `Pendulum-v1`.

    !!! example

        ```python
        import delucax as dlx

        env = dlx.environments.pendulum(length=1.2, dt=0.02)
        ```
    """
    check_range(max_torque, "max_torque", "pendulum")
    fastest = dynamics.max_speed if isinstance(dynamics, GymPendulum) else np.inf
    feature_bound = jnp.array([1.0, 1.0, fastest])
    corner = jnp.array([np.pi, 1.0])
    return dict(
        cost=PendulumCost(),
        initial_state=UniformState(-corner, corner),
        control_bounds=(-max_torque, max_torque),
        encode=pendulum_features,
        observation_bounds=(-feature_bound, feature_bound),
    )
