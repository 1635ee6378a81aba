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
    r"""A pendulum: a uniform rod hinged at one end, driven by a torque at the hinge.

    $$\ddot\theta = \frac{3 g}{2 l} \sin\theta + \frac{3}{m l^2} \tau - b \dot\theta$$

    Here $\theta$ is the angle from upright and $\tau$ the torque. The state is (angle
    [rad], velocity [rad/s]), the control is (torque [N m]). The vector field is smooth.

    **Arguments:**

    - `mass`: $m$ [kg], 1 by default.
    - `length`: $l$ [m], 1 by default.
    - `gravity`: $g$ [m/s^2], 10 by default, as in Gym.
    - `damping`: viscous friction $b$ [1/s], 0 by default.

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

        ```text
        Array([0.   , 1.248], dtype=float32)
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
        r"""The angular acceleration.

        **Arguments:** `angle` [rad], `velocity` [rad/s], `torque` [N m]: scalars.

        **Returns:** $\ddot\theta$ [rad/s^2], a scalar.
        """
        # A rod has the inertia m l^2 / 3 about its end. The torque of gravity,
        # m g l/2 sin(angle), drives the rod away from upright, so its sign is plus.
        weight = 3 * self.gravity / (2 * self.length) * sin(angle)
        drive = 3 / (self.mass * self.length**2) * torque
        return weight + drive - self.damping * velocity

    def vector_field(self, t: Time, x: State, u: Control, w: Disturbance) -> State:
        return jnp.stack([x[1], self.acceleration(x[0], x[1], u[0])])

    @host_unless_traced
    def equilibrium(self) -> tuple[State, Control]:
        return xp.zeros(2), xp.zeros(1)


class CartPole(AbstractSystem):
    r"""A pole hinged on a cart. A force pushes the cart along a track without friction.

    $$\ddot\theta = \frac{g \sin\theta - a \cos\theta}
    {l \left(\frac43 - \frac{m}{M} \cos^2\theta\right)}, \qquad
    \ddot p = a - \frac{m l}{M} \ddot\theta \cos\theta, \qquad
    a = \frac{F + m l \dot\theta^2 \sin\theta}{M}$$

    Here $p$ is the position, $\theta$ the angle, $F$ the force and $M$ the mass of cart
    and pole together. The state is (position [m], velocity [m/s], angle [rad], spin
    [rad/s]), the control is (force [N]). At angle 0 the pole is upright. At a positive
    angle, the pole leans towards positive positions. The vector field is smooth.

    **Arguments:**

    - `cart_mass`: mass of the cart, $M - m$ [kg], 1 by default.
    - `pole_mass`: $m$ [kg], 0.1 by default.
    - `half_length`: $l$, half the length of the pole [m], 0.5 by default. Gym calls it
        the length.
    - `gravity`: $g$ [m/s^2], 9.8 by default.

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

        ```text
        Array([[ 0.   ,  1.   ,  0.   ,  0.   ],
               [ 0.   ,  0.   , -0.717,  0.   ],
               [ 0.   ,  0.   ,  0.   ,  1.   ],
               [ 0.   ,  0.   , 13.146,  0.   ]], dtype=float32)
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
        r"""The accelerations of the cart and of the pole.

        **Arguments:** `angle` [rad], `spin` [rad/s], `force` [N]: scalars.

        **Returns:** $\ddot p$ [m/s^2] and $\ddot\theta$ [rad/s^2], scalars.
        """
        total = self.cart_mass + self.pole_mass
        moment = self.pole_mass * self.half_length
        lean, upright = sin(angle), cos(angle)
        # The second term is the centrifugal force of the swinging pole on the cart.
        push = (force + moment * (spin * spin) * lean) / total
        # A uniform rod of half-length l has the inertia 4/3 m l^2 about its end.
        inertia = 4 / 3 - self.pole_mass * (upright * upright) / total
        # The minus: a cart that is pushed forwards leaves the pole behind.
        turn = (self.gravity * lean - upright * push) / (self.half_length * inertia)
        return push - moment * turn * upright / total, turn

    def vector_field(self, t: Time, x: State, u: Control, w: Disturbance) -> State:
        acceleration, turn = self.accelerations(x[2], x[3], u[0])
        return jnp.stack([x[1], acceleration, x[3], turn])

    @host_unless_traced
    def equilibrium(self) -> tuple[State, Control]:
        return xp.zeros(4), xp.zeros(1)


class MountainCar(AbstractSystem):
    r"""A car in a valley whose slopes are too steep for its motor.

    $$\ddot p = c\, u - g \cos(3 p)$$

    Here $p$ is the position and $u$ the push. The state is (position, velocity), the
    control is (push). The unit of time is one step, because Gym gives its constants per
    step. Gym integrates by the semi-implicit Euler method with `dt=1`. In this model,
    gravity acts along the position $p$, and not along the slope of the track. The
    vector field is smooth, and has no walls and no speed limit. `equilibrium` is the
    bottom of the valley, $p = -\pi/6$.

    **Arguments:**

    - `power`: $c$, the power of the motor [1/step^2], 0.0015 by default, as in
        `MountainCarContinuous-v0`. `MountainCar-v0` has 0.001.
    - `gravity`: $g$ [1/step^2], 0.0025 by default.

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

        ```text
        Array([0.     , 0.00132], dtype=float32)
        ```
    """

    power: Real = parameter(0.0015)
    gravity: Real = parameter(0.0025)

    state_names, state_units = ("position", "velocity"), ("", "1/step")
    control_names, control_units = ("push",), ("",)
    time_unit = "steps"

    def acceleration(self, position: Array, push: Array) -> Array:
        r"""The acceleration.

        **Arguments:** `position`, `push`: scalars.

        **Returns:** $\ddot p$ [1/step^2], a scalar.
        """
        # cos(3 position) is the slope of `height` over 1.35: gravity acts as if the
        # track were flat.
        return self.power * push - self.gravity * cos(3 * position)

    def height(self, position: ArrayLike) -> Array:
        r"""The height of the track, $0.45 \sin(3 p) + 0.55$, as Gym draws it.

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
    r"""Two links that hang in a chain, with a torque $\tau$ at the joint between them.

    $$\begin{aligned}
    d_1 &= m_1 c_1^2 + m_2 (l_1^2 + c_2^2 + 2 l_1 c_2 \cos\theta_2) + I_1 + I_2 \\
    d_2 &= m_2 (c_2^2 + l_1 c_2 \cos\theta_2) + I_2 \\
    \phi_2 &= m_2 c_2 g \sin(\theta_1 + \theta_2) \\
    \phi_1 &= -m_2 l_1 c_2 (\dot\theta_2^2 + 2 \dot\theta_1 \dot\theta_2) \sin\theta_2
    + (m_1 c_1 + m_2 l_1) g \sin\theta_1 + \phi_2 \\
    \ddot\theta_2 &= \left(\tau + \tfrac{d_2}{d_1} \phi_1
    - m_2 l_1 c_2 \dot\theta_1^2 \sin\theta_2 - \phi_2\right)
    / \left(m_2 c_2^2 + I_2 - d_2^2 / d_1\right) \\
    \ddot\theta_1 &= -(d_2 \ddot\theta_2 + \phi_1) / d_1
    \end{aligned}$$

    The state is (angle_1 [rad], angle_2 [rad], velocity_1 [rad/s], velocity_2 [rad/s]),
    the control is (torque [N m]). The disturbance (push [N m]) is added to the torque.
    At `angle_1 = 0`, the first link hangs down. The angle `angle_2` is measured from
    the direction of the first link. The vector field is smooth. `equilibrium` is the
    upright position, `angle_1 = pi`.

    **Arguments:**

    - `mass_1`, `mass_2`: $m_1$ and $m_2$, masses of the links [kg], 1 by default.
    - `length_1`: $l_1$, length of the first link [m], 1 by default. The length of the
        second link does not enter the equations.
    - `center_1`, `center_2`: $c_1$ and $c_2$, distance from a link's joint to its
        center of mass [m], 0.5 by default.
    - `inertia_1`, `inertia_2`: $I_1$ and $I_2$, inertia of a link about its center of
        mass [kg m^2], 1 by default.
    - `gravity`: $g$ [m/s^2], 9.8 by default.
    - `form`: `"book"` (default) for the equations of motion; or `"nips"` for the
        equations that are printed in the paper of 1996. The equations in this paper
        lack the term in $\dot\theta_1^2$ and do not conserve energy.

    **Raises:** `ValueError` if a mass, length or inertia is not positive, a number is
    not finite, or `form` is neither `"book"` nor `"nips"`.

    Source: Sutton, 1996 (`"nips"`); Sutton and Barto, 2018 (`"book"`); Gymnasium
    (Towers et al., 2023), `Acrobot-v1`.

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp

        acrobot = dlx.systems.Acrobot(mass_2=1.2)
        acrobot.vector_field(0.0, jnp.array([0.1, 0.0, 0.0, 0.0]), jnp.ones(1), None)
        ```

        ```text
        Array([ 0.   ,  0.   , -1.313,  2.237], dtype=float32)
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
        d1 = m1 * c1**2 + m2 * (l1**2 + c2**2 + 2 * l1 * c2 * straight)
        d1 = d1 + self.inertia_1 + self.inertia_2
        d2 = m2 * (c2**2 + l1 * c2 * straight) + self.inertia_2
        # Gym measures angles from the horizontal and writes cos(angle - pi/2). Here
        # angles are measured from hanging down, which makes it the sine.
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
