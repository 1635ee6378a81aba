"""Bring a mass on a line to rest at the origin."""

from typing import Any

import diffrax
import jax.numpy as jnp

from .._check import check_range
from ..costs import Quadratic
from ..dynamics import Discretized
from ..systems import DoubleIntegrator
from ._environment import Environment
from ._task import system_of, task_environment
from ._uniform_state import UniformState


def double_integrator(
    system: DoubleIntegrator | None = None,
    *,
    dt: Any = 0.1,
    horizon: int = 100,
    max_force: Any = 1.0,
    solver: diffrax.AbstractSolver | None = None,
    substeps: int = 1,
    **others: Any,
) -> Environment:
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
    system, others = system_of(double_integrator, DoubleIntegrator, system, others)
    corner = jnp.array([2.0, 1.0])
    return task_environment(
        others,
        dynamics=Discretized(system, dt, solver, substeps),
        cost=Quadratic(jnp.ones(2), 0.1 * jnp.ones(1)),
        initial_state=UniformState(-corner, corner),
        control_bounds=(-max_force, max_force),
        horizon=horizon,
    )
