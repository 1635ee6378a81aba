"""Classic control: Gym's pendulum, cart-pole, mountain car and acrobot."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike

from .._check import check_choice
from .._jax import host_unless_traced, xp
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

    state_names, state_units = ("angle", "velocity"), ("rad", "rad/s")
    control_names, control_units = ("torque",), ("N m",)
    angle_names = ("angle",)

    def acceleration(self, angle: Array, velocity: Array, torque: Array) -> Array:
        """The angular acceleration.

        **Arguments:** `angle` [rad], `velocity` [rad/s], `torque` [N m]: scalars.

        **Returns:** d2(angle)/dt2 [rad/s^2].
        """
        # m l^2 / 3 is the inertia of a rod about its end. Gravity, m g l/2 sin(angle),
        # drives away from upright: its sign is plus.
        weight = 3 * self.gravity / (2 * self.length) * sin(angle)
        drive = 3 / (self.mass * self.length**2) * torque
        return weight + drive - self.damping * velocity

    def vector_field(self, t: Time, x: State, u: Control, w: Disturbance) -> State:
        return jnp.stack([x[1], self.acceleration(x[0], x[1], u[0])])

    @host_unless_traced
    def equilibrium(self) -> tuple[State, Control]:
        return xp.zeros(2), xp.zeros(1)


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

    state_names = ("position", "velocity", "angle", "spin")
    state_units = ("m", "m/s", "rad", "rad/s")
    control_names, control_units = ("force",), ("N",)
    angle_names = ("angle",)

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
        # The pole pulls the cart outwards as it swings: a centrifugal force, along
        # lean.
        push = (force + moment * (spin * spin) * lean) / total
        # 4/3: of a uniform rod of half-length l about its end, over m l.
        inertia = 4 / 3 - self.pole_mass * (upright * upright) / total
        # A cart that is pushed forwards leaves the pole behind: hence the minus.
        turn = (self.gravity * lean - upright * push) / (self.half_length * inertia)
        return push - moment * turn * upright / total, turn

    def vector_field(self, t: Time, x: State, u: Control, w: Disturbance) -> State:
        acceleration, turn = self.accelerations(x[2], x[3], u[0])
        return jnp.stack([x[1], acceleration, x[3], turn])

    @host_unless_traced
    def equilibrium(self) -> tuple[State, Control]:
        return xp.zeros(4), xp.zeros(1)


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

    state_names, state_units = ("position", "velocity"), ("", "1/step")
    control_names, control_units = ("push",), ("",)
    time_unit = "steps"

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

    @host_unless_traced
    def equilibrium(self) -> tuple[State, Control]:
        return xp.array([-np.pi / 6, 0.0]), xp.zeros(1)


class Acrobot(AbstractSystem):
    r"""Two links that hang in a chain, with a torque at the joint between them:

    ```
    d1 = m1 c1^2 + m2 (l1^2 + c2^2 + 2 l1 c2 cos(angle_2)) + I1 + I2
    d2 = m2 (c2^2 + l1 c2 cos(angle_2)) + I2
    phi2 = m2 c2 g sin(angle_1 + angle_2)
    phi1 = -m2 l1 c2 (velocity_2^2 + 2 velocity_1 velocity_2) sin(angle_2)
           + (m1 c1 + m2 l1) g sin(angle_1) + phi2
    d(velocity_2)/dt = (torque + d2/d1 phi1 - m2 l1 c2 velocity_1^2 sin(angle_2) - phi2)
                       / (m2 c2^2 + I2 - d2^2/d1)
    d(velocity_1)/dt = -(d2 d(velocity_2)/dt + phi1) / d1
    ```

    The state is (angle_1 [rad], angle_2 [rad], velocity_1 [rad/s], velocity_2 [rad/s]),
    the control is (torque [N m]), to which the disturbance w, (push [N m]), is added.
    `angle_1 = 0` hangs down; `angle_2` is measured from the line of the first link. The
    vector field is smooth. The equilibrium that it names is the upright one,
    `angle_1 = pi`.

    **Arguments:**

    - `mass_1`, `mass_2`: of the links [kg], 1 by default.
    - `length_1`: of the first link [m], 1 by default. That of the second plays no part.
    - `center_1`, `center_2`: c1 and c2, from a link's joint to its center of mass [m],
        0.5 by default.
    - `inertia_1`, `inertia_2`: of a link about its center of mass [kg m^2], 1 by
        default.
    - `gravity`: g [m/s^2], 9.8 by default.
    - `form`: `"book"` (default), the equations of motion; or `"nips"`, those printed in
        the paper, which lack the term in `velocity_1^2` and do not conserve energy.

    **Raises:** `ValueError` if a mass, length or inertia is not positive, a number is
    not finite, or `form` is neither.

    Source: Sutton, 1996 (`"nips"`); Sutton and Barto, 2018 (`"book"`); Gymnasium
    (Towers et al., 2023), `Acrobot-v1`.

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp

        acrobot = dlx.systems.Acrobot(mass_2=1.2)
        acrobot.vector_field(0.0, jnp.array([0.1, 0.0, 0.0, 0.0]), jnp.ones(1), None)
        ```
    """

    mass_1: Real = parameter(1.0, constraint=positive)
    mass_2: Real = parameter(1.0, constraint=positive)
    length_1: Real = parameter(1.0, constraint=positive)
    center_1: Real = parameter(0.5, constraint=positive)
    center_2: Real = parameter(0.5, constraint=positive)
    inertia_1: Real = parameter(1.0, constraint=positive)
    inertia_2: Real = parameter(1.0, constraint=positive)
    gravity: Real = parameter(9.8)
    form: str = eqx.field(static=True, default="book")

    state_names = ("angle_1", "angle_2", "velocity_1", "velocity_2")
    state_units = ("rad", "rad", "rad/s", "rad/s")
    control_names, control_units = ("torque",), ("N m",)
    angle_names = ("angle_1", "angle_2")
    disturbance_names = ("push",)

    def __check_init__(self):
        check_choice(self.form, ("book", "nips"), "form", "Acrobot")

    def vector_field(self, t: Time, x: State, u: Control, w: Disturbance) -> State:
        m1, m2, l1 = self.mass_1, self.mass_2, self.length_1
        c1, c2, g = self.center_1, self.center_2, self.gravity
        angle_1, angle_2, velocity_1, velocity_2 = x[0], x[1], x[2], x[3]
        bend, straight = sin(angle_2), cos(angle_2)
        own = m2 * c2**2 + self.inertia_2
        # The inertia about the first joint, and how it couples to the second.
        d1 = m1 * c1**2 + m2 * (l1**2 + c2**2 + 2 * l1 * c2 * straight)
        d1 = d1 + self.inertia_1 + self.inertia_2
        d2 = m2 * (c2**2 + l1 * c2 * straight) + self.inertia_2
        # Gravity about the second joint; gravity and Coriolis forces about the first.
        # Gym has cos(angle - pi/2), from angles to the horizontal; from hanging down it
        # is the sine, and pulls back.
        phi2 = m2 * c2 * g * sin(angle_1 + angle_2)
        swing = velocity_2 * velocity_2 + 2 * velocity_1 * velocity_2
        phi1 = (m1 * c1 + m2 * l1) * g * sin(angle_1) + phi2
        phi1 = phi1 - m2 * l1 * c2 * swing * bend
        torque = u[0] if w is None else u[0] + w[0]
        push = torque + d2 / d1 * phi1 - phi2  # acceleration_1 is eliminated
        if self.form == "book":
            push = push - m2 * l1 * c2 * velocity_1 * velocity_1 * bend
        acceleration_2 = push / (own - d2 * d2 / d1)
        acceleration_1 = -(d2 * acceleration_2 + phi1) / d1
        return jnp.stack([velocity_1, velocity_2, acceleration_1, acceleration_2])

    @host_unless_traced
    def equilibrium(self) -> tuple[State, Control]:
        return xp.array([np.pi, 0.0, 0.0, 0.0]), xp.zeros(1)
