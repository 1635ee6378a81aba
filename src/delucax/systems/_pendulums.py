"""Pendulums that are moved at their pivots: two on a cart, and one on a turning arm."""

import jax.numpy as jnp

from .._jax import host_unless_traced, xp
from .._module import parameter, positive
from .._typing import Control, Disturbance, Real, State, Time
from ..math import cos, sin
from ._base import AbstractSystem


class DoublePendulumCart(AbstractSystem):
    r"""A cart that carries two uniform rods, one on top of the other. A force pushes
    the cart along a track without friction.

    $$\begin{aligned}
    d_1 \ddot p + d_2 c_1 \ddot\theta_1 + d_3 c_2 \ddot\theta_2
    &= F + d_2 s_1 \dot\theta_1^2 + d_3 s_2 \dot\theta_2^2 \\
    d_2 c_1 \ddot p + d_4 \ddot\theta_1 + d_5 c_{12} \ddot\theta_2
    &= d_2 g s_1 - d_5 s_{12} \dot\theta_2^2 \\
    d_3 c_2 \ddot p + d_5 c_{12} \ddot\theta_1 + d_6 \ddot\theta_2
    &= d_3 g s_2 + d_5 s_{12} \dot\theta_1^2
    \end{aligned}$$

    Here $p$ is the position of the cart. The symbols $c_i$ and $s_i$ are the cosine and
    sine of $\theta_i$, and $c_{12}$ and $s_{12}$ are the cosine and sine of
    $\theta_1 - \theta_2$. The constants are $d_1 = M + m_1 + m_2$,
    $d_2 = (m_1 / 2 + m_2) l_1$, $d_3 = m_2 l_2 / 2$, $d_4 = (m_1 / 3 + m_2) l_1^2$,
    $d_5 = m_2 l_1 l_2 / 2$ and $d_6 = m_2 l_2^2 / 3$.

    The state is (position [m], angle_1 [rad], angle_2 [rad], velocity [m/s], spin_1
    [rad/s], spin_2 [rad/s]), the control is (force [N]). Both angles are measured from
    upright. A rod with a positive angle leans in the direction of positive positions of
    the cart. The vector field is smooth.

    **Arguments:**

    - `cart_mass`: $M$ [kg], 1.5 by default.
    - `mass_1`, `mass_2`: $m_1$ and $m_2$, masses of the lower and the upper rod [kg],
        0.5 and 0.75 by default.
    - `length_1`, `length_2`: $l_1$ and $l_2$, lengths of the rods [m], 0.5 and 0.75 by
        default.
    - `gravity`: $g$ [m/s^2], 9.8 by default.

    **Raises:** `ValueError` if a mass or length is not positive, or a number is not
    finite.

    Source: Bogdanov, 2004.

    !!! example

        ```python
        import delucax as dlx

        upright = dlx.linearize(dlx.systems.DoublePendulumCart(length_2=0.6))
        upright.A[3:, :3]  # from positions to accelerations
        ```

        ```text
        Array([[  0.   ,  -7.35 ,   0.787],
               [  0.   ,  73.5  , -33.075],
               [  0.   , -73.5  ,  63.875]], dtype=float32)
        ```
    """

    cart_mass: Real = parameter(1.5, constraint=positive)
    mass_1: Real = parameter(0.5, constraint=positive)
    mass_2: Real = parameter(0.75, constraint=positive)
    length_1: Real = parameter(0.5, constraint=positive)
    length_2: Real = parameter(0.75, constraint=positive)
    gravity: Real = parameter(9.8)

    state_names = ("position", "angle_1", "angle_2", "velocity", "spin_1", "spin_2")
    state_units = ("m", "rad", "rad", "m/s", "rad/s", "rad/s")
    control_names, control_units = ("force",), ("N",)
    angle_names = ("angle_1", "angle_2")

    def vector_field(self, t: Time, x: State, u: Control, w: Disturbance) -> State:
        m1, m2, l1, l2 = self.mass_1, self.mass_2, self.length_1, self.length_2
        s1, c1, s2, c2 = sin(x[1]), cos(x[1]), sin(x[2]), cos(x[2])
        sine, cosine = s1 * c2 - c1 * s2, c1 * c2 + s1 * s2  # of the difference
        d2, d3, d5 = (m1 / 2 + m2) * l1, m2 * l2 / 2, m2 * l1 * l2 / 2
        square_1, square_2 = x[4] * x[4], x[5] * x[5]
        b0 = u[0] + d2 * s1 * square_1 + d3 * s2 * square_2
        b1 = d2 * self.gravity * s1 - d5 * sine * square_2
        b2 = d3 * self.gravity * s2 + d5 * sine * square_1
        # Solves M a = b by cofactors, for the inertia M = [[m, p, q], [p, i, r], [q, r,
        # j]].
        m = self.cart_mass + m1 + m2
        i, j = (m1 / 3 + m2) * l1**2, m2 * l2**2 / 3
        p, q, r = d2 * c1, d3 * c2, d5 * cosine
        mm, mp, mq = i * j - r * r, q * r - p * j, p * r - q * i
        ii, jj, ij = m * j - q * q, m * i - p * p, p * q - m * r
        scale = 1 / (m * mm + p * mp + q * mq)
        accelerations = [
            scale * (mm * b0 + mp * b1 + mq * b2),
            scale * (mp * b0 + ii * b1 + ij * b2),
            scale * (mq * b0 + ij * b1 + jj * b2),
        ]
        return jnp.stack([x[3], x[4], x[5], *accelerations])

    @host_unless_traced
    def equilibrium(self) -> tuple[State, Control]:
        """Both rods upright and at rest, with the cart at position 0.

        **Returns:** the zero state and control, shapes `(6,)` and `(1,)`.
        """
        return xp.zeros(6), xp.zeros(1)


