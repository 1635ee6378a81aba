"""Stop the butterfly at the centre of a wing."""

from typing import Any

import diffrax
import jax.numpy as jnp

from .._check import check_range
from ..costs import Quadratic
from ..dynamics import Discretized
from ..systems import Lorenz
from ._environment import Environment, UniformState
from ._registry import finish


def lorenz(
    sigma: Any = 10.0,
    rho: Any = 28.0,
    beta: Any = 8.0 / 3.0,
    *,
    dt: Any = 0.01,
    horizon: int = 500,
    max_control: Any = 50.0,
    solver: diffrax.AbstractSolver | None = None,
    substeps: int = 1,
    **environment: Any,
) -> Environment:
    """Hold Lorenz's chaotic system at the centre of its right wing.

    State (x, y, z); control (u). Starts with x and y uniform in +-20 and z in [10, 40].
    Cost `|x - x*|^2 + 0.001 u^2` a step, x* being the equilibrium. Never terminates.

    **Arguments:**

    - `sigma`, `rho`, `beta`: of [`delucax.systems.Lorenz`][].
    - `max_control`: 50 by default.
    - `dt`: the control interval, 0.01 by default.
    - `horizon`: steps an episode, 500 by default.
    - `solver`: a Diffrax solver, [`delucax.dynamics.RK4`][] by default.
    - `substeps`: solver steps an interval, 1 by default.
    - `**environment`: other arguments of [`delucax.Environment`][], such as
        `disturbance`.

    **Returns:** an [`delucax.Environment`][].

    **Raises:** `ValueError` on illegal numbers.

    Source: Lorenz, 1963; Kaiser, Kutz and Brunton, 2018.

    !!! example

        ```python
        import delucax as dlx

        env = dlx.make("lorenz", rho=24.0)
        ```
    """
    check_range(max_control, "max_control", "lorenz")
    system = Lorenz(sigma, rho, beta)
    centre, _ = system.equilibrium()
    low, high = jnp.array([-20.0, -20.0, 10.0]), jnp.array([20.0, 20.0, 40.0])
    arguments: dict[str, Any] = dict(
        dynamics=Discretized(system, dt, solver, substeps),
        cost=Quadratic(jnp.ones(3), 0.001 * jnp.ones(1), state_target=centre),
        initial_state=UniformState(low, high),
        control_bounds=(-max_control, max_control),
        horizon=horizon,
    )
    return finish(lorenz, arguments, environment)
