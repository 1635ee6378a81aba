"""Bring a chain of masses and springs to rest."""

from typing import Any

import jax.numpy as jnp

from .._check import check_range
from ..costs import Quadratic
from ..systems import MassSpringDamper
from ._task import task
from ._uniform_state import UniformState


@task(MassSpringDamper, dt=0.1, horizon=200)
def mass_spring_damper(
    system: MassSpringDamper, *, max_force: Any = 1.0
) -> dict[str, Any]:
    """Bring a mass on a spring, or a chain of them, to rest by a force on the last.

    State (positions, velocities); control (force). Starts with each state uniform in
    +-1. Cost `|x|^2 + 0.1 force^2` a step. Never terminates.

    **Arguments:**

    - `system`: a [`delucax.systems.MassSpringDamper`][]; made of `others` by default.
    - `max_force`: 1 by default.
    - `dt`: the control interval, 0.1 by default.
    - `horizon`: steps an episode, 200 by default.
    - `solver`: a Diffrax solver, [`delucax.dynamics.RK4`][] by default.
    - `substeps`: solver steps an interval, 1 by default.
    - `**others`: arguments of [`delucax.systems.MassSpringDamper`][] or
        [`delucax.Environment`][], such as `disturbance`.

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
    corner = jnp.ones(system.state_size)
    return dict(
        cost=Quadratic(corner, [0.1]),
        initial_state=UniformState(-corner, corner),
        control_bounds=(-max_force, max_force),
    )
