"""Stop the butterfly at the centre of a wing."""

from typing import Any

import diffrax
import jax.numpy as jnp

from .._check import check_range
from ..costs import Quadratic
from ..dynamics import Discretized
from ..systems import Lorenz
from ._environment import Environment
from ._task import system_of, task_environment
from ._uniform_state import UniformState


def lorenz(
    system: Lorenz | None = None,
    *,
    dt: Any = 0.01,
    horizon: int = 500,
    max_control: Any = 50.0,
    solver: diffrax.AbstractSolver | None = None,
    substeps: int = 1,
    **others: Any,
) -> Environment:
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
    system, others = system_of(lorenz, Lorenz, system, others)
    centre, _ = system.equilibrium()
    low, high = jnp.array([-20.0, -20.0, 10.0]), jnp.array([20.0, 20.0, 40.0])
    return task_environment(
        others,
        dynamics=Discretized(system, dt, solver, substeps),
        cost=Quadratic(jnp.ones(3), 0.001 * jnp.ones(1), state_target=centre),
        initial_state=UniformState(low, high),
        control_bounds=(-max_control, max_control),
        horizon=horizon,
    )
