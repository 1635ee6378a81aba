"""Bring a chain of masses and springs to rest."""

from typing import Any

import diffrax
import jax.numpy as jnp

from .._check import check_range
from ..costs import Quadratic
from ..dynamics import Discretized
from ..systems import MassSpringDamper
from ._environment import Environment, UniformState
from ._registry import finish


def mass_spring_damper(
    mass: Any = 1.0,
    stiffness: Any = 1.0,
    damping: Any = 0.1,
    *,
    masses: int = 1,
    dt: Any = 0.1,
    horizon: int = 200,
    max_force: Any = 1.0,
    solver: diffrax.AbstractSolver | None = None,
    substeps: int = 1,
    **environment: Any,
) -> Environment:
    """Bring a mass on a spring, or a chain of them, to rest by a force on the last.

    State (positions, velocities); control (force). Starts with each state uniform in
    +-1. Cost `|x|^2 + 0.1 force^2` a step. Never terminates.

    **Arguments:**

    - `mass`, `stiffness`, `damping`, `masses`: of
        [`delucax.systems.MassSpringDamper`][].
    - `max_force`: 1 by default.
    - `dt`: the control interval, 0.1 by default.
    - `horizon`: steps an episode, 200 by default.
    - `solver`: a Diffrax solver, [`delucax.dynamics.RK4`][] by default.
    - `substeps`: solver steps an interval, 1 by default.
    - `**environment`: other arguments of [`delucax.Environment`][], such as
        `disturbance`.

    **Returns:** an [`delucax.Environment`][].

    **Raises:** `ValueError` on illegal numbers, or if there are not as many as masses.

    Source: Åström and Murray, 2008.

    !!! example

        ```python
        import delucax as dlx

        env = dlx.make("mass_spring_damper", masses=3)
        ```
    """
    check_range(max_force, "max_force", "mass_spring_damper")
    system = MassSpringDamper(mass, stiffness, damping, masses=masses)
    corner = jnp.ones(system.state_size)
    arguments: dict[str, Any] = dict(
        dynamics=Discretized(system, dt, solver, substeps),
        cost=Quadratic(jnp.ones(system.state_size), 0.1 * jnp.ones(1)),
        initial_state=UniformState(-corner, corner),
        control_bounds=(-max_force, max_force),
        horizon=horizon,
    )
    return finish(mass_spring_damper, arguments, environment)
