"""Keep a car in its lane, by the forces of its tyres."""

from typing import Any

import diffrax
import jax.numpy as jnp

from .._check import check_number, check_range
from ..dynamics import Discretized
from ..systems import DynamicBicycle
from ._environment import Environment, UniformState
from ._lane import bicycle_features, lane_bounds, lane_cost
from ._registry import finish


def dynamic_bicycle(
    mass: Any = 1573.0,
    inertia: Any = 2873.0,
    front: Any = 1.1,
    rear: Any = 1.58,
    front_stiffness: Any = 160000.0,
    rear_stiffness: Any = 160000.0,
    standstill: Any = 1.0,
    *,
    speed: Any = 20.0,
    dt: Any = 0.05,
    horizon: int = 100,
    max_acceleration: Any = 5.0,
    max_steering: Any = 0.2,
    solver: diffrax.AbstractSolver | None = None,
    substeps: int = 5,
    **environment: Any,
) -> Environment:
    """Bring a fast car on tyres to the lane y = 0, and to a speed.

    State (x, y, heading, vx, vy, rate); control (acceleration, steering). Starts at
    x = 0 with y uniform in +-2 m, the heading in +-0.1 rad, vx within 5 m/s of the
    speed to hold, vy in +-0.5 m/s and the rate in +-0.2 rad/s. Cost
    `y^2 + heading^2 + 0.1 ((vx - speed*)^2 + vy^2 + rate^2) + 0.1 acceleration^2 +
    steering^2` a step, the heading wrapped. `encode` gives its cosine and sine. Never
    terminates.

    **Arguments:**

    - `mass`, `inertia`, `front`, `rear`, `front_stiffness`, `rear_stiffness`,
        `standstill`: of [`delucax.systems.DynamicBicycle`][].
    - `speed`: to hold [m/s], 20 by default.
    - `max_acceleration`: and least, with a minus [m/s^2]; 5 by default.
    - `max_steering`: to either side [rad], 0.2 by default.
    - `dt`: the control interval, 0.05 by default.
    - `horizon`: steps an episode, 100 by default.
    - `solver`: a Diffrax solver, [`delucax.dynamics.RK4`][] by default.
    - `substeps`: solver steps an interval, 5 by default.
    - `**environment`: other arguments of [`delucax.Environment`][], such as
        `disturbance`.

    **Returns:** an [`delucax.Environment`][].

    **Raises:** `ValueError` on illegal numbers.

    Source: Rajamani, 2012.

    !!! example

        ```python
        import delucax as dlx

        icy = dlx.make("dynamic_bicycle", front_stiffness=3e4, rear_stiffness=3e4)
        ```
    """
    check_number(speed, "speed", "dynamic_bicycle")
    check_range(max_acceleration, "max_acceleration", "dynamic_bicycle")
    check_range(max_steering, "max_steering", "dynamic_bicycle")
    system = DynamicBicycle(
        mass, inertia, front, rear, front_stiffness, rear_stiffness, standstill
    )
    corner = jnp.array([0.0, 2.0, 0.1, 5.0, 0.5, 0.2])
    middle = jnp.zeros(6).at[3].set(speed)
    limit = jnp.stack([jnp.asarray(max_acceleration), jnp.asarray(max_steering)])
    arguments: dict[str, Any] = dict(
        dynamics=Discretized(system, dt, solver, substeps),
        cost=lane_cost(speed, 6),
        initial_state=UniformState(middle - corner, middle + corner),
        control_bounds=(-limit, limit),
        horizon=horizon,
        encode=bicycle_features,
        observation_bounds=lane_bounds(6),
    )
    return finish(dynamic_bicycle, arguments, environment)
