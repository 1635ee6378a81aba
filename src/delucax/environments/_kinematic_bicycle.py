"""Keep a car in its lane, by its geometry."""

from typing import Any

import diffrax
import jax.numpy as jnp

from .._check import check_number, check_range
from ..dynamics import Discretized
from ..systems import KinematicBicycle
from ._environment import Environment, UniformState
from ._lane import bicycle_features, lane_bounds, lane_cost
from ._registry import finish


def kinematic_bicycle(
    front: Any = 1.105,
    rear: Any = 1.738,
    *,
    speed: Any = 10.0,
    dt: Any = 0.05,
    horizon: int = 100,
    max_acceleration: Any = 3.0,
    max_steering: Any = 0.5,
    solver: diffrax.AbstractSolver | None = None,
    substeps: int = 1,
    **environment: Any,
) -> Environment:
    """Bring a car that rolls without slip to the lane y = 0, and to a speed.

    State (x, y, heading, speed); control (acceleration, steering). Starts at x = 0 with
    y uniform in +-2 m, the heading in +-0.3 rad and the speed within 3 m/s of the one
    to hold. Cost
    `y^2 + heading^2 + 0.1 (speed - speed*)^2 + 0.1 acceleration^2 + steering^2` a step,
    the heading wrapped. `encode` gives its cosine and sine. Never terminates.

    **Arguments:**

    - `front`, `rear`: of [`delucax.systems.KinematicBicycle`][].
    - `speed`: to hold [m/s], 10 by default.
    - `max_acceleration`: and least, with a minus [m/s^2]; 3 by default.
    - `max_steering`: to either side [rad], 0.5 by default.
    - `dt`: the control interval, 0.05 by default.
    - `horizon`: steps an episode, 100 by default.
    - `solver`: a Diffrax solver, [`delucax.dynamics.RK4`][] by default.
    - `substeps`: solver steps an interval, 1 by default.
    - `**environment`: other arguments of [`delucax.Environment`][], such as
        `disturbance`.

    **Returns:** an [`delucax.Environment`][].

    **Raises:** `ValueError` on illegal numbers.

    Source: Kong, Pfeiffer, Schildbach and Borrelli, 2015.

    !!! example

        ```python
        import delucax as dlx

        env = dlx.make("kinematic_bicycle", speed=5.0)
        ```
    """
    check_number(speed, "speed", "kinematic_bicycle")
    check_range(max_acceleration, "max_acceleration", "kinematic_bicycle")
    check_range(max_steering, "max_steering", "kinematic_bicycle")
    corner = jnp.array([0.0, 2.0, 0.3, 3.0])
    middle = jnp.zeros(4).at[3].set(speed)
    limit = jnp.stack([jnp.asarray(max_acceleration), jnp.asarray(max_steering)])
    arguments: dict[str, Any] = dict(
        dynamics=Discretized(KinematicBicycle(front, rear), dt, solver, substeps),
        cost=lane_cost(speed, 4),
        initial_state=UniformState(middle - corner, middle + corner),
        control_bounds=(-limit, limit),
        horizon=horizon,
        encode=bicycle_features,
        observation_bounds=lane_bounds(4),
    )
    return finish(kinematic_bicycle, arguments, environment)
