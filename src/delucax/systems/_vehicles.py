"""Vehicles at their limits: a quadrotor that carries a load, and a car that drifts."""

from typing import Any

import jax.numpy as jnp
import numpy as np

from .._check import is_concrete
from .._jax import host_unless_traced, xp
from .._message import shortened
from .._module import parameter, positive
from .._typing import Control, Disturbance, Real, Scalar, State, Time, Vector
from ..math import clip, cos, sin
from ._base import AbstractSystem


class SlungLoad(AbstractSystem):
    r"""A quadrotor in a vertical plane that carries a load on a cable.

    $$\begin{aligned}
    (M + m) (a + g e_y) &= (F \cdot q - M l \dot\alpha^2)\, q \\
    M l \ddot\alpha &= -F \cdot \frac{\mathrm{d} q}{\mathrm{d} \alpha} \\
    J \ddot\theta &= d\, (u_\mathrm{right} - u_\mathrm{left})
    \end{aligned}$$

    Here $a$ is the acceleration of the load and
    $F = (u_\mathrm{left} + u_\mathrm{right}) (-\sin\theta, \cos\theta)$ the thrust. The
    unit vector $q = (\sin\alpha, -\cos\alpha)$ points from the quadrotor to the load.
    The cable has no mass and never goes slack: it can push the load like a rod.

    The state is (x [m], y [m], angle $\theta$ [rad], swing $\alpha$ [rad], vx [m/s], vy
    [m/s], rate [rad/s], swing_rate [rad/s]), where x and y are the position of the
    load. The control is (left [N], right [N]), the thrusts of the two rotors. At
    `swing = 0` the load hangs straight below the quadrotor. The vector field is smooth.
    Thrusts may have either sign.

    **Arguments:**

    - `mass`: $M$, mass of the quadrotor [kg], 0.5 by default.
    - `load`: $m$, mass of the load [kg], 0.1 by default.
    - `cable`: $l$, length of the cable [m], 0.5 by default.
    - `arm`: $d$, distance from the centre to a rotor [m], 0.2 by default.
    - `inertia`: $J$ [kg m^2], 0.005 by default.
    - `gravity`: $g$ [m/s^2], 9.81 by default.

    **Raises:** `ValueError` if a mass, length or inertia is not positive, or a number
    is not finite.

    Source: Sreenath, Lee and Kumar, 2013.

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp

        carrier = dlx.systems.SlungLoad(load=0.2)
        x, u = carrier.equilibrium()
        slope = carrier.vector_field(0.0, x.at[3].set(0.1), u, None)
        slope[4:]
        ```

        ```text
        Array([-0.974, -0.098,  0.   , -2.742], dtype=float32)
        ```
    """

    mass: Real = parameter(0.5, constraint=positive)
    load: Real = parameter(0.1, constraint=positive)
    cable: Real = parameter(0.5, constraint=positive)
    arm: Real = parameter(0.2, constraint=positive)
    inertia: Real = parameter(0.005, constraint=positive)
    gravity: Real = parameter(9.81)

    state_names = ("x", "y", "angle", "swing", "vx", "vy", "rate", "swing_rate")
    state_units = ("m", "m", "rad", "rad", "m/s", "m/s", "rad/s", "rad/s")
    control_names, control_units = ("left", "right"), ("N", "N")
    angle_names = ("angle", "swing")

    def quadrotor(self, x: State) -> Vector:
        """The position of the quadrotor.

        **Arguments:** `x`: state, shape `(8,)`.

        **Returns:** the position [m], shape `(2,)`.
        """
        s, c = sin(x[3]), cos(x[3])
        return jnp.stack([x[0] - self.cable * s, x[1] + self.cable * c])

    def vector_field(self, t: Time, x: State, u: Control, w: Disturbance) -> State:
        thrust, s, c = u[0] + u[1], sin(x[3]), cos(x[3])
        fx, fy = -thrust * sin(x[2]), thrust * cos(x[2])
        # Along the cable, load and quadrotor move as one mass. Across it, they do not
        # act on each other.
        along = fx * s - fy * c - self.mass * self.cable * (x[7] * x[7])
        pull = along / (self.mass + self.load)
        swing = -(fx * c + fy * s) / (self.mass * self.cable)
        turn = self.arm * (u[1] - u[0]) / self.inertia
        ax, ay = pull * s, -pull * c - self.gravity
        return jnp.stack([x[4], x[5], x[6], x[7], ax, ay, turn, swing])

    @host_unless_traced
    def equilibrium(self) -> tuple[State, Control]:
        """Hovering, with the load at the origin.

        **Returns:** the zero state, shape `(8,)`, and half of the whole weight for each
            rotor, shape `(2,)`.
        """
        half = (self.mass + self.load) * self.gravity / 2
        return xp.zeros(8), xp.stack([half, half])


