"""A task's own arithmetic, or a solver in its place."""

from collections.abc import Callable, Mapping
from typing import Any

import diffrax

from .._check import check_step
from ..dynamics import AbstractDynamics, Discretized
from ..systems import AbstractSystem


def own_or_solver(
    own: Callable[..., AbstractDynamics],
    system: AbstractSystem,
    dt: Any,
    solver: diffrax.AbstractSolver | None,
    substeps: int,
    where: str,
    options: Mapping[str, Any],
) -> AbstractDynamics:
    """`own(system=system, dt=dt, **options)`, or `Discretized` where there is a solver.

    `options` are those that `own` alone has; `None` stands for its default.

    **Raises:** `ValueError` if `dt` is not positive, on `substeps` without a solver, or
    on an option with it.
    """
    check_step(dt, where)
    given = {name: value for name, value in options.items() if value is not None}
    if solver is None:
        if substeps != 1:
            raise ValueError(f"{where}: substeps needs a solver, such as RK4().")
        return own(system=system, dt=dt, **given)
    for name in given:
        raise ValueError(
            f"{where}: {name} is of Gym's arithmetic, and no solver has the like; give "
            f"one of {name} and solver."
        )
    return Discretized(system, dt, solver, substeps)
