"""Fly a quadrotor to a point and hover there, in a plane and in space."""

from collections.abc import Callable
from typing import Any

import diffrax
import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array

from .._check import check_range, LARGEST
from .._module import as_float_array
from .._typing import PRNGKey, State, Vector
from ..costs import Quadratic
from ..math._attitude import attitude_difference, unit_attitude
from ..systems import (
    ConstantWind,
    DissipativeWind,
    PlanarQuadrotor,
    Quadrotor,
    VortexWind,
)
from ._task import Fields, task, UniformState


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
def planar_quadrotor(system: PlanarQuadrotor) -> Fields:
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


# The entries of a rotation matrix, with room for what rounding adds.
_ROTATION = 1.00001


class _Start(eqx.Module):
    """A state from a box, its quaternion of length 1."""

    box: UniformState

    def __call__(self, key: PRNGKey) -> Array:
        return unit_attitude(self.box(key))


def quadrotor_features(x: State) -> Vector:
    """The state with the rotation matrix in place of the quaternion: q and -q, which
    are one attitude, look the same.

    **Arguments:** `x`: the state of a [`delucax.systems.Quadrotor`][].

    **Returns:** (position, rotation matrix from body to world row by row, velocity,
    body rates), shape `(18,)`.

    !!! example

        ```python
        import delucax as dlx

        x, _ = dlx.systems.Quadrotor().equilibrium()
        dlx.environments.quadrotor_features(x)
        ```
    """
    w, a, b, c = x[3], x[4], x[5], x[6]
    rotation = [
        1 - 2 * (b * b + c * c),
        2 * (a * b - w * c),
        2 * (a * c + w * b),
        2 * (a * b + w * c),
        1 - 2 * (a * a + c * c),
        2 * (b * c - w * a),
        2 * (a * c - w * b),
        2 * (b * c + w * a),
        1 - 2 * (a * a + b * b),
    ]
    return jnp.concatenate([x[:3], jnp.stack(rotation), x[7:]])


@task(Quadrotor, dt=0.02, horizon=250)
def quadrotor(system: Quadrotor, *, max_thrust: Any = 6.0) -> Fields:
    """Fly a quadrotor to the origin and hover there.

    State (position, quaternion, velocity, body rates), 13 entries; control (front,
    left, back, right), the thrusts, or (thrust, torque); disturbance, a force. Starts
    with the position uniform in +-1 m, the velocity in +-0.5 m/s, the rates in +-0.5
    rad/s and the attitude up to about 40 degrees from level. Cost a step: the squares
    of position and of the quaternion's deviation, 0.1 times those of the velocities,
    and 0.1 times those of the control's deviation from hovering. Never terminates.

    **Arguments:**

    - `system`: a [`delucax.systems.Quadrotor`][]; made of `others` by default.
    - `max_thrust`: of a rotor, 6 by default; none is negative. A wrench is bounded by
        the largest that the rotors give on each axis.
    - `dt`: the control interval, 0.02 by default.
    - `horizon`: steps an episode, 250 by default.
    - `solver`: a Diffrax solver, [`delucax.dynamics.RK4`][] by default.
    - `substeps`: solver steps an interval, 1 by default.
    - `**others`: arguments of [`delucax.systems.Quadrotor`][] or
        [`delucax.Environment`][], such as `disturbance`.

    **Returns:** an [`delucax.Environment`][].

    **Raises:** `ValueError` on illegal numbers, or on arguments of a system beside one.

    Source: Mahony, Kumar and Corke, 2012; Furrer, Burri, Achtelik and Siegwart, 2016.

    !!! example

        ```python
        import delucax as dlx

        env = dlx.make("quadrotor", mass=0.8)
        ```
    """
    check_range(max_thrust, "max_thrust", "quadrotor")
    x, hover = system.equilibrium()
    low, high = 0.0, as_float_array(max_thrust)
    if system.inputs == "wrench":
        turn, yaw = system.arm * high, 2 * system.moment * high
        high = jnp.stack([4 * high, turn, turn, yaw])
        low = -high.at[0].set(0.0)
    feature_bound = jnp.full(18, LARGEST).at[3:12].set(_ROTATION)
    corner = jnp.array([1.0] * 3 + [0.0] + [0.2] * 3 + [0.5] * 6)
    return dict(
        cost=Quadratic(
            jnp.array([1.0] * 7 + [0.1] * 6),
            0.1 * jnp.ones(4),
            state_target=x,
            control_target=hover,
            difference=attitude_difference,
        ),
        initial_state=_Start(UniformState(x - corner, x + corner)),
        control_bounds=(low, high),
        encode=quadrotor_features,
        observation_bounds=(-feature_bound, feature_bound),
    )