class FurutaPendulum(AbstractSystem):
    r"""The Furuta pendulum: a pendulum at the end of an arm that a motor turns in the
    horizontal plane.

    $$\begin{aligned}
    (J_0 + J_2 \sin^2\theta) \ddot\phi + K \cos\theta\, \ddot\theta
    &= \tau - b_1 \dot\phi - 2 J_2 \sin\theta \cos\theta\, \dot\phi \dot\theta
    + K \sin\theta\, \dot\theta^2 \\
    J_2 \ddot\theta + K \cos\theta\, \ddot\phi
    &= m g l \sin\theta - b_2 \dot\theta + J_2 \sin\theta \cos\theta\, \dot\phi^2 \\
    \tau &= \frac{k}{R} (v - k \dot\phi)
    \end{aligned}$$

    Here $\phi$ is the angle of the arm, $\theta$ that of the pendulum, $v$ the voltage,
    $J_0 = J_1 + m L^2$ and $K = m L l$.

    The state is (arm [rad], angle [rad], arm_rate [rad/s], spin [rad/s]), the control
    is (voltage [V]). The pendulum is upright at angle 0. With a positive angle, it
    leans in the direction in which an arm with a positive rate turns. The vector field
    is smooth.

    The default constants are those of Quanser's QUBE-Servo 2: an arm of 95 g and 85 mm,
    and a rod of 24 g and 129 mm. The inertias of the arm and of the rod are computed as
    those of thin rods about their ends.

    **Arguments:**

    - `arm_inertia`: $J_1$, inertia of the arm about the motor [kg m^2], 2.288e-4 by
        default.
    - `arm_length`: $L$ [m], 0.085 by default.
    - `mass`: $m$, mass of the pendulum [kg], 0.024 by default.
    - `center`: $l$, distance from the hinge to the pendulum's centre of mass [m],
        0.0645 by default.
    - `inertia`: $J_2$, inertia of the pendulum about the hinge [kg m^2], 1.331e-4 by
        default.
    - `arm_friction`, `friction`: $b_1$ and $b_2$, the friction of the arm and of the
        pendulum [N m s/rad], 1e-3 and 5e-5 by default.
    - `motor_constant`: $k$ [N m/A], 0.042 by default.
    - `resistance`: $R$ [ohm], 8.4 by default.
    - `gravity`: $g$ [m/s^2], 9.81 by default.

    **Raises:** `ValueError` if a mass, length, inertia or resistance is not positive,
    or a number is not finite.

    Source: Furuta, Yamakita and Kobayashi, 1992; Cazzolato and Prime, 2011 (the
    equations).

    !!! example

        ```python
        import delucax as dlx

        upright = dlx.linearize(dlx.systems.FurutaPendulum(mass=0.03))
        upright.B[2:]  # from the voltage to the accelerations
        ```

        ```text
        Array([[ 20.635],
               [-25.499]], dtype=float32)
        ```
    """

    arm_inertia: Real = parameter(2.288e-4, constraint=positive)
    arm_length: Real = parameter(0.085, constraint=positive)
    mass: Real = parameter(0.024, constraint=positive)
    center: Real = parameter(0.0645, constraint=positive)
    inertia: Real = parameter(1.331e-4, constraint=positive)
    arm_friction: Real = parameter(1e-3)
    friction: Real = parameter(5e-5)
    motor_constant: Real = parameter(0.042)
    resistance: Real = parameter(8.4, constraint=positive)
    gravity: Real = parameter(9.81)

    state_names = ("arm", "angle", "arm_rate", "spin")
    state_units = ("rad", "rad", "rad/s", "rad/s")
    control_names, control_units = ("voltage",), ("V",)
    angle_names = ("angle",)

    def vector_field(self, t: Time, x: State, u: Control, w: Disturbance) -> State:
        s, c, rate, spin = sin(x[1]), cos(x[1]), x[2], x[3]
        j2, k = self.inertia, self.motor_constant
        coupling = self.mass * self.arm_length * self.center
        arm = self.arm_inertia + self.mass * self.arm_length**2
        torque = k / self.resistance * (u[0] - k * rate)
        b1 = torque - self.arm_friction * rate + coupling * s * (spin * spin)
        b1 = b1 - 2 * j2 * s * c * rate * spin
        b2 = self.mass * self.gravity * self.center * s - self.friction * spin
        b2 = b2 + j2 * s * c * (rate * rate)
        m11, m12 = arm + j2 * (s * s), coupling * c
        determinant = m11 * j2 - m12 * m12
        turn = (j2 * b1 - m12 * b2) / determinant
        swing = (m11 * b2 - m12 * b1) / determinant
        return jnp.stack([rate, spin, turn, swing])

    @host_unless_traced
    def equilibrium(self) -> tuple[State, Control]:
        """The pendulum upright and at rest, and the arm at 0.

        **Returns:** the zero state and control, shapes `(4,)` and `(1,)`.
        """
        return xp.zeros(4), xp.zeros(1)
