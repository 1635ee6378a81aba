"""Drive an underpowered car out of a valley: Gym's MountainCarContinuous-v0 and
MountainCar-v0."""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array

from .._check import check_number, check_range
from .._module import parameter, positive
from .._typing import BoolScalar, Control, State, Time
from ..costs import Arrival
from ..dynamics import Discretized
from ..math import clip
from ..systems import MountainCar
from ._gym import AbstractGymStep
from ._task import task
from ._uniform_state import UniformState


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


class _AtGoal(eqx.Module):
    """Whether the car is at the goal or beyond it, and fast enough."""

    goal_position: Array = parameter()
    goal_velocity: Array = parameter()

    def __call__(self, t: Time, x: State) -> BoolScalar:
        return (x[0] >= self.goal_position) & (x[1] >= self.goal_velocity)


@task(MountainCar, gym=GymMountainCar, dt=1.0, horizon=999)
def mountain_car(
    dynamics: GymMountainCar | Discretized,
    *,
    goal_position: Any = 0.45,
    goal_velocity: Any = 0.0,
) -> dict[str, Any]:
    """Drive a car out of a valley by rocking it: Gym's MountainCarContinuous-v0.

    State (position, velocity); control (push), in +-1. Starts at rest with the position
    uniform in [-0.6, -0.4]. A step costs `0.1 push^2`, and the arrival at the goal
    -100, where the episode ends. Gym charges the push that was asked for; here it is
    the one that was applied, within the bounds.

    The arrival has no gradient. For planning and policy gradients give as `cost` a
    [`delucax.costs.Quadratic`][] with the goal as `state_target`, `terminated=None`,
    and a `solver` for dynamics without walls and limits.

    **Arguments:**

    - `system`: a [`delucax.systems.MountainCar`][]; made of `others` by default.
    - `dt`: the control interval in Gym's steps, 1 by default.
    - `horizon`: steps an episode, 999 by default.
    - `goal_position`: 0.45 by default.
    - `goal_velocity`: the least velocity at the goal, 0 by default.
    - `solver`: a Diffrax solver in place of Gym's arithmetic; there are no limits then.
    - `substeps`: solver steps an interval, with `solver`.
    - `**others`: arguments of [`delucax.systems.MountainCar`][], of
        [`delucax.environments.GymMountainCar`][], such as `max_speed`, without a
        `solver`, or of [`delucax.Environment`][], such as `disturbance`.

    **Returns:** an [`delucax.Environment`][].

    **Raises:** `ValueError` on illegal numbers, `substeps` without `solver`, or a limit
        with it.

    Source: Gymnasium (Towers et al., 2023), `MountainCarContinuous-v0`; Moore, 1990.

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp

        env = dlx.environments.mountain_car(power=0.002)
        cost = dlx.costs.Quadratic(
            jnp.diag(jnp.array([1.0, 0.0])), 0.1 * jnp.eye(1), state_target=[0.45, 0.0]
        )
        smooth = dlx.make(
            "mountain_car", solver=dlx.dynamics.RK4(), cost=cost, terminated=None
        )
        ```
    """
    goal, valley = _valley("mountain_car", dynamics, goal_position, goal_velocity)
    cost = Arrival(goal, step_cost=0.0, control_weight=0.1, arrival_cost=-100.0)
    return dict(cost=cost, **valley)


@task(
    MountainCar,
    gym=GymMountainCar,
    dt=1.0,
    horizon=200,
    arguments=lambda *, power=0.001: dict(power=power),
)
def mountain_car_discrete(
    dynamics: GymMountainCar | Discretized,
    *,
    goal_position: Any = 0.5,
    goal_velocity: Any = 0.0,
) -> dict[str, Any]:
    """Drive a car out of a valley in the fewest steps: Gym's MountainCar-v0.

    As [`delucax.environments.mountain_car`][] with a weaker motor and a farther goal;
    the integer actions 0, 1, 2 are the pushes -1, 0, 1, and a push between them is
    taken too. A step costs 1, the arrival nothing.

    That cost has no gradient; what has is named there.

    **Arguments:**

    - `system`: a [`delucax.systems.MountainCar`][]; made of `others` by default.
    - `power`: of its motor, 0.001 by default.
    - `dt`: the control interval in Gym's steps, 1 by default.
    - `horizon`: steps an episode, 200 by default.
    - `goal_position`: 0.5 by default.
    - `goal_velocity`: the least velocity at the goal, 0 by default.
    - `solver`: a Diffrax solver in place of Gym's arithmetic; there are no limits then.
    - `substeps`: solver steps an interval, with `solver`.
    - `**others`: arguments of [`delucax.systems.MountainCar`][], of
        [`delucax.environments.GymMountainCar`][], such as `max_speed`, without a
        `solver`, or of [`delucax.Environment`][], such as `disturbance`.

    **Returns:** an [`delucax.Environment`][].

    **Raises:** `ValueError` on illegal numbers, `substeps` without `solver`, or a limit
        with it.

    Source: Gymnasium (Towers et al., 2023), `MountainCar-v0`; Moore, 1990.

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp

        env = dlx.environments.mountain_car_discrete()
        env.step(0.0, jnp.array([-0.5, 0.0]), 2)
        ```
    """
    where = "mountain_car_discrete"
    goal, valley = _valley(where, dynamics, goal_position, goal_velocity)
    return dict(cost=Arrival(goal), actions=[[-1.0], [0.0], [1.0]], **valley)


def _valley(
    where: str,
    dynamics: GymMountainCar | Discretized,
    goal_position: Any,
    goal_velocity: Any,
) -> tuple[_AtGoal, dict[str, Any]]:
    """The goal, and what both tasks have: where a car starts, and between what it
    stays."""
    check_number(goal_position, "goal_position", where)
    check_number(goal_velocity, "goal_velocity", where)
    goal, bounds = _AtGoal(goal_position, goal_velocity), None
    if isinstance(dynamics, GymMountainCar):
        bounds = (
            jnp.stack([dynamics.min_position, -dynamics.max_speed]),
            jnp.stack([dynamics.max_position, dynamics.max_speed]),
        )
    return goal, dict(
        initial_state=UniformState([-0.6, 0.0], [-0.4, 0.0]),
        control_bounds=(-1.0, 1.0),
        terminated=goal,
        observation_bounds=bounds,
    )
