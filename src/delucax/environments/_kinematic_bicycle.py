"""Keep a car in its lane, by its geometry."""

from typing import Any

import diffrax

from ..dynamics import Discretized
from ..systems import KinematicBicycle
from ._environment import Environment
from ._lane import lane_task
from ._task import system_of


def kinematic_bicycle(
    system: KinematicBicycle | None = None,
    *,
    speed: Any = 10.0,
    dt: Any = 0.05,
    horizon: int = 100,
    max_acceleration: Any = 3.0,
    max_steering: Any = 0.5,
    solver: diffrax.AbstractSolver | None = None,
    substeps: int = 1,
    **others: Any,
) -> Environment:
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
    system, others = system_of(kinematic_bicycle, KinematicBicycle, system, others)
    return lane_task(
        kinematic_bicycle,
        Discretized(system, dt, solver, substeps),
        others,
        spread=[0.0, 2.0, 0.3, 3.0],
        speed=speed,
        max_acceleration=max_acceleration,
        max_steering=max_steering,
        horizon=horizon,
    )
