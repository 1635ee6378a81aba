"""Tasks of arms of two links: Gym's Acrobot-v1, and the paper's reacher."""

from typing import Any

import diffrax
import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from .._check import as_vector, check_finite, check_number, check_range, LARGEST
from .._module import parameter
from .._typing import BoolScalar, State, Time, Vector
from ..costs import AbstractCost, Arrival
from ..disturbances import AbstractDisturbance, Uniform
from ..dynamics import Discretized
from ..math import cos, sin
from ..systems import Acrobot, Reacher
from ._gym import GymAcrobot
from ._task import Fields, task, UniformState


def acrobot_features(x: State) -> Vector:
    """Cosine and sine of both angles, and the velocities: what Gymnasium users see.

    **Arguments:** `x`: (angle_1, angle_2, velocity_1, velocity_2).

    **Returns:** (cos(angle_1), sin(angle_1), cos(angle_2), sin(angle_2), velocity_1,
    velocity_2).

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp

        dlx.environments.acrobot_features(jnp.array([0.1, 0.0, 0.0, 0.0]))
        ```
    """
    return jnp.stack([cos(x[0]), sin(x[0]), cos(x[1]), sin(x[1]), x[2], x[3]])


class _AboveLine(eqx.Module):
    """Whether the tip is above a line, with links of length 1."""

    goal_height: Array = parameter()

    def __call__(self, t: Time, x: State) -> BoolScalar:
        return -cos(x[0]) - cos(x[1] + x[0]) > self.goal_height


@task(Acrobot, gym=GymAcrobot, dt=0.2, horizon=500)
def acrobot(
    dynamics: GymAcrobot | Discretized,
    *,
    max_torque: Any = 1.0,
    torque_noise: Any = None,
    goal_height: Any = 1.0,
    disturbance: AbstractDisturbance | None = None,
) -> Fields:
    """Swing the tip of two hanging links above a line, by a torque at the elbow.

    State (angle_1, angle_2, velocity_1, velocity_2), hanging at 0; control (torque);
    disturbance (push), a torque that is added; the integer actions 0, 1, 2 are the
    torques -1, 0, 1. Starts with each state uniform in +-0.1. A step costs 1; the
    episode ends when `-cos(angle_1) - cos(angle_1 + angle_2) > goal_height`, which
    takes 1 off the cost: Gym rewards the last step with 0.

    That cost has no gradient. For planning and policy gradients give
    `cost=`[`delucax.costs.AcrobotHeight`][]`()` and `terminated=None`, and a `solver`
    for dynamics without wraps and clips.

    **Arguments:**

    - `system`: a [`delucax.systems.Acrobot`][]; made of `others` by default.
    - `dt`: the control interval, 0.2 by default.
    - `horizon`: steps an episode, 500 by default.
    - `max_torque`: 1 by default.
    - `torque_noise`: at each step a torque drawn uniformly from +-torque_noise is
        added, beyond the bounds too, as by Gym's `torque_noise_max`; none by default.
    - `goal_height`: of the line above the first joint, in lengths of a link, 1 by
        default.
    - `disturbance`: of the environment, in place of `torque_noise`; none by default.
    - `solver`: a Diffrax solver in place of Gym's arithmetic; no angle is wrapped and
        no velocity clipped then.
    - `substeps`: solver steps an interval, with `solver`.
    - `**others`: arguments of [`delucax.systems.Acrobot`][], of
        [`delucax.environments.GymAcrobot`][], such as `max_velocity_1`, without a
        `solver`, or of [`delucax.Environment`][], such as `cost`.

    **Returns:** an [`delucax.Environment`][].

    **Raises:** `ValueError` on illegal numbers, `substeps` without `solver`, a
        velocity limit with it, or `torque_noise` with a `disturbance`.

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
    check_range(max_torque, "max_torque", "acrobot")
    check_number(goal_height, "goal_height", "acrobot")
    bounded = disturbance is None
    if torque_noise is not None:
        if disturbance is not None:
            raise ValueError("acrobot: give torque_noise or a disturbance, not both.")
        check_range(torque_noise, "torque_noise", "acrobot")
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
    """`|tip - goal|^2 + torque_weight |torques|^2`.

    **Arguments:**

    - `system`: the arm, for where its tip is.
    - `goal`: shape `(2,)` [m]; (0, 1.8) by default.
    - `torque_weight`: 0.1 by default.

    **Raises:** `ValueError` if the goal is not a finite vector of two.

    Source: Gradu, Hallman, Suo, Yu, Agarwal, Ghai, Singh, Zhang, Majumdar and Hazan,
    2021 (Deluca).

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp

        cost = dlx.environments.ReacherCost(dlx.systems.Reacher())
        cost(0.0, jnp.zeros(4), jnp.zeros(2))
        ```
    """

    system: Reacher
    goal: Array = parameter((0.0, 1.8))
    torque_weight: Array = parameter(0.1)

    def __check_init__(self):
        as_vector(self.goal, 2, "goal", "ReacherCost")
        check_finite(self.goal, "goal", "ReacherCost")

    def offset(self, x: Array) -> Array:
        """Where the tip is, relative to the goal.

        **Arguments:** `x`: state.

        **Returns:** `tip - goal`, shape `(2,)` [m].
        """
        return self.system.tip(x) - self.goal.astype(x.dtype)

    def __call__(self, t, x, u):
        offset = self.offset(x)
        effort = self.torque_weight * (u[0] * u[0] + u[1] * u[1])
        return offset[0] * offset[0] + offset[1] * offset[1] + effort


class _Features(eqx.Module):
    """Cosines and sines of the angles, the rates, and the offset of the tip."""

    cost: ReacherCost

    def __call__(self, x: Array) -> Array:
        offset = self.cost.offset(x)
        angles = [cos(x[0]), sin(x[0]), cos(x[1]), sin(x[1])]
        return jnp.stack([*angles, x[2], x[3], offset[0], offset[1]])


@task(Reacher, dt=0.01, horizon=200, solver=diffrax.Euler())
def reacher(system: Reacher, *, goal: Any = (0.0, 1.8)) -> Fields:
    """Bring the tip of an arm of two links to a goal.

    State (shoulder, elbow, shoulder_rate, elbow_rate); control (shoulder_torque,
    elbow_torque), without bounds. Starts at rest at the angles (pi/4, pi/2). Cost
    `|tip - goal|^2 + 0.1 |torques|^2` a step. `encode` gives cosines and sines of the
    angles, the rates and `tip - goal`. Explicit Euler, as in the paper. Never
    terminates.

    The cost and `encode` hold the arm too: for arms of other lengths call this again,
    under `jax.vmap` for many, where `delucax.replace` would change one of the three.

    **Arguments:**

    - `system`: a [`delucax.systems.Reacher`][]; made of `others` by default.
    - `goal`: shape `(2,)` [m]; (0, 1.8) by default.
    - `dt`: the control interval, 0.01 by default.
    - `horizon`: steps an episode, 200 by default.
    - `solver`: a Diffrax solver, `diffrax.Euler()` by default.
    - `substeps`: solver steps an interval, 1 by default.
    - `**others`: arguments of [`delucax.systems.Reacher`][] or
        [`delucax.Environment`][], such as `control_bounds`.

    **Returns:** an [`delucax.Environment`][].

    **Raises:** `ValueError` on illegal numbers, or a goal that is not a vector of two.

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
