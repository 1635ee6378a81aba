"""Keep a car in its lane, by its geometry."""

from typing import Any

from ..systems import KinematicBicycle
from ._lane import lane_keeping
from ._task import task


@task(KinematicBicycle, dt=0.05, horizon=100)
def kinematic_bicycle(
    system: KinematicBicycle,
    *,
    speed: Any = 10.0,
    max_acceleration: Any = 3.0,
    max_steering: Any = 0.5,
) -> dict[str, Any]:
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
    return lane_keeping(where, spread, speed, max_acceleration, max_steering)
