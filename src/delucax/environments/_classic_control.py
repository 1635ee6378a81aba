"""Gym's Pendulum-v1, CartPole-v1, Acrobot-v1 and the two mountain cars."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from .._module import parameter
from .._typing import BoolScalar, Real, State, Time, Vector
from ..costs import Arrival, PendulumCost
from ..disturbances import AbstractDisturbance, Uniform
from ..dynamics import Discretized
from ..math import cos, sin
from ..systems import Acrobot, CartPole, MountainCar, Pendulum
from ._gym import GymAcrobot, GymCartPole, GymMountainCar, GymPendulum
from ._task import box, Fields, Limit, Number, Positive, task, UniformState


def pendulum_features(x: State) -> Vector:
    """Cosine and sine of the angle, and the velocity."""
    return jnp.stack([cos(x[0]), sin(x[0]), x[1]])


@task(Pendulum, gym=GymPendulum, dt=0.05, horizon=200)
def pendulum(dynamics: GymPendulum | Discretized, *, max_torque: Limit = 2.0) -> Fields:
    """Swing up a pendulum and hold it upright with a torque too weak to lift it at
    once.

    State (angle, velocity) with angle 0 upright; control (torque). Starts with the
    angle uniform over the circle and the velocity in +-1. Cost
    `wrap(angle)^2 + 0.1 velocity^2 + 0.001 torque^2` per step. Never terminates.
    `encode` gives the cosine and the sine of the angle, and the velocity.

    Not smooth where the speed meets the limit of Gym's integrator; a `solver` gives the
    smooth variant. The slope of the cost jumps where the pendulum hangs straight down.

    **Arguments:**

    - `max_torque`: 2 by default.
    - `max_speed`: of Gym's integrator, 8 by default.

    Source: Gymnasium (Towers et al., 2023), `Pendulum-v1`.

    !!! example

        ```python
        import delucax as dlx

        env = dlx.environments.pendulum(length=1.2, dt=0.02)
        ```
    """
    fastest = dynamics.max_speed if isinstance(dynamics, GymPendulum) else np.inf
    return dict(
        cost=PendulumCost(),
        initial_state=UniformState([-np.pi, -1.0], [np.pi, 1.0]),
        control_bounds=(-max_torque, max_torque),
        encode=pendulum_features,
        observation_bounds=box([1.0, 1.0, fastest]),
    )


class _Fallen(eqx.Module):
    """Whether the cart has left the track or the pole has fallen."""

    max_position: Real = parameter()
    max_angle: Real = parameter()

    def __call__(self, t: Time, x: State) -> BoolScalar:
        return (abs(x[0]) > self.max_position) | (abs(x[2]) > self.max_angle)


@task(CartPole, gym=GymCartPole, dt=0.02, horizon=500)
def cartpole(
    dynamics: GymCartPole | Discretized,
    *,
    max_force: Limit = 10.0,
    max_position: Positive = 2.4,
    max_angle: Positive = 12 * 2 * np.pi / 360,
) -> Fields:
    """Keep a pole upright on a cart that a force pushes to and fro.

    State (position, velocity, angle, spin), upright at 0; control (force), continuous
    within its bounds; the integer actions 0 and 1 are Gym's forces -10 and 10. Starts
    with each state uniform in +-0.05. A step costs -1; the episode ends when the
    position or the angle leaves its bounds.

    The dynamics are smooth as they are. That cost has no gradient: for planning and
    policy gradients give a [`delucax.costs.Quadratic`][] as `cost`. The linear model
    about the upright pole is `dlx.linearize(env.dynamics)`.

    **Arguments:**

    - `max_force`: 10 by default.
    - `max_position`: where the track ends, 2.4 by default.
    - `max_angle`: beyond which the pole has fallen, 12 degrees by default.
    - `semi_implicit`: whether in Gym's integrator, which is an explicit Euler step, the
        positions move with the new velocities; False by default.

    Source: Gymnasium (Towers et al., 2023), `CartPole-v1`; Barto, Sutton and Anderson,
    1983.

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp

        env = dlx.environments.cartpole(half_length=0.6)
        env.step(0.0, jnp.zeros(4), 1)
        smooth = dlx.make("cartpole", cost=dlx.costs.Quadratic(jnp.eye(4), jnp.eye(1)))
        lqr = dlx.controllers.LQR(dlx.linearize(env.dynamics), jnp.eye(4), jnp.eye(1))
        ```
    """
    # Gym's own: twice where the episode ends, which no state of an episode reaches.
    feature_bound = [2 * max_position, np.inf, 2 * max_angle, np.inf]
    return dict(
        cost=Arrival(step_cost=-1.0),
        initial_state=UniformState([-0.05] * 4, [0.05] * 4),
        control_bounds=(-max_force, max_force),
        terminated=_Fallen(max_position, max_angle),
        actions=[[-max_force], [max_force]],
        observation_bounds=box(feature_bound),
    )


class _AtGoal(eqx.Module):
    """Whether the car is at the goal or beyond it, and fast enough."""

    goal_position: Real = parameter()
    goal_velocity: Real = parameter()

    def __call__(self, t: Time, x: State) -> BoolScalar:
        return (x[0] >= self.goal_position) & (x[1] >= self.goal_velocity)


@task(MountainCar, gym=GymMountainCar, dt=1.0, horizon=999)
def mountain_car(
    dynamics: GymMountainCar | Discretized,
    *,
    goal_position: Number = 0.45,
    goal_velocity: Number = 0.0,
) -> Fields:
    """Drive a car out of a valley by rocking it: Gym's MountainCarContinuous-v0.

    State (position, velocity); control (push), in +-1. Starts at rest with the position
    uniform in [-0.6, -0.4]. A step costs `0.1 push^2`, and the arrival at the goal
    -100, where the episode ends. The cost is that of the push after clipping; Gym
    charges the push before.

    The arrival has no gradient. For planning and policy gradients give as `cost` a
    [`delucax.costs.Quadratic`][] with the goal as `state_target`, `terminated=None`,
    and a `solver` for dynamics without walls and limits.

    **Arguments:**

    - `goal_position`: 0.45 by default.
    - `goal_velocity`: the least velocity at the goal, 0 by default.
    - `max_speed`, `min_position`, `max_position`: of Gym's integrator, which stops the
        car at the left wall; 0.07, -1.2 and 0.6 by default.

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
    goal = _AtGoal(goal_position, goal_velocity)
    cost = Arrival(goal, step_cost=0.0, control_weight=0.1, arrival_cost=-100.0)
    return dict(cost=cost, **_valley(dynamics, goal))


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
    goal_position: Number = 0.5,
    goal_velocity: Number = 0.0,
) -> Fields:
    """Drive a car out of a valley in the fewest steps: Gym's MountainCar-v0.

    As [`delucax.environments.mountain_car`][] with a weaker motor and a farther goal;
    the integer actions 0, 1, 2 are the pushes -1, 0, 1, and a push between them is
    taken too. A step costs 1, the arrival nothing. The limits are the same.

    The cost is not differentiable; see there for smooth alternatives.

    **Arguments:**

    - `power`: of its motor, 0.001 by default.
    - `goal_position`: 0.5 by default.
    - `goal_velocity`: the least velocity at the goal, 0 by default.

    Source: Gymnasium (Towers et al., 2023), `MountainCar-v0`; Moore, 1990.

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp

        env = dlx.environments.mountain_car_discrete()
        env.step(0.0, jnp.array([-0.5, 0.0]), 2)
        ```
    """
    goal = _AtGoal(goal_position, goal_velocity)
    actions = [[-1.0], [0.0], [1.0]]
    return dict(cost=Arrival(goal), actions=actions, **_valley(dynamics, goal))


def _valley(dynamics: GymMountainCar | Discretized, goal: _AtGoal) -> Fields:
    """The initial states and bounds that both tasks share."""
    bounds = None
    if isinstance(dynamics, GymMountainCar):
        slowest, fastest = box(dynamics.max_speed)
        low = [dynamics.min_position, slowest]
        bounds = low, [dynamics.max_position, fastest]
    return dict(
        initial_state=UniformState([-0.6, 0.0], [-0.4, 0.0]),
        control_bounds=(-1.0, 1.0),
        terminated=goal,
        observation_bounds=bounds,
    )


def acrobot_features(x: State) -> Vector:
    """Cosine and sine of both angles, and the velocities."""
    return jnp.stack([cos(x[0]), sin(x[0]), cos(x[1]), sin(x[1]), x[2], x[3]])


class _AboveLine(eqx.Module):
    """Whether the tip is above a line, with links of length 1."""

    goal_height: Real = parameter()

    def __call__(self, t: Time, x: State) -> BoolScalar:
        return -cos(x[0]) - cos(x[1] + x[0]) > self.goal_height


@task(Acrobot, gym=GymAcrobot, dt=0.2, horizon=500)
def acrobot(
    dynamics: GymAcrobot | Discretized,
    *,
    max_torque: Limit = 1.0,
    torque_noise: Limit | None = None,
    goal_height: Number = 1.0,
    disturbance: AbstractDisturbance | None = None,
) -> Fields:
    """Swing the tip of two hanging links above a line, by a torque at the elbow.

    State (angle_1, angle_2, velocity_1, velocity_2), hanging at 0; control (torque);
    disturbance (push), a torque that is added; the integer actions 0, 1, 2 are the
    torques -1, 0, 1. Starts with each state uniform in +-0.1. A step costs 1; the
    episode ends when `-cos(angle_1) - cos(angle_1 + angle_2) > goal_height`, which
    takes 1 off the cost: Gym rewards the last step with 0. `encode` gives the cosine
    and the sine of both angles, and the velocities.

    That cost has no gradient. For planning and policy gradients give
    `cost=`[`delucax.costs.AcrobotHeight`][]`()` and `terminated=None`, and a `solver`
    for dynamics without wraps and clips: Gym's are not smooth where a velocity meets
    its limit, and the state, though not the gradient, jumps where an angle wraps.

    A step is Gym's to rounding. The acrobot is chaotic, so that of 100 episodes under
    random actions about 5 end more than 1e-6 from Gym's in double precision, as Gym's
    own do when the initial state is perturbed by one ulp.

    **Arguments:**

    - `max_torque`: 1 by default.
    - `torque_noise`: at each step a torque drawn uniformly from +-torque_noise is
        added, beyond the bounds too, as by Gym's `torque_noise_max`; none by default.
        Not with a `disturbance`.
    - `goal_height`: of the line above the first joint, in lengths of a link, 1 by
        default.
    - `disturbance`: of the environment, in place of `torque_noise`; none by default.
    - `max_velocity_1`, `max_velocity_2`: of Gym's integrator, 4 pi and 9 pi by default.

    Source: Gymnasium (Towers et al., 2023), `Acrobot-v1`; Sutton, 1996.

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp

        env = dlx.environments.acrobot()
        env.step(0.0, jnp.array([0.1, 0.0, 0.0, 0.0]), 2)
        smooth = dlx.make(
            "acrobot",
            solver=dlx.dynamics.RK4(),
            cost=dlx.costs.AcrobotHeight(),
            terminated=None,
        )
        ```
    """
    # A disturbance of the user's may drive the features beyond their bounds.
    bounded = disturbance is None
    if torque_noise is not None:
        if not bounded:
            raise ValueError("acrobot: give torque_noise or a disturbance, not both.")
        disturbance = Uniform(-torque_noise, torque_noise, size=1)
    fastest = np.inf, np.inf
    if isinstance(dynamics, GymAcrobot):
        fastest = dynamics.max_velocity_1, dynamics.max_velocity_2
    feature_bound = [1.0, 1.0, 1.0, 1.0, *fastest]
    above = _AboveLine(goal_height)
    return dict(
        cost=Arrival(above, arrival_cost=-1.0),
        disturbance=disturbance,
        initial_state=UniformState([-0.1] * 4, [0.1] * 4),
        control_bounds=(-max_torque, max_torque),
        terminated=above,
        actions=[[-max_torque], [0.0], [max_torque]],
        encode=acrobot_features,
        observation_bounds=box(feature_bound) if bounded else None,
    )
