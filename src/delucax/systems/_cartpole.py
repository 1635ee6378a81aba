"""The cart and pole of Gym's CartPole-v1."""

from typing import ClassVar

import jax.numpy as jnp
from jaxtyping import Array

from .._module import parameter, positive
from .._typing import Control, Disturbance, State, Time
from ..math import cos, sin
from ._base import AbstractSystem


class CartPole(AbstractSystem):
    r"""A pole hinged on a cart, which a force pushes along a track without friction:

    ```
    push = (force + m l spin^2 sin(angle)) / M
    d(spin)/dt = (g sin(angle) - cos(angle) push) / (l (4/3 - m cos(angle)^2 / M))
    d(velocity)/dt = push - m l d(spin)/dt cos(angle) / M
    ```

    with `M` the mass of cart and pole together. The state is (position [m], velocity
    [m/s], angle [rad], spin [rad/s]), the control is (force [N]). `angle = 0` is
    upright, and it grows in the direction of positive positions. The vector field is
    smooth.

    **Arguments:**

    - `cart_mass`: [kg], 1 by default.
    - `pole_mass`: m [kg], 0.1 by default.
    - `half_length`: l, half the length of the pole [m], 0.5 by default. Gym calls it
        the length.
    - `gravity`: g [m/s^2], 9.8 by default.

    **Raises:** `ValueError` if a mass or length is not positive, or a number is not
    finite.

    Source: Barto, Sutton and Anderson, 1983; Florian, 2007; Gymnasium (Towers et al.,
    2023), `CartPole-v1`.

    !!! example

        ```python
        import delucax as dlx

        cartpole = dlx.systems.CartPole(half_length=0.6)
        upright = dlx.linearize(cartpole)
        upright.A
        ```
    """

    cart_mass: Array = parameter(1.0, constraint=positive)
    pole_mass: Array = parameter(0.1, constraint=positive)
    half_length: Array = parameter(0.5, constraint=positive)
    gravity: Array = parameter(9.8)

    state_names: ClassVar = ("position", "velocity", "angle", "spin")
    angle_names: ClassVar = ("angle",)
    control_names: ClassVar = ("force",)
    state_units: ClassVar = ("m", "m/s", "rad", "rad/s")
    control_units: ClassVar = ("N",)

    def accelerations(
        self, angle: Array, spin: Array, force: Array
    ) -> tuple[Array, Array]:
        """The accelerations of the cart and of the pole.

        **Arguments:** `angle` [rad], `spin` [rad/s], `force` [N]: scalars.

        **Returns:** `(d(velocity)/dt [m/s^2], d(spin)/dt [rad/s^2])`.
        """
        total = self.cart_mass + self.pole_mass
        moment = self.pole_mass * self.half_length
        lean, upright = sin(angle), cos(angle)
        push = (force + moment * (spin * spin) * lean) / total
        inertia = 4 / 3 - self.pole_mass * (upright * upright) / total
        turn = (self.gravity * lean - upright * push) / (self.half_length * inertia)
        return push - moment * turn * upright / total, turn

    def vector_field(self, t: Time, x: State, u: Control, w: Disturbance) -> State:
        acceleration, turn = self.accelerations(x[2], x[3], u[0])
        return jnp.stack([x[1], acceleration, x[3], turn])

    def equilibrium(self) -> tuple[State, Control]:
        return jnp.zeros(4), jnp.zeros(1)
