"""Hold a reactor where it does not stay by itself."""

from typing import Any

import diffrax
import jax.numpy as jnp

from .._check import check_positive, check_range
from ..costs import Quadratic
from ..dynamics import Discretized
from ..systems import CSTR
from ._environment import Environment, UniformState
from ._registry import finish


def cstr(
    flow: Any = 1.0,
    feed_concentration: Any = 1.0,
    feed_temperature: Any = 350.0,
    rate: Any = 7.2e10,
    activation: Any = 8750.0,
    heat: Any = 209.2,
    cooling: Any = 2.092,
    *,
    concentration: Any = 0.5,
    dt: Any = 0.05,
    horizon: int = 100,
    min_coolant: Any = 280.0,
    max_coolant: Any = 320.0,
    solver: diffrax.AbstractSolver | None = None,
    substeps: int = 4,
    **environment: Any,
) -> Environment:
    """Hold a stirred-tank reactor at its unstable equilibrium.

    State (concentration [mol/l], temperature [K]); control (coolant [K]). Starts within
    0.05 mol/l and 3 K of the equilibrium. Cost
    `10 (c - c*)^2 + 0.01 (T - T*)^2 + 0.01 (T_coolant - T_coolant*)^2` a step, with the
    equilibrium at the concentration. Never terminates. The time is in minutes.

    **Arguments:**

    - `flow`, `feed_concentration`, `feed_temperature`, `rate`, `activation`, `heat`,
        `cooling`: of [`delucax.systems.CSTR`][].
    - `concentration`: to hold [mol/l], below that of the feed; 0.5 by default.
    - `min_coolant`, `max_coolant`: what the jacket can do [K], 280 and 320 by default.
    - `dt`: the control interval [min], 0.05 by default.
    - `horizon`: steps an episode, 100 by default.
    - `solver`: a Diffrax solver, [`delucax.dynamics.RK4`][] by default.
    - `substeps`: solver steps an interval, 4 by default.
    - `**environment`: other arguments of [`delucax.Environment`][], such as
        `disturbance`.

    **Returns:** an [`delucax.Environment`][].

    **Raises:** `ValueError` on illegal numbers.

    Source: Henson and Seborg, 1997.

    !!! example

        ```python
        import delucax as dlx

        env = dlx.make("cstr")
        mpc = dlx.controllers.MPC(env.dynamics, env.cost, 20, bounds=(280.0, 320.0))
        ```
    """
    check_positive(concentration, "concentration", "cstr")
    check_range(min_coolant, "min_coolant", "cstr")
    check_range(max_coolant, "max_coolant", "cstr")
    system = CSTR(
        flow, feed_concentration, feed_temperature, rate, activation, heat, cooling
    )
    x, u = system.equilibrium(concentration)
    about = jnp.array([0.05, 3.0])
    arguments: dict[str, Any] = dict(
        dynamics=Discretized(system, dt, solver, substeps),
        cost=Quadratic([10.0, 0.01], [0.01], state_target=x, control_target=u),
        initial_state=UniformState(x - about, x + about),
        control_bounds=(min_coolant, max_coolant),
        horizon=horizon,
    )
    return finish(cstr, arguments, environment)
