"""Gym's arithmetic, which the tasks of classic control have by default."""

import abc

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from .._check import check_bool, check_range
from .._integration import runge_kutta_step
from .._jax import fence
from .._module import parameter, positive
from .._results import Result, RESULTS
from .._typing import Control, Disturbance, State, Time
from ..dynamics import AbstractDiscretization, RK4
from ..math import clip, wrap
from ..systems import Acrobot, CartPole, MountainCar, Pendulum


class AbstractGymStep(AbstractDiscretization):
    """A step as Gym writes it; then `w` is added."""

    @abc.abstractmethod
    def gym_step(self, x: State, u: Control) -> State:
        """The next state without disturbance.

        **Arguments:** `x`: state. `u`: control.

        **Returns:** the state, of any precision.
        """

    def advance(
        self, t: Time, x: State, u: Control, w: Disturbance
    ) -> tuple[State, Result]:
        x_next = self.gym_step(x, u)
        if w is not None:
            x_next = x_next + w
        return x_next.astype(x.dtype), RESULTS.successful


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


class GymCartPole(AbstractGymStep):
    """Gym's arithmetic for the cart-pole: an explicit Euler step; then `w` is added.

    Smooth. The angle is not wrapped.

    **Arguments:**

    - `system`: the cart-pole.
    - `dt`: the step, 0.02 by default.
    - `semi_implicit`: whether the positions move with the new velocities, Gym's other
        integrator. False by default.

    **Raises:** `ValueError` if `dt` is not positive, or `semi_implicit` is not a bool.

    Source: Gymnasium (Towers et al., 2023), `CartPole-v1`.

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp

        dynamics = dlx.environments.GymCartPole(dlx.systems.CartPole())
        dynamics(0.0, jnp.array([0.0, 0.0, 0.1, 0.0]), jnp.ones(1))
        ```
    """

    system: CartPole
    dt: Array = parameter(0.02, constraint=positive)
    semi_implicit: bool = eqx.field(static=True, default=False)

    def __check_init__(self):
        check_bool(self.semi_implicit, "semi_implicit", "GymCartPole")

    def gym_step(self, x: State, u: Control) -> State:
        dt = self.dt
        position, velocity, angle, spin = x[0], x[1], x[2], x[3]
        acceleration, turn = fence(*self.system.accelerations(angle, spin, u[0]))
        velocity_next, spin_next = velocity + dt * acceleration, spin + dt * turn
        if self.semi_implicit:
            velocity, spin = velocity_next, spin_next
        position, angle = position + dt * velocity, angle + dt * spin
        return jnp.stack([position, velocity_next, angle, spin_next])


class GymMountainCar(AbstractGymStep):
    """Gym's arithmetic for the mountain car, a semi-implicit Euler step with limits:

    `velocity_next = clip(velocity + acceleration dt, -max_speed, max_speed)`,
    `position_next = clip(position + velocity_next dt, min_position, max_position)`; a
    car that runs into the left wall stops there, `velocity_next = 0`; then `w` is
    added.

    Not smooth where the speed or the position meets its limit: the gradient through it
    is 0 beyond. The smooth variant is [`delucax.Discretized`][] of the same system.

    **Arguments:**

    - `system`: the car.
    - `dt`: the step, 1 by default, for the system's unit of time is Gym's step.
    - `max_speed`: 0.07 by default.
    - `min_position`, `max_position`: the walls, -1.2 and 0.6 by default. Only the left
        one stops the car.

    **Raises:** `ValueError` if `dt` or `max_speed` is not positive, or the walls cross.

    Source: Gymnasium (Towers et al., 2023), `MountainCarContinuous-v0` and
    `MountainCar-v0`.

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp

        dynamics = dlx.environments.GymMountainCar(dlx.systems.MountainCar())
        dynamics(0.0, jnp.array([-0.5, 0.0]), jnp.ones(1))
        ```
    """

    system: MountainCar
    dt: Array = parameter(1.0, constraint=positive)
    max_speed: Array = parameter(0.07, constraint=positive)
    min_position: Array = parameter(-1.2)
    max_position: Array = parameter(0.6)

    def __check_init__(self):
        low = self.min_position
        check_range(self.max_position, "max_position", "GymMountainCar", low)

    def gym_step(self, x: State, u: Control) -> State:
        position, velocity = x[0], x[1]
        acceleration = self.system.acceleration(position, u[0])
        velocity = velocity + acceleration * self.dt
        velocity = clip(velocity, -self.max_speed, self.max_speed)
        position = position + velocity * self.dt
        position = clip(position, self.min_position, self.max_position)
        stopped = (position <= self.min_position) & (velocity < 0)
        velocity = jnp.where(stopped, 0, velocity)
        return jnp.stack([position, velocity])


class GymAcrobot(AbstractDiscretization):
    """Gym's arithmetic for the acrobot: one Runge-Kutta step of order 4, the torque
    held with `w` added to it; then the angles are wrapped to +-pi and the velocities
    clipped.

    Not smooth where a velocity meets its limit: the gradient through it is 0 beyond.
    The state jumps where an angle wraps, the gradient does not. The smooth variant is
    [`delucax.Discretized`][] of the same system.

    A step is Gym's to rounding. The acrobot is chaotic, so that of 100 episodes under
    random actions about 5 end more than 1e-6 from Gym's in double precision, as Gym's
    own do when they start at the next number that there is.

    **Arguments:**

    - `system`: the acrobot.
    - `dt`: the step, 0.2 by default.
    - `max_velocity_1`, `max_velocity_2`: 4 pi and 9 pi by default.

    **Raises:** `ValueError` if `dt` or a limit is not positive.

    Source: Gymnasium (Towers et al., 2023), `Acrobot-v1`.

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp

        dynamics = dlx.environments.GymAcrobot(dlx.systems.Acrobot())
        dynamics(0.0, jnp.array([0.1, 0.0, 0.0, 0.0]), jnp.ones(1))
        ```
    """

    system: Acrobot
    dt: Array = parameter(0.2, constraint=positive)
    max_velocity_1: Array = parameter(4 * np.pi, constraint=positive)
    max_velocity_2: Array = parameter(9 * np.pi, constraint=positive)

    def advance(
        self, t: Time, x: State, u: Control, w: Disturbance
    ) -> tuple[State, Result]:
        field = lambda t, x: self.system.vector_field(t, x, u, w)
        free = runge_kutta_step(RK4.tableau, field, t, x, self.dt)
        x_next = jnp.stack(
            [
                wrap(free[0]),
                wrap(free[1]),
                clip(free[2], -self.max_velocity_1, self.max_velocity_1),
                clip(free[3], -self.max_velocity_2, self.max_velocity_2),
            ]
        )
        return x_next.astype(x.dtype), RESULTS.successful
