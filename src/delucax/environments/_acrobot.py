"""Swing the tip of a two-link arm above a line: Gym's Acrobot-v1."""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from .._check import check_number, check_range
from .._module import parameter, positive
from .._results import Result, RESULTS
from .._typing import BoolScalar, Control, Disturbance, State, Time, Vector
from ..costs import Arrival
from ..disturbances import AbstractDisturbance, Uniform
from ..dynamics import AbstractDiscretization, Discretized, RK4
from ..dynamics._runge_kutta import runge_kutta_step
from ..math import clip, cos, sin, wrap
from ..systems import Acrobot
from ._task import task
from ._uniform_state import UniformState


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
) -> dict[str, Any]:
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
