"""Bring a mass on a line to rest at the origin."""

from typing import Any

from .._check import check_range
from ..costs import Quadratic
from ..systems import DoubleIntegrator
from ._task import task
from ._uniform_state import UniformState


@task(DoubleIntegrator, dt=0.1, horizon=100)
def double_integrator(
    system: DoubleIntegrator, *, max_force: Any = 1.0
) -> dict[str, Any]:
    """Bring a mass on a line to rest at the origin.

    State (position, velocity); control (force). Starts with the position uniform in
    +-2 and the velocity in +-1. Cost `|x|^2 + 0.1 force^2` a step. Never terminates.

    **Arguments:**

    - `system`: a [`delucax.systems.DoubleIntegrator`][]; made of `others` by default.
    - `max_force`: 1 by default.
    - `dt`: the control interval, 0.1 by default.
    - `horizon`: steps an episode, 100 by default.
    - `solver`: a Diffrax solver, [`delucax.dynamics.RK4`][] by default.
    - `substeps`: solver steps an interval, 1 by default.
    - `**others`: arguments of [`delucax.systems.DoubleIntegrator`][] or
        [`delucax.Environment`][], such as `disturbance`.

    **Returns:** an [`delucax.Environment`][].

    **Raises:** `ValueError` on illegal numbers, or on arguments of a system beside one.

    Source: Åström and Murray, 2008.

    !!! example

        ```python
        import delucax as dlx

        env = dlx.make("double_integrator", mass=2.0)
        ```
    """
    check_range(max_force, "max_force", "double_integrator")
    return dict(
        cost=Quadratic([1.0, 1.0], [0.1]),
        initial_state=UniformState([-2.0, -1.0], [2.0, 1.0]),
        control_bounds=(-max_force, max_force),
    )
