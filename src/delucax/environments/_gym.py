"""Gym's integrators: the default dynamics of the classic control tasks."""

import abc
from typing import Any, ClassVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from .._check import check_bool, check_range
from .._integration import runge_kutta_step
from .._jax import fence
from .._module import parameter, positive
from .._results import Result, RESULTS
from .._typing import Control, Disturbance, Real, State, Time
from ..dynamics import AbstractDiscretization, RK4
from ..math import clip, wrap
from ..systems import Acrobot, CartPole, MountainCar, Pendulum


class AbstractGymStep(AbstractDiscretization):
    """A step as in Gym. If the system has no `disturbance_names`, `w` is added to the
    next state.

    The gradient through a state that meets its limit is 0. For a smooth variant, use
    [`delucax.Discretized`][] of the same system. The angles of the pendulum and the
    cart-pole are not wrapped.
    """

    kind: ClassVar[Any]
    """The class of the system. Gym's step calls its accelerations, and not its vector
    field, unless `calls_field`."""
    calls_field: ClassVar[bool] = False

    def __check_init__(self):
        system, kind, where = self.system, self.kind, type(self).__name__
        if not isinstance(system, kind):
            raise ValueError(
                f"{where}: system must be a {kind.__name__}, got "
                f"{type(system).__name__}."
            )
        changes = {
            "a vector_field of its own": type(system).vector_field
            is not kind.vector_field,
            "disturbance_names": bool(system.disturbance_names),
        }
        changes = {} if self.calls_field else changes
        changes["a diffusion"] = system.noise == "brownian"
        changes["a project of its own"] = system.projects_state
        for what, is_there in changes.items():
            if is_there:
                raise ValueError(
                    f"{where}: system must not have {what}, which Gym's integrator "
                    "does not use. Pass a solver, such as delucax.dynamics.RK4()."
                )

    @abc.abstractmethod
    def gym_step(self, t: Time, x: State, u: Control, w: Disturbance) -> State:
        """The next state, before an additive `w`, in any precision.

        **Arguments:** `t`: time. `x`: state. `u`: control. `w`: disturbance.

        **Returns:** the next state.
        """

    def advance(
        self, t: Time, x: State, u: Control, w: Disturbance
    ) -> tuple[State, Result]:
        x_next = self.gym_step(t, x, u, w)
        if w is not None and not self.disturbance_names:
            x_next = x_next + w
        return x_next.astype(x.dtype), RESULTS.successful


class GymPendulum(AbstractGymStep):
    """A semi-implicit Euler step whose velocity is clipped before the angle moves."""

    kind = Pendulum
    system: Pendulum
    dt: Real = parameter(0.05, constraint=positive)
    max_speed: Real = parameter(8.0, constraint=positive)

    def gym_step(self, t: Time, x: State, u: Control, w: Disturbance) -> State:
        angle, velocity = x[0], x[1]
        acceleration = self.system.acceleration(angle, velocity, u[0])
        velocity = velocity + acceleration * self.dt
        velocity = clip(velocity, -self.max_speed, self.max_speed)
        # Semi-implicit: the angle moves with the new velocity.
        return jnp.stack([angle + velocity * self.dt, velocity])


class GymCartPole(AbstractGymStep):
    """An explicit Euler step; with `semi_implicit`, Gym's other integrator, the
    positions move with the new velocities."""

    kind = CartPole
    system: CartPole
    dt: Real = parameter(0.02, constraint=positive)
    semi_implicit: bool = eqx.field(static=True, default=False)

    def __check_init__(self):
        check_bool(self.semi_implicit, "semi_implicit", "GymCartPole")

    def gym_step(self, t: Time, x: State, u: Control, w: Disturbance) -> State:
        dt = self.dt
        position, velocity, angle, spin = x[0], x[1], x[2], x[3]
        # Without the fence, XLA computes both accelerations again for each entry of a
        # batch.
        acceleration, turn = fence(*self.system.accelerations(angle, spin, u[0]))
        velocity_next, spin_next = velocity + dt * acceleration, spin + dt * turn
        if self.semi_implicit:
            velocity, spin = velocity_next, spin_next
        position, angle = position + dt * velocity, angle + dt * spin
        return jnp.stack([position, velocity_next, angle, spin_next])


class GymMountainCar(AbstractGymStep):
    """A semi-implicit Euler step with clipped velocity and position. A car that runs
    into the left wall stops there."""

    kind = MountainCar
    system: MountainCar
    dt: Real = parameter(1.0, constraint=positive)
    max_speed: Real = parameter(0.07, constraint=positive)
    min_position: Real = parameter(-1.2)
    max_position: Real = parameter(0.6)

    def __check_init__(self):
        low = self.min_position
        check_range(self.max_position, "max_position", "GymMountainCar", low)

    def gym_step(self, t: Time, x: State, u: Control, w: Disturbance) -> State:
        position, velocity = x[0], x[1]
        acceleration = self.system.acceleration(position, u[0])
        velocity = velocity + acceleration * self.dt
        velocity = clip(velocity, -self.max_speed, self.max_speed)
        position = position + velocity * self.dt
        position = clip(position, self.min_position, self.max_position)
        # As in Gym, the right wall does not stop the car; the goal is before it.
        stopped = (position <= self.min_position) & (velocity < 0)
        return jnp.stack([position, jnp.where(stopped, 0, velocity)])


class GymAcrobot(AbstractGymStep):
    """One Runge-Kutta step of order 4 with torque and `w` held. Then the angles are
    wrapped to +-pi and the velocities are clipped."""

    kind, calls_field = Acrobot, True
    system: Acrobot
    dt: Real = parameter(0.2, constraint=positive)
    max_velocity_1: Real = parameter(4 * np.pi, constraint=positive)
    max_velocity_2: Real = parameter(9 * np.pi, constraint=positive)

    def gym_step(self, t: Time, x: State, u: Control, w: Disturbance) -> State:
        field = lambda t, x: self.system.vector_field(t, x, u, w)
        free = runge_kutta_step(RK4.tableau, field, t, x, self.dt)
        fastest_1, fastest_2 = self.max_velocity_1, self.max_velocity_2
        velocity_1 = clip(free[2], -fastest_1, fastest_1)
        velocity_2 = clip(free[3], -fastest_2, fastest_2)
        return jnp.stack([wrap(free[0]), wrap(free[1]), velocity_1, velocity_2])
