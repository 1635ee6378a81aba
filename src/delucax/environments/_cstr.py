"""Hold a reactor where it does not stay by itself."""

from typing import Any

import jax.numpy as jnp

from .._check import check_positive, check_range
from ..costs import Quadratic
from ..systems import CSTR
from ._task import task
from ._uniform_state import UniformState


@task(CSTR, dt=0.05, horizon=100, substeps=4)
def cstr(
    system: CSTR,
    *,
    concentration: Any = 0.5,
    min_coolant: Any = 280.0,
    max_coolant: Any = 320.0,
) -> dict[str, Any]:
    """Hold a stirred-tank reactor at its unstable equilibrium.

    State (concentration [mol/l], temperature [K]); control (coolant [K]). Starts within
    0.05 mol/l and 3 K of the equilibrium. Cost
    `10 (c - c*)^2 + 0.01 (T - T*)^2 + 0.01 (T_coolant - T_coolant*)^2` a step, with the
    equilibrium at the concentration. Never terminates. The time is in minutes.

    **Arguments:**

    - `system`: a [`delucax.systems.CSTR`][]; made of `others` by default.
    - `concentration`: to hold [mol/l], below that of the feed; 0.5 by default.
    - `min_coolant`, `max_coolant`: what the jacket can do [K], 280 and 320 by default.
    - `dt`: the control interval [min], 0.05 by default.
    - `horizon`: steps an episode, 100 by default.
    - `solver`: a Diffrax solver, [`delucax.dynamics.RK4`][] by default.
    - `substeps`: solver steps an interval, 4 by default.
    - `**others`: arguments of [`delucax.systems.CSTR`][] or [`delucax.Environment`][],
        such as `disturbance`.

    **Returns:** an [`delucax.Environment`][].

    **Raises:** `ValueError` on illegal numbers, or on arguments of a system beside one.

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
    x, u = system.equilibrium(concentration)
    about = jnp.array([0.05, 3.0])
    return dict(
        cost=Quadratic([10.0, 0.01], [0.01], state_target=x, control_target=u),
        initial_state=UniformState(x - about, x + about),
        control_bounds=(min_coolant, max_coolant),
    )
