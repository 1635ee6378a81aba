"""Fly a planar quadrotor to a point, in wind: the paper's task."""

from collections.abc import Callable
from typing import Any

import diffrax
import jax.numpy as jnp
from jaxtyping import Array

from ..costs import Quadratic
from ..systems import ConstantWind, DissipativeWind, PlanarQuadrotor, VortexWind
from ._task import task


_WINDS: dict[str, Callable[..., Any]] = {
    "dissipative": DissipativeWind,
    "constant": ConstantWind,
    "vortices": VortexWind,
}


def _wind(
    *, wind: str | Callable[..., Array] | None = None, wind_strength: Any = None
) -> dict[str, Any]:
    """The wind of a system, by its name or as it is."""
    where = "planar_quadrotor"
    if not isinstance(wind, str):
        if wind_strength is not None:
            raise ValueError(
                f"{where}: wind_strength needs a wind that is named, such as "
                f"'dissipative', got wind={wind!r}."
            )
        return dict(wind=wind)
    if wind not in _WINDS:
        raise ValueError(
            f"{where}: wind must be one of {', '.join(map(repr, _WINDS))}, a "
            f"function (t, x) -> force, or None, got {wind!r}."
        )
    return dict(wind=_WINDS[wind](0.1 if wind_strength is None else wind_strength))


@task(PlanarQuadrotor, dt=0.05, horizon=100, solver=diffrax.Euler(), arguments=_wind)
def planar_quadrotor(system: PlanarQuadrotor) -> dict[str, Any]:
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
    windless = PlanarQuadrotor(system.mass, system.length, system.gravity)
    _, hover = windless.equilibrium()
    return dict(
        cost=Quadratic(jnp.ones(6), 0.1 * jnp.ones(2), control_target=hover),
        initial_state=jnp.array([1.0, 1.0, 0.0, 0.0, 0.0, 0.0]),
    )
