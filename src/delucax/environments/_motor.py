"""Run a synchronous motor at a speed."""

from typing import Any

from .._check import check_number, check_range
from ..costs import Quadratic
from ..systems import PermanentMagnetMotor
from ._task import task
from ._uniform_state import UniformState


@task(PermanentMagnetMotor, dt=0.0005, horizon=200)
def permanent_magnet_motor(
    system: PermanentMagnetMotor, *, speed: Any = 100.0, max_voltage: Any = 150.0
) -> dict[str, Any]:
    """Bring a synchronous motor to a speed and hold it.

    State (i_d, i_q, speed); control (v_d, v_q), each within +-max_voltage; disturbance
    (load). Starts with the currents uniform in +-1 A and the speed in +-50 rad/s. Cost
    `0.01 (di_d^2 + di_q^2) + 0.001 dspeed^2 + 1e-5 |dv|^2` a step, each measured from
    what holds the speed without load. Never terminates.

    **Arguments:**

    - `system`: a [`delucax.systems.PermanentMagnetMotor`][]; made of `others` by
        default.
    - `speed`: to hold [rad/s], 100 by default.
    - `max_voltage`: 150 by default.
    - `dt`: the control interval, 0.0005 by default.
    - `horizon`: steps an episode, 200 by default.
    - `solver`: a Diffrax solver, [`delucax.dynamics.RK4`][] by default.
    - `substeps`: solver steps an interval, 1 by default.
    - `**others`: arguments of [`delucax.systems.PermanentMagnetMotor`][] or
        [`delucax.Environment`][], such as `disturbance`.

    **Returns:** an [`delucax.Environment`][].

    **Raises:** `ValueError` on illegal numbers, or on arguments of a system beside one.

    Source: Krause, Wasynczuk and Sudhoff, 2002.

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp

        load = dlx.disturbances.Constant(jnp.array([0.5]))
        env = dlx.make("permanent_magnet_motor", speed=80.0, disturbance=load)
        ```
    """
    check_number(speed, "speed", "permanent_magnet_motor")
    check_range(max_voltage, "max_voltage", "permanent_magnet_motor")
    x, u = system.equilibrium(speed)
    Q, R = [0.01, 0.01, 0.001], [1e-5, 1e-5]
    return dict(
        cost=Quadratic(Q, R, state_target=x, control_target=u),
        initial_state=UniformState([-1.0, -1.0, -50.0], [1.0, 1.0, 50.0]),
        control_bounds=(-max_voltage, max_voltage),
    )
