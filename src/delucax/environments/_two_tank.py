"""Hold the level of a tank that is fed through another one."""

from typing import Any

import diffrax
import jax.numpy as jnp

from .._check import check_range
from ..costs import Quadratic
from ..dynamics import Discretized
from ..systems import TwoTank
from ._environment import Environment
from ._task import system_of, task_environment
from ._uniform_state import UniformState


def two_tank(
    system: TwoTank | None = None,
    *,
    level: Any = 10.0,
    dt: Any = 2.0,
    horizon: int = 200,
    max_flow: Any = 30.0,
    solver: diffrax.AbstractSolver | None = None,
    substeps: int = 1,
    **others: Any,
) -> Environment:
    """Hold the lower of two tanks at a level.

    State (upper, lower) [cm]; control (flow) [cm^3/s], not negative. Starts with the
    levels uniform in [0, 20]. Cost `(lower - level)^2 + 0.01 (flow - flow*)^2` a step,
    flow* being what holds the level. Never terminates.

    **Arguments:**

    - `system`: a [`delucax.systems.TwoTank`][]; made of `others` by default.
    - `level`: to hold [cm], 10 by default.
    - `max_flow`: of the pump, 30 by default.
    - `dt`: the control interval, 2 by default.
    - `horizon`: steps an episode, 200 by default.
    - `solver`: a Diffrax solver, [`delucax.dynamics.RK4`][] by default.
    - `substeps`: solver steps an interval, 1 by default.
    - `**others`: arguments of [`delucax.systems.TwoTank`][] or
        [`delucax.Environment`][], such as `disturbance`.

    **Returns:** an [`delucax.Environment`][].

    **Raises:** `ValueError` on illegal numbers, or on arguments of a system beside one.

    Source: Johansson, 2000.

    !!! example

        ```python
        import delucax as dlx

        env = dlx.make("two_tank", level=12.0)
        ```
    """
    check_range(max_flow, "max_flow", "two_tank")
    check_range(level, "level", "two_tank")
    system, others = system_of(two_tank, TwoTank, system, others)
    x, u = system.equilibrium(level)
    Q, R = jnp.array([0.0, 1.0]), 0.01 * jnp.ones(1)
    return task_environment(
        others,
        dynamics=Discretized(system, dt, solver, substeps),
        cost=Quadratic(Q, R, state_target=x, control_target=u),
        initial_state=UniformState(jnp.zeros(2), jnp.full(2, 20.0)),
        control_bounds=(0.0, max_flow),
        horizon=horizon,
    )
