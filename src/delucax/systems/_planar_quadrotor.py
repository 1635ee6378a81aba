"""A quadrotor that moves in a vertical plane."""

from collections.abc import Callable
from typing import ClassVar

import jax.numpy as jnp
from jaxtyping import Array

from .._module import function_field, parameter, positive
from .._typing import Control, Disturbance, State, Time
from ..math import cos, sin
from ._base import AbstractSystem


class PlanarQuadrotor(AbstractSystem):
    r"""A quadrotor in a vertical plane, driven by the thrusts of its two rotors:

    `m d2(x)/dt2 = -(left + right) sin(angle) + F_x`,
    `m d2(y)/dt2 = (left + right) cos(angle) - m g + F_y`,
    `m l d2(angle)/dt2 = right - left`.

    The state is (x [m], y [m], angle [rad], their derivatives), the control
    (left [N], right [N]), and the force F is that of the
    `wind` plus the disturbance w [N]. The vector field is smooth if the wind is, and
    takes thrusts of either sign.

    **Arguments:**

    - `mass`: m [kg], 0.1 by default.
    - `length`: l [m], 0.2 by default.
    - `gravity`: g [m/s^2], 9.81 by default.
    - `wind`: `(t, x) -> force`, a function of time and the state to a vector of two
        [N]: [`delucax.systems.DissipativeWind`][], [`delucax.systems.ConstantWind`][],
        [`delucax.systems.VortexWind`][] or any other; none by default.

    **Raises:** `ValueError` if a mass or length is not positive, a number is not finite
    or the wind is no function.

    Source: Gradu, Hallman, Suo, Yu, Agarwal, Ghai, Singh, Zhang, Majumdar and Hazan,
    2021 (Deluca).

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp

        gusts = lambda t, x: 0.1 * jnp.stack([jnp.sin(t), 0.0 * t])
        quadrotor = dlx.systems.PlanarQuadrotor(wind=gusts)
        quadrotor.vector_field(0.0, jnp.zeros(6), jnp.array([0.5, 0.5]), None)
        ```
    """

    mass: Array = parameter(0.1, constraint=positive)
    length: Array = parameter(0.2, constraint=positive)
    gravity: Array = parameter(9.81)
    wind: Callable[..., Array] | None = function_field(None)

    state_names: ClassVar = ("x", "y", "angle", "vx", "vy", "rate")
    angle_names: ClassVar = ("angle",)
    control_names: ClassVar = ("left", "right")
    disturbance_names: ClassVar = ("force_x", "force_y")
    state_units: ClassVar = ("m", "m", "rad", "m/s", "m/s", "rad/s")
    control_units: ClassVar = ("N", "N")

    def __check_init__(self):
        if self.wind is not None and not callable(self.wind):
            raise ValueError(
                "PlanarQuadrotor: wind must be a function (t, x) -> force, got "
                f"{self.wind!r}."
            )

    def vector_field(self, t: Time, x: State, u: Control, w: Disturbance) -> State:
        thrust, lean = (u[0] + u[1]) / self.mass, x[2]
        ax, ay = -thrust * sin(lean), thrust * cos(lean) - self.gravity
        if self.wind is not None:
            force = self.wind(t, x)
            if jnp.shape(force) != (2,):
                raise ValueError(
                    "PlanarQuadrotor: wind must return a force of shape (2,), got "
                    f"shape {jnp.shape(force)}."
                )
            ax, ay = ax + force[0] / self.mass, ay + force[1] / self.mass
        if w is not None:
            ax, ay = ax + w[0] / self.mass, ay + w[1] / self.mass
        turn = (u[1] - u[0]) / (self.mass * self.length)
        return jnp.stack([x[3], x[4], x[5], ax, ay, turn])

    def equilibrium(self) -> tuple[State, Control]:
        """Hovering at the origin, leaning against the wind that blows there at time 0.

        An equilibrium for as long as the wind depends on nothing but the place.

        **Returns:** the state, and a half of the thrust for each rotor; without wind
            the zero state, and a half of the weight.
        """
        weight, level = self.mass * self.gravity, jnp.zeros(6)
        if self.wind is None:
            return level, jnp.stack([weight / 2, weight / 2])
        force = self.wind(jnp.zeros(()), level)
        up = weight - force[1]
        half = (force[0] * force[0] + up * up) ** 0.5 / 2
        return level.at[2].set(jnp.arctan2(force[0], up)), jnp.stack([half, half])
