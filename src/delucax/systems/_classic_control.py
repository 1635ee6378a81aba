"""Classic control: the pendulum, the cart-pole and the mountain car of Gym."""

from typing import ClassVar

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike

from .._module import parameter, positive
from .._typing import Control, Disturbance, Real, State, Time
from ..math import cos, sin
from ._base import AbstractSystem


class Pendulum(AbstractSystem):
    r"""A uniform rod hinged at one end, driven by a torque at the hinge:

    `d2(angle)/dt2 = 3 g / (2 l) sin(angle) + 3 torque / (m l^2) - d(angle)/dt b`

    with `angle = 0` upright. The state is (angle [rad], velocity [rad/s]), the control
    is (torque [N m]). The vector field is smooth.

    **Arguments:**

    - `mass`: m [kg], 1 by default.
    - `length`: l [m], 1 by default.
    - `gravity`: g [m/s^2], 10 by default, as in Gym.
    - `damping`: viscous friction b [1/s], 0 by default.

    **Raises:** `ValueError` if a mass or length is not positive, or a number is not
    finite.

    Source: Gymnasium (Towers et al., 2023), `Pendulum-v1`.

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp

        pendulum = dlx.systems.Pendulum(length=1.2)
        pendulum.vector_field(0.0, jnp.array([0.1, 0.0]), jnp.zeros(1), None)
        ```
    """

    mass: Real = parameter(1.0, constraint=positive)
    length: Real = parameter(1.0, constraint=positive)
    gravity: Real = parameter(10.0)
    damping: Real = parameter(0.0)

    state_names: ClassVar = ("angle", "velocity")
    angle_names: ClassVar = ("angle",)
    control_names: ClassVar = ("torque",)
    state_units: ClassVar = ("rad", "rad/s")
    control_units: ClassVar = ("N m",)

    def acceleration(self, angle: Array, velocity: Array, torque: Array) -> Array:
        """The angular acceleration.

        **Arguments:** `angle` [rad], `velocity` [rad/s], `torque` [N m]: scalars.

        **Returns:** d2(angle)/dt2 [rad/s^2].
        """
        weight = 3 * self.gravity / (2 * self.length) * sin(angle)
        drive = 3 / (self.mass * self.length**2) * torque
        return weight + drive - self.damping * velocity

    def vector_field(self, t: Time, x: State, u: Control, w: Disturbance) -> State:
        return jnp.stack([x[1], self.acceleration(x[0], x[1], u[0])])

    def equilibrium(self) -> tuple[State, Control]:
        return jnp.zeros(2), jnp.zeros(1)


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

    cart_mass: Real = parameter(1.0, constraint=positive)
    pole_mass: Real = parameter(0.1, constraint=positive)
    half_length: Real = parameter(0.5, constraint=positive)
    gravity: Real = parameter(9.8)

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
        # 4/3: of a uniform rod of half-length l about its end, over m l.
        inertia = 4 / 3 - self.pole_mass * (upright * upright) / total
        turn = (self.gravity * lean - upright * push) / (self.half_length * inertia)
        return push - moment * turn * upright / total, turn

    def vector_field(self, t: Time, x: State, u: Control, w: Disturbance) -> State:
        acceleration, turn = self.accelerations(x[2], x[3], u[0])
        return jnp.stack([x[1], acceleration, x[3], turn])

    def equilibrium(self) -> tuple[State, Control]:
        return jnp.zeros(4), jnp.zeros(1)


class MountainCar(AbstractSystem):
    r"""A car in a valley whose slopes are steeper than its motor can climb:

    `d(velocity)/dt = power push - gravity cos(3 position)`

    The state is (position, velocity), the control is (push). The unit of time is a
    step: Gym gives its constants for one step at a time, so Gym's arithmetic is
    semi-implicit Euler with `dt = 1`. Gravity acts along the position, not along the
    track. The vector field is smooth, and has no walls and no speed limit. The
    equilibrium that it names is the bottom of the valley, `position = -pi/6`.

    **Arguments:**

    - `power`: of the motor, 0.0015 by default, as in `MountainCarContinuous-v0`;
        `MountainCar-v0` has 0.001.
    - `gravity`: 0.0025 by default.

    **Raises:** `ValueError` if a number is not finite.

    Source: Moore, 1990; Gymnasium (Towers et al., 2023), `MountainCarContinuous-v0` and
    `MountainCar-v0`.

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp

        car = dlx.systems.MountainCar()
        car.vector_field(0.0, jnp.array([-0.5, 0.0]), jnp.ones(1), None)
        ```
    """

    power: Real = parameter(0.0015)
    gravity: Real = parameter(0.0025)

    state_names: ClassVar = ("position", "velocity")
    control_names: ClassVar = ("push",)
    state_units: ClassVar = ("", "1/step")
    time_unit: ClassVar = "steps"
    control_units: ClassVar = ("",)

    def acceleration(self, position: Array, push: Array) -> Array:
        """The acceleration.

        **Arguments:** `position`, `push`: scalars.

        **Returns:** d(velocity)/dt, a step being the unit of time.
        """
        # The slope of `height` over 1.35: gravity acts as if the track were flat.
        return self.power * push - self.gravity * cos(3 * position)

    def height(self, position: ArrayLike) -> Array:
        """The height of the track, `0.45 sin(3 position) + 0.55`, as Gym draws it.

        **Arguments:** `position`: any shape.

        **Returns:** the height, of the same shape.
        """
        return 0.45 * sin(3 * jnp.asarray(position)) + 0.55

    def vector_field(self, t: Time, x: State, u: Control, w: Disturbance) -> State:
        return jnp.stack([x[1], self.acceleration(x[0], u[0])])

    def equilibrium(self) -> tuple[State, Control]:
        return jnp.array([-np.pi / 6, 0.0]), jnp.zeros(1)
