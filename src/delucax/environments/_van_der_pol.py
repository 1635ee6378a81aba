"""Stop van der Pol's oscillator."""

from typing import Any

from .._check import check_range
from ..costs import Quadratic
from ..systems import VanDerPol
from ._task import task
from ._uniform_state import UniformState


@task(VanDerPol, dt=0.05, horizon=200)
def van_der_pol(system: VanDerPol, *, max_control: Any = 3.0) -> dict[str, Any]:
    """Bring van der Pol's oscillator from its limit cycle to rest.

    State (x, v); control (u). Starts with each state uniform in +-2. Cost
    `|x|^2 + 0.1 u^2` a step. Never terminates.

    **Arguments:**

    - `system`: a [`delucax.systems.VanDerPol`][]; made of `others` by default.
    - `max_control`: 3 by default.
    - `dt`: the control interval, 0.05 by default.
    - `horizon`: steps an episode, 200 by default.
    - `solver`: a Diffrax solver, [`delucax.dynamics.RK4`][] by default.
    - `substeps`: solver steps an interval, 1 by default.
    - `**others`: arguments of [`delucax.systems.VanDerPol`][] or
        [`delucax.Environment`][], such as `disturbance`.

    **Returns:** an [`delucax.Environment`][].

    **Raises:** `ValueError` on illegal numbers, or on arguments of a system beside one.

    Source: van der Pol, 1926.

    !!! example

        ```python
        import delucax as dlx

        env = dlx.make("van_der_pol", mu=2.0)
        ```
    """
    check_range(max_control, "max_control", "van_der_pol")
    return dict(
        cost=Quadratic([1.0, 1.0], [0.1]),
        initial_state=UniformState([-2.0, -2.0], [2.0, 2.0]),
        control_bounds=(-max_control, max_control),
    )
