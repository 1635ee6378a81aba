"""Keep a car in its lane, by the forces of its tyres."""

from typing import Any

from ..systems import DynamicBicycle
from ._lane import lane_keeping
from ._task import task


@task(DynamicBicycle, dt=0.05, horizon=100, substeps=5)
def dynamic_bicycle(
    system: DynamicBicycle,
    *,
    speed: Any = 20.0,
    max_acceleration: Any = 5.0,
    max_steering: Any = 0.2,
) -> dict[str, Any]:
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
    return lane_keeping(where, spread, speed, max_acceleration, max_steering)
