"""Fly a planar quadrotor to a point, in wind: the paper's task."""

from collections.abc import Callable
from typing import Any

import diffrax
import jax.numpy as jnp
from jaxtyping import Array

from ..costs import Quadratic
from ..dynamics import Discretized
from ..systems import ConstantWind, DissipativeWind, PlanarQuadrotor, VortexWind
from ._environment import Environment
from ._task import system_of, task_environment


_WINDS: dict[str, Callable[..., Any]] = {
    "dissipative": DissipativeWind,
    "constant": ConstantWind,
    "vortices": VortexWind,
}


def planar_quadrotor(
    system: PlanarQuadrotor | None = None,
    *,
    wind: str | Callable[..., Array] | None = None,
    wind_strength: Any = None,
    dt: Any = 0.05,
    horizon: int = 100,
    solver: diffrax.AbstractSolver | None = None,
    substeps: int = 1,
    **others: Any,
) -> Environment:
    """Fly a planar quadrotor to the origin and hover there.

    State (x, y, angle, vx, vy, rate); control (left, right), the thrusts, without
    bounds; disturbance (force_x, force_y). Starts at rest at (1, 1). Cost
    `|x|^2 + 0.1 |u - u_hover|^2` a step, u_hover being half of the weight, whatever the
    wind. Explicit Euler, as in the paper. Never terminates.

    **Arguments:**

    - `system`: a [`delucax.systems.PlanarQuadrotor`][]; made of `others` by default.
    - `wind`: `"dissipative"`, `"constant"`, `"vortices"`, or any function
        `(t, x) -> force`; none by default. What the names stand for is said at
        [`delucax.systems.DissipativeWind`][], [`delucax.systems.ConstantWind`][] and
        [`delucax.systems.VortexWind`][].
    - `wind_strength`: of a wind that is named, 0.1 by default.
    - `dt`: the control interval, 0.05 by default.
    - `horizon`: steps an episode, 100 by default.
    - `solver`: a Diffrax solver, `diffrax.Euler()` by default.
    - `substeps`: solver steps an interval, 1 by default.
    - `**others`: arguments of [`delucax.systems.PlanarQuadrotor`][] or
        [`delucax.Environment`][], such as `control_bounds`.

    **Returns:** an [`delucax.Environment`][].

    **Raises:** `ValueError` on illegal numbers, a wind of an unknown name, or a
        strength for one that has no name.

    Source: Gradu, Hallman, Suo, Yu, Agarwal, Ghai, Singh, Zhang, Majumdar and Hazan,
    2021 (Deluca).

    !!! example

        ```python
        import delucax as dlx

        env = dlx.make("planar_quadrotor", wind="dissipative", wind_strength=0.4)
        ```
    """
    wind = _wind(wind, wind_strength)
    if wind is not None:
        others["wind"] = wind
    system, others = system_of(planar_quadrotor, PlanarQuadrotor, system, others)
    windless = PlanarQuadrotor(system.mass, system.length, system.gravity)
    _, hover = windless.equilibrium()
    return task_environment(
        others,
        dynamics=Discretized(system, dt, solver or diffrax.Euler(), substeps),
        cost=Quadratic(jnp.ones(6), 0.1 * jnp.ones(2), control_target=hover),
        initial_state=jnp.array([1.0, 1.0, 0.0, 0.0, 0.0, 0.0]),
        horizon=horizon,
    )


def _wind(wind: Any, strength: Any) -> Callable[..., Array] | None:
    """A wind, by its name or as it is."""
    where = "planar_quadrotor"
    if isinstance(wind, str):
        if wind not in _WINDS:
            raise ValueError(
                f"{where}: wind must be one of {', '.join(map(repr, _WINDS))}, a "
                f"function (t, x) -> force, or None, got {wind!r}."
            )
        return _WINDS[wind](0.1 if strength is None else strength)
    if strength is not None:
        raise ValueError(
            f"{where}: wind_strength needs a wind that is named, such as "
            f"'dissipative', got wind={wind!r}."
        )
    return wind
