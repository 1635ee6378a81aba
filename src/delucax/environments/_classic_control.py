"""Gym's classic control: Pendulum-v1, CartPole-v1, Acrobot-v1, two mountain cars."""

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
    r"""Swing up a pendulum and hold it upright, with a torque that is too weak to lift
    it without swinging.

    - *State:* angle [rad], 0 upright; velocity [rad/s]. *Control:* torque [N m].
    - *Start:* the angle uniform over the circle, the velocity in +-1 rad/s.
    - *Cost:* `wrap(angle)^2 + 0.1 velocity^2 + 0.001 torque^2` per step.
    - *End:* never terminates.
    - *Features:* `encode` gives the cosine and sine of the angle, and the velocity.

    The dynamics are not smooth where the speed reaches the speed limit of Gym's
    integrator. Pass a `solver` for smooth dynamics. The slope of the cost jumps where
    the pendulum hangs straight down.

    **Arguments:**

    - `max_torque`: the largest absolute value of the torque [N m], 2 by default.
    - `max_speed`: the speed limit of Gym's integrator [rad/s], 8 by default.

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
    r"""Keep a pole upright on a cart that a force pushes back and forth.

    - *State:* position [m], velocity [m/s], angle [rad], 0 upright; spin [rad/s].
        *Control:* force [N], continuous within its bounds. The integer actions 0 and 1
        are Gym's forces -10 and 10.
    - *Start:* each state is uniformly random in +-0.05.
    - *Cost:* -1 per step.
    - *End:* when the position or the angle leaves its bounds.

    The dynamics are smooth. The cost has no gradient: for planning and policy
    gradients, pass a [`delucax.costs.Quadratic`][] as `cost`. The linear model about
    the upright pole is `dlx.linearize(env.dynamics)`.

    **Arguments:**

    - `max_force`: the largest absolute value of the force [N], 10 by default.
    - `max_position`: the distance from the centre to an end of the track [m], 2.4 by
        default.
    - `max_angle`: the angle at which the pole counts as fallen [rad], 12 degrees by
        default.
    - `semi_implicit`: whether to use Gym's semi-implicit integrator, which updates the
        positions with the new velocities. The default, false, uses Gym's explicit Euler
        step.

    Source: Gymnasium (Towers et al., 2023), `CartPole-v1`; Barto, Sutton and Anderson,
    1983.

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp

        env = dlx.environments.cartpole(half_length=0.6)
        smooth = dlx.make("cartpole", cost=dlx.costs.Quadratic(jnp.eye(4), jnp.eye(1)))
        lqr = dlx.controllers.LQR(dlx.linearize(env.dynamics), jnp.eye(4), jnp.eye(1))
        env.step(0.0, jnp.zeros(4), 1).state
        ```

        ```text
        Array([ 0.   ,  0.195,  0.   , -0.244], dtype=float32)
        ```
    """
    # Gym's bounds: twice those that end the episode, so that no state reaches them.
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
    r"""Rock a car back and forth to leave a valley: Gym's MountainCarContinuous-v0.

    - *State:* position, velocity [1/step]. *Control:* push, in +-1.
    - *Start:* at rest, with the position uniformly random in [-0.6, -0.4].
    - *Cost:* `0.1 push^2` per step, and -100 on arrival at the goal. The push in this
        cost is the push after clipping, whereas Gym uses the push before clipping.
    - *End:* at the goal.

    The arrival has no gradient. For planning and policy gradients, pass a
    [`delucax.costs.Quadratic`][] with the goal as `state_target`, `terminated=None`,
    and a `solver` in place of Gym's integrator, which has walls and speed limits.

    **Arguments:**

    - `goal_position`: 0.45 by default.
    - `goal_velocity`: the smallest velocity with which the car must reach the goal
        [1/step], 0 by default.
    - `max_speed`: the speed limit of Gym's integrator [1/step], 0.07 by default.
    - `min_position`, `max_position`: the positions of the walls in Gym's integrator,
        -1.2 and 0.6 by default. The car stops at the left wall.

    Source: Gymnasium (Towers et al., 2023), `MountainCarContinuous-v0`; Moore, 1990.

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp

        env = dlx.environments.mountain_car(power=0.002)
        cost = dlx.costs.Quadratic([1.0, 0.0], [0.1], state_target=[0.45, 0.0])
        options = dict(solver=dlx.dynamics.RK4(), cost=cost, terminated=None)
        smooth = dlx.make("mountain_car", **options)
        smooth.step(0.0, jnp.array([-0.5, 0.0]), jnp.ones(1)).cost
        ```

        ```text
        Array(1.0025, dtype=float32)
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
    r"""Drive a car out of a valley in the fewest steps: Gym's MountainCar-v0.

    The task differs from [`delucax.environments.mountain_car`][] in a weaker motor, a
    farther goal and the cost:

    - *Control:* the integer actions 0, 1 and 2 are the pushes -1, 0 and 1. A push in
        between works too.
    - *Cost:* 1 per step, also for the last step, and no final cost on arrival.

    The cost has no gradient. See [`delucax.environments.mountain_car`][] for smooth
    alternatives.

    **Arguments:**

    - `power`: power of the motor [1/step^2], 0.001 by default.
    - `goal_position`: 0.5 by default.
    - `goal_velocity`: the smallest velocity with which the car must reach the goal
        [1/step], 0 by default.

    Source: Gymnasium (Towers et al., 2023), `MountainCar-v0`; Moore, 1990.

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp

        env = dlx.environments.mountain_car_discrete()
        env.step(0.0, jnp.array([-0.5, 0.0]), 2).control
        ```

        ```text
        Array([1.], dtype=float32)
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
    """Whether the tip is above a line, if both links have length 1, as in Gym."""

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
    r"""Swing the tip of two hanging links above a given height, with a torque at the
    elbow.

    - *State:* angle_1 [rad], angle_2 [rad], both 0 when the links hang straight down;
        velocity_1 [rad/s], velocity_2 [rad/s]. *Control:* torque [N m]; the integer
        actions 0, 1 and 2 are the torques -1, 0 and 1. *Disturbance:* push [N m], added
        to the torque.
    - *Start:* each state is uniformly random in +-0.1.
    - *Cost:* 1 per step, and a final cost of -1 on arrival. So the last step costs
        nothing, as in Gym.
    - *End:* when `-cos(angle_1) - cos(angle_1 + angle_2) > goal_height`.
    - *Features:* `encode` gives the cosines and sines of both angles, and the
        velocities.

    The cost has no gradient. For planning and policy gradients, pass
    `cost=`[`delucax.costs.AcrobotHeight`][]`()`, `terminated=None`, and a `solver` in
    place of Gym's integrator, which wraps angles and clips velocities. Gym's dynamics
    are not smooth where a velocity reaches its limit. When an angle is wrapped, the
    state jumps, but the gradient does not.

    A step has the same result as a step of Gym up to rounding. But the acrobot is
    chaotic, so the rounding errors grow. Of 100 episodes with random actions in double
    precision, about 5 end more than 1e-6 away from the same episodes in Gym.
    Differences of this size also arise in Gym itself if the last bit of the initial
    state is changed.

    **Arguments:**

    - `max_torque`: the largest absolute value of the torque [N m], 1 by default.
    - `torque_noise`: the largest absolute value of a random torque [N m], like Gym's
        `torque_noise_max`; none by default. At each step, a torque is drawn uniformly
        from +-`torque_noise` and added to the control after clipping. Do not combine
        `torque_noise` with a `disturbance`.
    - `goal_height`: height above the first joint that the tip must exceed, in lengths
        of a link; 1 by default.
    - `disturbance`: the disturbance of the environment, in place of `torque_noise`;
        none by default.
    - `max_velocity_1`, `max_velocity_2`: the velocity limits of Gym's integrator
        [rad/s], 4 pi and 9 pi by default.

    Source: Gymnasium (Towers et al., 2023), `Acrobot-v1`; Sutton, 1996.

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp

        env = dlx.environments.acrobot()
        options = dict(cost=dlx.costs.AcrobotHeight(), terminated=None)
        smooth = dlx.make("acrobot", solver=dlx.dynamics.RK4(), **options)
        env.step(0.0, jnp.array([0.1, 0.0, 0.0, 0.0]), 2).state
        ```

        ```text
        Array([ 0.075,  0.043, -0.247,  0.423], dtype=float32)
        ```
    """
    # A user's disturbance may drive the features beyond their bounds.
    bounded = disturbance is None
    if torque_noise is not None:
        if not bounded:
            raise ValueError("acrobot: pass torque_noise or a disturbance, not both.")
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
