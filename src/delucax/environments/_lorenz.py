"""Stop the butterfly at the centre of a wing."""

from typing import Any

from .._check import check_range
from ..costs import Quadratic
from ..systems import Lorenz
from ._task import task
from ._uniform_state import UniformState


@task(Lorenz, dt=0.01, horizon=500)
def lorenz(system: Lorenz, *, max_control: Any = 50.0) -> dict[str, Any]:
    """Hold Lorenz's chaotic system at the centre of its right wing.

    State (x, y, z); control (u). Starts with x and y uniform in +-20 and z in [10, 40].
    Cost `|x - x*|^2 + 0.001 u^2` a step, x* being the equilibrium. Never terminates.

    **Arguments:**

    - `system`: a [`delucax.systems.Lorenz`][]; made of `others` by default.
    - `max_control`: 50 by default.
    - `dt`: the control interval, 0.01 by default.
    - `horizon`: steps an episode, 500 by default.
    - `solver`: a Diffrax solver, [`delucax.dynamics.RK4`][] by default.
    - `substeps`: solver steps an interval, 1 by default.
    - `**others`: arguments of [`delucax.systems.Lorenz`][] or
        [`delucax.Environment`][], such as `disturbance`.

    **Returns:** an [`delucax.Environment`][].

    **Raises:** `ValueError` on illegal numbers, or on arguments of a system beside one.

    Source: Lorenz, 1963; Kaiser, Kutz and Brunton, 2018.

    !!! example

        ```python
        import delucax as dlx

        env = dlx.make("lorenz", rho=24.0)
        ```
    """
    check_range(max_control, "max_control", "lorenz")
    centre, _ = system.equilibrium()
    return dict(
        cost=Quadratic([1.0, 1.0, 1.0], [0.001], state_target=centre),
        initial_state=UniformState([-20.0, -20.0, 10.0], [20.0, 20.0, 40.0]),
        control_bounds=(-max_control, max_control),
    )
