"""Stop van der Pol's oscillator."""

from typing import Any

import diffrax
import jax.numpy as jnp

from .._check import check_range
from ..costs import Quadratic
from ..dynamics import Discretized
from ..systems import VanDerPol
from ._environment import Environment
from ._task import system_of, task_environment
from ._uniform_state import UniformState


def van_der_pol(
    system: VanDerPol | None = None,
    *,
    dt: Any = 0.05,
    horizon: int = 200,
    max_control: Any = 3.0,
    solver: diffrax.AbstractSolver | None = None,
    substeps: int = 1,
    **others: Any,
) -> Environment:
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
    system, others = system_of(van_der_pol, VanDerPol, system, others)
    corner = jnp.full(2, 2.0)
    return task_environment(
        others,
        dynamics=Discretized(system, dt, solver, substeps),
        cost=Quadratic(jnp.ones(2), 0.1 * jnp.ones(1)),
        initial_state=UniformState(-corner, corner),
        control_bounds=(-max_control, max_control),
        horizon=horizon,
    )
