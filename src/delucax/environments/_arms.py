"""Tasks of arms of two links: Gym's Acrobot-v1, and the paper's reacher."""

from collections.abc import Sequence

import diffrax
import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import ArrayLike

from .._check import as_vector, check_finite, LARGEST
from .._module import parameter
from .._typing import BoolScalar, Control, Real, Scalar, State, Time, Vector
from ..costs import AbstractCost, Arrival
from ..disturbances import AbstractDisturbance, Uniform
from ..dynamics import Discretized
from ..math import cos, sin
from ..systems import Acrobot, Reacher
from ._gym import GymAcrobot
from ._task import Fields, Limit, Number, task, UniformState


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
    own do when they start at the next floating-point number.

    **Arguments:**

    - `max_torque`: 1 by default.
    - `torque_noise`: at each step a torque drawn uniformly from +-torque_noise is
        added, beyond the bounds too, as by Gym's `torque_noise_max`; none by default.
        Not with a `disturbance`.
    - `goal_height`: of the line above the first joint, in lengths of a link, 1 by
        default.
    - `disturbance`: of the environment, in place of `torque_noise`; none by default.
    - `max_velocity_1`, `max_velocity_2`: of Gym's arithmetic, 4 pi and 9 pi by default.

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
    bounded = disturbance is None
    if torque_noise is not None:
        if not bounded:
            raise ValueError("acrobot: give torque_noise or a disturbance, not both.")
        disturbance = Uniform(-torque_noise, torque_noise, size=1)
    fastest = np.inf, np.inf
    if isinstance(dynamics, GymAcrobot):
        fastest = dynamics.max_velocity_1, dynamics.max_velocity_2
    feature_bound = jnp.array([1.0, 1.0, 1.0, 1.0, *fastest])
    above = _AboveLine(goal_height)
    return dict(
        cost=Arrival(above, arrival_cost=-1.0),
        disturbance=disturbance,
        initial_state=UniformState([-0.1] * 4, [0.1] * 4),
        control_bounds=(-max_torque, max_torque),
        terminated=above,
        actions=max_torque * jnp.array([[-1.0], [0.0], [1.0]]),
        encode=acrobot_features,
        observation_bounds=(-feature_bound, feature_bound) if bounded else None,
    )


class ReacherCost(AbstractCost):
    """`|tip - goal|^2 + torque_weight |torques|^2`."""

    system: Reacher
    goal: Real = parameter()
    torque_weight: Real = parameter(0.1)

    def __check_init__(self):
        as_vector(self.goal, 2, "goal", "ReacherCost")
        check_finite(self.goal, "goal", "ReacherCost")

    def offset(self, x: State) -> Vector:
        """Where the tip is, relative to the goal."""
        return self.system.tip(x) - self.goal.astype(x.dtype)

    def __call__(self, t: Time, x: State, u: Control) -> Scalar:
        offset = self.offset(x)
        effort = self.torque_weight * (u[0] * u[0] + u[1] * u[1])
        return offset[0] * offset[0] + offset[1] * offset[1] + effort


class _Features(eqx.Module):
    """Cosines and sines of the angles, the rates, and the offset of the tip."""

    cost: ReacherCost

    def __call__(self, x: State) -> Vector:
        offset = self.cost.offset(x)
        angles = [cos(x[0]), sin(x[0]), cos(x[1]), sin(x[1])]
        return jnp.stack([*angles, x[2], x[3], offset[0], offset[1]])


@task(Reacher, dt=0.01, horizon=200, solver=diffrax.Euler())
def reacher(
    system: Reacher, *, goal: ArrayLike | Sequence[float] = (0.0, 1.8)
) -> Fields:
    """Bring the tip of an arm of two links to a goal.

    State (shoulder, elbow, shoulder_rate, elbow_rate); control (shoulder_torque,
    elbow_torque), without bounds. Starts at rest at the angles (pi/4, pi/2). Cost
    `|tip - goal|^2 + 0.1 |torques|^2` a step. `encode` gives cosines and sines of the
    angles, the rates and `tip - goal`. Explicit Euler, as in the paper. Never
    terminates.

    The cost and `encode` hold the arm too: for arms of other lengths call this again,
    under `jax.vmap` for many, where `delucax.replace` would change one of the three.

    **Arguments:**

    - `goal`: shape `(2,)` [m]; (0, 1.8) by default.

    Source: Gradu, Hallman, Suo, Yu, Agarwal, Ghai, Singh, Zhang, Majumdar and Hazan,
    2021 (Deluca).

    !!! example

        ```python
        import delucax as dlx

        model = dlx.make("reacher")
        plant = dlx.make("reacher", gravity=-10.0)
        ```
    """
    cost = ReacherCost(system, goal)
    reach = system.length_1 + system.length_2
    low, high = (
        jnp.array([sign] * 4 + [sign * LARGEST] * 2 + [*(sign * reach - cost.goal)])
        for sign in (-1.0, 1.0)
    )
    return dict(
        cost=cost,
        initial_state=jnp.array([np.pi / 4, np.pi / 2, 0.0, 0.0]),
        encode=_Features(cost),
        observation_bounds=(low, high),
    )
