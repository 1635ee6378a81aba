"""Hold the level of a tank that is fed through another one."""

from typing import Any

from .._check import check_range
from ..costs import Quadratic
from ..systems import TwoTank
from ._task import task
from ._uniform_state import UniformState


@task(TwoTank, dt=2.0, horizon=200)
def two_tank(
    system: TwoTank, *, level: Any = 10.0, max_flow: Any = 30.0
) -> dict[str, Any]:
    """Hold the lower of two tanks at a level.

    State (upper, lower) [cm]; control (flow) [cm^3/s], not negative. Starts with the
    levels uniform in [0, 20]. Cost `(lower - level)^2 + 0.01 (flow - flow*)^2` a step,
    flow* being what holds the level. Never terminates.

    **Arguments:**

    - `system`: a [`delucax.systems.TwoTank`][]; made of `others` by default.
    - `level`: to hold [cm], 10 by default.
    - `max_flow`: of the pump, 30 by default.
    - `dt`: the control interval, 2 by default.
    - `horizon`: steps an episode, 200 by default.
    - `solver`: a Diffrax solver, [`delucax.dynamics.RK4`][] by default.
    - `substeps`: solver steps an interval, 1 by default.
    - `**others`: arguments of [`delucax.systems.TwoTank`][] or
        [`delucax.Environment`][], such as `disturbance`.

    **Returns:** an [`delucax.Environment`][].

    **Raises:** `ValueError` on illegal numbers, or on arguments of a system beside one.

    Source: Johansson, 2000.

    !!! example

        ```python
        import delucax as dlx

        env = dlx.make("two_tank", level=12.0)
        ```
    """
    check_range(max_flow, "max_flow", "two_tank")
    check_range(level, "level", "two_tank")
    x, u = system.equilibrium(level)
    return dict(
        cost=Quadratic([0.0, 1.0], [0.01], state_target=x, control_target=u),
        initial_state=UniformState([0.0, 0.0], [20.0, 20.0]),
        control_bounds=(0.0, max_flow),
    )
