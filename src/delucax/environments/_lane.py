"""Keep a car in its lane: the tasks of the two bicycles."""

from collections.abc import Sequence
from typing import Any

import jax.numpy as jnp

from .._check import check_number, check_range, LARGEST
from .._typing import State, Vector
from ..costs import Quadratic
from ..math import cos, sin, wrap
from ..systems import DynamicBicycle, KinematicBicycle
from ._task import Fields, task, UniformState


def bicycle_features(x: State) -> Vector:
    """The state of a car with the cosine and sine of the heading in its place.

    **Arguments:** `x`: the state of a [`delucax.systems.KinematicBicycle`][] or
        [`delucax.systems.DynamicBicycle`][].

    **Returns:** (x, y, cos(heading), sin(heading), the rest).

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp

        dlx.environments.bicycle_features(jnp.array([0.0, 1.0, 0.1, 10.0]))
        ```
    """
    turned = jnp.stack([x[0], x[1], cos(x[2]), sin(x[2])])
    return jnp.concatenate([turned, x[3:]])


def _lane_keeping(
    where: str,
    spread: Sequence[float],
    speed: Any,
    max_acceleration: Any,
    max_steering: Any,
) -> Fields:
    """What the task `where` of a bicycle adds, which starts within `spread` of driving
    along the lane.

    The cost is `y^2 + heading^2 + 0.1 (speed - speed*)^2`, 0.1 times the squares of
    what else moves, and `0.1 acceleration^2 + steering^2`. Of the features the cosine
    and the sine of the heading are bounded.
    """
    check_number(speed, "speed", where)
    check_range(max_acceleration, "max_acceleration", where)
    check_range(max_steering, "max_steering", where)
    states = len(spread)
    target = jnp.zeros(states).at[3].set(speed)
    corner = jnp.array(spread)
    limit = jnp.stack([jnp.asarray(max_acceleration), jnp.asarray(max_steering)])
    feature_bound = jnp.full(states + 1, LARGEST).at[2:4].set(1.0)
    return dict(
        cost=Quadratic(
            [0.0, 1.0, 1.0] + [0.1] * (states - 3),
            [0.1, 1.0],
            state_target=target,
            difference=heading_difference,
        ),
        initial_state=UniformState(target - corner, target + corner),
        control_bounds=(-limit, limit),
        encode=bicycle_features,
        observation_bounds=(-feature_bound, feature_bound),
    )


def heading_difference(x: State, x_ref: State) -> State:
    """`x - x_ref` with the heading wrapped."""
    d = x - x_ref
    rest = [d[i] for i in range(3, x.shape[0])]
    return jnp.stack([d[0], d[1], wrap(d[2]), *rest])


@task(KinematicBicycle, dt=0.05, horizon=100)
def kinematic_bicycle(
    system: KinematicBicycle,
    *,
    speed: Any = 10.0,
    max_acceleration: Any = 3.0,
    max_steering: Any = 0.5,
) -> Fields:
    """Bring a car that rolls without slip to the lane y = 0, and to a speed.

    State (x, y, heading, speed); control (acceleration, steering). Starts at x = 0 with
    y uniform in +-2 m, the heading in +-0.3 rad and the speed within 3 m/s of the one
    to hold. Cost
    `y^2 + heading^2 + 0.1 (speed - speed*)^2 + 0.1 acceleration^2 + steering^2` a step,
    the heading wrapped. `encode` gives its cosine and sine. Never terminates.

    **Arguments:**

    - `system`: a [`delucax.systems.KinematicBicycle`][]; made of `others` by default.
    - `speed`: to hold [m/s], 10 by default.
    - `max_acceleration`: and least, with a minus [m/s^2]; 3 by default.
    - `max_steering`: to either side [rad], 0.5 by default.
    - `dt`: the control interval, 0.05 by default.
    - `horizon`: steps an episode, 100 by default.
    - `solver`: a Diffrax solver, [`delucax.dynamics.RK4`][] by default.
    - `substeps`: solver steps an interval, 1 by default.
    - `**others`: arguments of [`delucax.systems.KinematicBicycle`][] or
        [`delucax.Environment`][], such as `disturbance`.

    **Returns:** an [`delucax.Environment`][].

    **Raises:** `ValueError` on illegal numbers, or on arguments of a system beside one.

    Source: Kong, Pfeiffer, Schildbach and Borrelli, 2015.

    !!! example

        ```python
        import delucax as dlx

        env = dlx.make("kinematic_bicycle", speed=5.0)
        ```
    """
    where, spread = "kinematic_bicycle", [0.0, 2.0, 0.3, 3.0]
    return _lane_keeping(where, spread, speed, max_acceleration, max_steering)


@task(DynamicBicycle, dt=0.05, horizon=100, substeps=5)
def dynamic_bicycle(
    system: DynamicBicycle,
    *,
    speed: Any = 20.0,
    max_acceleration: Any = 5.0,
    max_steering: Any = 0.2,
) -> Fields:
    """Bring a fast car on tyres to the lane y = 0, and to a speed.

    State (x, y, heading, vx, vy, rate); control (acceleration, steering). Starts at
    x = 0 with y uniform in +-2 m, the heading in +-0.1 rad, vx within 5 m/s of the
    speed to hold, vy in +-0.5 m/s and the rate in +-0.2 rad/s. Cost
    `y^2 + heading^2 + 0.1 ((vx - speed*)^2 + vy^2 + rate^2) + 0.1 acceleration^2 +
    steering^2` a step, the heading wrapped. `encode` gives its cosine and sine. Never
    terminates.

    **Arguments:**

    - `system`: a [`delucax.systems.DynamicBicycle`][]; made of `others` by default.
    - `speed`: to hold [m/s], 20 by default.
    - `max_acceleration`: and least, with a minus [m/s^2]; 5 by default.
    - `max_steering`: to either side [rad], 0.2 by default.
    - `dt`: the control interval, 0.05 by default.
    - `horizon`: steps an episode, 100 by default.
    - `solver`: a Diffrax solver, [`delucax.dynamics.RK4`][] by default.
    - `substeps`: solver steps an interval, 5 by default.
    - `**others`: arguments of [`delucax.systems.DynamicBicycle`][] or
        [`delucax.Environment`][], such as `disturbance`.

    **Returns:** an [`delucax.Environment`][].

    **Raises:** `ValueError` on illegal numbers, or on arguments of a system beside one.

    Source: Rajamani, 2012.

    !!! example

        ```python
        import delucax as dlx

        icy = dlx.make("dynamic_bicycle", front_stiffness=3e4, rear_stiffness=3e4)
        ```
    """
    where, spread = "dynamic_bicycle", [0.0, 2.0, 0.1, 5.0, 0.5, 0.2]
    return _lane_keeping(where, spread, speed, max_acceleration, max_steering)