class DriftingCar(AbstractSystem):
    r"""A car with rear-wheel drive that can drift: a bicycle model with Fiala's brush
    model of the tyres. The more grip the rear tyre uses for driving, the less remains
    for cornering.

    $$\begin{aligned}
    m \dot v_x &= F - F_f \sin\delta + m v_y r \\
    m \dot v_y &= F_f \cos\delta + F_r - m v_x r \\
    I \dot r &= l_f F_f \cos\delta - l_r F_r
    \end{aligned}$$

    The lateral force of each axle depends on the tangent $z$ of its slip angle:

    $$F_i = -C_i z_i \left(1 - s_i + s_i^2 / 3\right) \text{ with } s_i =
    \frac{C_i |z_i|}{3 G_i} \text{ up to } 1, \qquad
    F_i = -G_i \operatorname{sign}(z_i) \text{ beyond}$$

    At $s_i = 1$ the tyre begins to slide. The grip $G$ is $\mu N_f$ at the front axle
    and $\sqrt{(\mu N_r)^2 - F^2}$ at the rear axle, where $N_f$ and $N_r$ are the loads
    of the axles at rest.

    The state is (vx [m/s], vy [m/s], rate $r$ [rad/s]), where vx and vy are the
    velocities of the centre of mass along and across the car. The control is (force $F$
    [N], steering $\delta$ [rad]), where the force acts on the rear tyre along the car.
    The derivative of the vector field is continuous, except where the driving force
    uses all the grip of the rear tyre.

    In a drift the rear tyre slides, and the car turns to one side while the front
    wheels are steered to the other. A steady drift is an unstable equilibrium: only
    feedback holds the car in the drift.

    Two changes to the original equations make the model valid for all states and
    controls. First, the slip angle of a tyre is not defined at rest. Its tangent is
    therefore computed as $z = v / \sqrt{w^2 + v_0^2}$, where $v$ is the velocity across
    the tyre and $w$ the velocity along the tyre. Second, at least a fiftieth of the
    grip of the rear tyre is kept for cornering, even if driving uses all of the grip.

    **Arguments:**

    - `mass`: $m$ [kg], 1724 by default.
    - `inertia`: $I$, the moment of inertia about the vertical axis [kg m^2], 1300 by
        default.
    - `front`, `rear`: $l_f$ and $l_r$, distances from the centre of mass to the axles
        [m], 1.35 and 1.15 by default.
    - `front_stiffness`, `rear_stiffness`: $C_f$ and $C_r$, the cornering stiffness of
        both tyres of an axle together [N/rad], 120000 and 175000 by default.
    - `grip`: $\mu$, the coefficient of friction, 0.55 by default, the value for wet
        asphalt.
    - `gravity`: $g$ [m/s^2], 9.81 by default.
    - `standstill`: $v_0$ [m/s], 0.1 by default.

    **Raises:** `ValueError` if a number is not positive.

    Source: Voser, Hindiyeh and Gerdes, 2010; Hindiyeh and Gerdes, 2014, who replace
    $\cos\delta$ by 1.

    !!! example

        ```python
        import delucax as dlx

        car = dlx.systems.DriftingCar()
        car.equilibrium(speed=8.0, steering=-0.2)
        ```

        ```text
        (Array([ 8.   , -2.932,  0.602], dtype=float32),
         Array([ 2.268e+03, -2.000e-01], dtype=float32))
        ```
    """

    mass: Real = parameter(1724.0, constraint=positive)
    inertia: Real = parameter(1300.0, constraint=positive)
    front: Real = parameter(1.35, constraint=positive)
    rear: Real = parameter(1.15, constraint=positive)
    front_stiffness: Real = parameter(120000.0, constraint=positive)
    rear_stiffness: Real = parameter(175000.0, constraint=positive)
    grip: Real = parameter(0.55, constraint=positive)
    gravity: Real = parameter(9.81, constraint=positive)
    standstill: Real = parameter(0.1, constraint=positive)

    state_names, state_units = ("vx", "vy", "rate"), ("m/s", "m/s", "rad/s")
    control_names, control_units = ("force", "steering"), ("N", "rad")

    def grips(self) -> tuple[Scalar, Scalar]:
        r"""The largest force of each axle.

        **Returns:** $\mu N_f$ for the front axle and $\mu N_r$ for the rear axle [N],
        scalars.
        """
        whole = self.grip * self.mass * self.gravity / (self.front + self.rear)
        return whole * self.rear, whole * self.front

    def vector_field(self, t: Time, x: State, u: Control, w: Disturbance) -> State:
        vx, vy, rate, force = x[0], x[1], x[2], u[0]
        s, c = sin(u[1]), cos(u[1])
        grip_front, grip_rear = self.grips()
        share = force / grip_rear
        left = jnp.maximum(1 - share * share, 4e-4) ** 0.5
        ahead, aside = vy + self.front * rate, vy - self.rear * rate
        slip_front = self._slip(aside=ahead * c - vx * s, along=vx * c + ahead * s)
        slip_rear = self._slip(aside=aside, along=vx)
        force_front = _brush(slip_front, self.front_stiffness, grip_front)
        force_rear = _brush(slip_rear, self.rear_stiffness, left * grip_rear)
        lateral = force_front * c
        return jnp.stack(
            [
                (force - force_front * s) / self.mass + vy * rate,
                (lateral + force_rear) / self.mass - vx * rate,
                (self.front * lateral - self.rear * force_rear) / self.inertia,
            ]
        )

    def _slip(self, aside: Scalar, along: Scalar) -> Scalar:
        """The tangent of a slip angle."""
        return aside / (along * along + self.standstill**2) ** 0.5

    @host_unless_traced
    def equilibrium(
        self, speed: Any = 8.0, steering: Any = -12 * 2 * np.pi / 360
    ) -> tuple[State, Control]:
        """The drift to the left at a given speed and steering angle.

        **Arguments:**

        - `speed`: vx [m/s], above 0; 8 by default.
        - `steering`: steering angle [rad], negative to the right; -12 degrees by
            default.

        **Returns:** `(x, u)`, shapes `(3,)` and `(2,)`.

        **Raises:** `ValueError` if there is no such drift.
        """
        v, steering = (
            xp.asarray(number, jnp.result_type(float)) for number in (speed, steering)
        )
        s, c = xp.sin(steering), xp.cos(steering)
        grip_front, grip_rear = self.grips()
        ahead, whole = self.front, self.front + self.rear
        slides = 3 * grip_front / self.front_stiffness

        # The rate, force and vy that balance the moments and the lateral forces, when
        # the front tyre uses the share 1 - y^3 of its grip: y is how far its slip is
        # from sliding.
        def balanced(y):
            used = (1 - y**3) * c
            rate = used * self.grip * self.gravity / v
            force = grip_rear * (1 - used * used) ** 0.5
            return rate, force, v * self.rear / whole * s / c - force / self.mass / rate

        def miss(y):
            rate, _, vy = balanced(y)
            moves, slip = vy + ahead * rate, slides * (y - 1)
            along = v * c + moves * s
            along = (along * along + self.standstill**2) ** 0.5
            return rate * (moves * c - v * s - slip * along)

        # Newton's method with differences, which also runs on NumPy.
        y, h = xp.asarray(0.45, v.dtype), 1e-3
        for _ in range(6):
            y = y - 2 * h * miss(y) / (miss(y + h) - miss(y - h))
        rate, force, vy = balanced(y)
        if is_concrete(y) and is_concrete(vy):
            left = self.rear_stiffness * (self.rear * rate - vy) / v
            is_drift = (0 < y) & (y < 1) & (v > 0) & (abs(miss(y)) < 1e-3)
            if not np.all(is_drift & (left > 3 * (grip_rear**2 - force**2) ** 0.5)):
                raise ValueError(
                    "DriftingCar: speed and steering must be those of a drift, such as "
                    f"8 and -0.2, got {shortened(speed)} and {shortened(steering)}."
                )
        return xp.stack([v, vy, rate]), xp.stack([force, steering])


def _brush(slip: Scalar, stiffness: Scalar, grip: Scalar) -> Scalar:
    """The lateral force of a brush tyre."""
    most = 3 * grip / stiffness
    slip = clip(slip, -most, most)
    share = abs(slip) / most
    return -stiffness * slip * (1 - share + share * share / 3)
