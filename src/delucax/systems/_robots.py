"""Robots on the ground: two bicycle models of a car, and an arm of two links."""

import jax.numpy as jnp

from .._jax import host_unless_traced, xp
from .._module import parameter, positive
from .._typing import Control, Disturbance, Real, State, Time, Vector
from ..math import cos, sin
from ._base import AbstractSystem


class KinematicBicycle(AbstractSystem):
    r"""The kinematic bicycle: a car whose wheels roll without slip.

    $$\dot x = v \cos(\psi + \beta), \qquad \dot y = v \sin(\psi + \beta), \qquad
    \dot\psi = \frac{v}{l_r} \sin\beta, \qquad \dot v = a, \qquad
    \tan\beta = \frac{l_r}{l_f + l_r} \tan\delta$$

    Here $\beta$ is the slip angle at the centre of mass. The state is (x [m], y [m],
    heading $\psi$ [rad], speed $v$ [m/s]), the control is (acceleration $a$ [m/s^2],
    steering $\delta$ [rad]). The vector field is smooth for steering angles between
    -pi/2 and pi/2, where $\tan\delta$ is finite.

    **Arguments:**

    - `front`, `rear`: $l_f$ and $l_r$, distances from the centre of mass to the axles
        [m], 1.105 and 1.738 by default.

    **Raises:** `ValueError` if a length is not positive.

    Source: Kong, Pfeiffer, Schildbach and Borrelli, 2015.

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp

        car = dlx.systems.KinematicBicycle()
        x, u = jnp.array([0.0, 0.0, 0.0, 10.0]), jnp.array([0.0, 0.1])
        car.vector_field(0.0, x, u, None)
        ```

        ```text
        Array([9.981, 0.612, 0.352, 0.   ], dtype=float32)
        ```
    """

    front: Real = parameter(1.105, constraint=positive)
    rear: Real = parameter(1.738, constraint=positive)

    state_names, state_units = ("x", "y", "heading", "speed"), ("m", "m", "rad", "m/s")
    control_names, control_units = ("acceleration", "steering"), ("m/s^2", "rad")
    angle_names = ("heading",)

    def vector_field(self, t: Time, x: State, u: Control, w: Disturbance) -> State:
        share = self.rear / (self.front + self.rear)
        # The slip is the angle between the velocity at the centre of mass and the
        # heading.
        tangent = share * sin(u[1]) / cos(u[1])
        # The cosine and sine of the slip follow from its tangent without an arctangent.
        along = (1 + tangent * tangent) ** -0.5
        across = tangent * along
        c, s, v = cos(x[2]), sin(x[2]), x[3]
        dx, dy = v * (c * along - s * across), v * (s * along + c * across)
        return jnp.stack([dx, dy, v * across / self.rear, u[0]])

    @host_unless_traced
    def equilibrium(self) -> tuple[State, Control]:
        """Standing at the origin. The linearisation at this equilibrium is not
        controllable, because a standing car cannot turn or move sideways.

        **Returns:** the zero state and control, shapes `(4,)` and `(2,)`.
        """
        return xp.zeros(4), xp.zeros(2)


class DynamicBicycle(AbstractSystem):
    r"""The dynamic bicycle: a car on tyres whose lateral force is proportional to the
    slip angle.

    $$\begin{aligned}
    \dot v_x &= a - F_f \sin(\delta) / m + v_y r \\
    \dot v_y &= (F_f \cos\delta + F_r) / m - v_x r \\
    \dot r &= (l_f F_f \cos\delta - l_r F_r) / I \\
    F_f &= -C_f (\alpha(v_y + l_f r, v_x) - \delta) \\
    F_r &= -C_r\, \alpha(v_y - l_r r, v_x) \\
    \alpha(v, v_x) &= \arctan\left(v / \sqrt{v_x^2 + v_0^2}\right)
    \end{aligned}$$

    The state is (x [m], y [m], heading [rad], vx [m/s], vy [m/s], rate $r$ [rad/s]),
    where vx and vy are the velocities of the centre of mass along and across the car.
    The control is (acceleration $a$ [m/s^2], steering $\delta$ [rad]).

    The exact slip angle, $\arctan(v / v_x)$, is not defined at rest. The model adds
    $v_0^2$ under the root, so that its slip angle is smooth at rest too. Use the model
    for driving forward, at speeds far above $v_0$.

    **Arguments:**

    - `mass`: $m$ [kg], 1573 by default.
    - `inertia`: $I$, the moment of inertia about the vertical axis [kg m^2], 2873 by
        default.
    - `front`, `rear`: $l_f$ and $l_r$, distances from the centre of mass to the axles
        [m], 1.1 and 1.58 by default.
    - `front_stiffness`, `rear_stiffness`: $C_f$ and $C_r$, the cornering stiffness of
        both tyres of an axle together [N/rad], 160000 by default.
    - `standstill`: $v_0$ [m/s], 1 by default.

    **Raises:** `ValueError` if a number is not positive.

    Source: Rajamani, 2012; Kong, Pfeiffer, Schildbach and Borrelli, 2015.

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp

        car = dlx.systems.DynamicBicycle()
        x = jnp.array([0.0, 0.0, 0.0, 20.0, 0.0, 0.0])
        car.vector_field(0.0, x, jnp.array([0.0, 0.02]), None)
        ```

        ```text
        Array([20.   ,  0.   ,  0.   , -0.041,  2.034,  1.225], dtype=float32)
        ```
    """

    mass: Real = parameter(1573.0, constraint=positive)
    inertia: Real = parameter(2873.0, constraint=positive)
    front: Real = parameter(1.1, constraint=positive)
    rear: Real = parameter(1.58, constraint=positive)
    front_stiffness: Real = parameter(160000.0, constraint=positive)
    rear_stiffness: Real = parameter(160000.0, constraint=positive)
    standstill: Real = parameter(1.0, constraint=positive)

    state_names = ("x", "y", "heading", "vx", "vy", "rate")
    state_units = ("m", "m", "rad", "m/s", "m/s", "rad/s")
    control_names, control_units = ("acceleration", "steering"), ("m/s^2", "rad")
    angle_names = ("heading",)

    def vector_field(self, t: Time, x: State, u: Control, w: Disturbance) -> State:
        heading, vx, vy, rate = x[2], x[3], x[4], x[5]
        # Never zero, so that neither the slip angles nor their gradients are NaN.
        speed = (vx * vx + self.standstill**2) ** 0.5
        # The angle from where a tyre points to where it moves.
        slip_front = jnp.arctan2(vy + self.front * rate, speed) - u[1]
        slip_rear = jnp.arctan2(vy - self.rear * rate, speed)
        force_front = -self.front_stiffness * slip_front
        force_rear = -self.rear_stiffness * slip_rear
        c, s = cos(heading), sin(heading)
        dx, dy = vx * c - vy * s, vx * s + vy * c
        aside = force_front * cos(u[1])
        # The terms with the rate: the axes of the velocities turn with the car.
        along = u[0] - force_front * sin(u[1]) / self.mass + vy * rate
        across = (aside + force_rear) / self.mass - vx * rate
        turn = (self.front * aside - self.rear * force_rear) / self.inertia
        return jnp.stack([dx, dy, rate, along, across, turn])

    @host_unless_traced
    def equilibrium(self) -> tuple[State, Control]:
        """Standing at the origin.

        **Returns:** the zero state and control, shapes `(6,)` and `(2,)`.
        """
        return xp.zeros(6), xp.zeros(2)


class Reacher(AbstractSystem):
    r"""A planar arm of two massless links, with a point mass at the end of each link
    and a torque at each joint.

    $$M(q) \ddot q = u + h(q, \dot q) - G(q), \qquad q = (q_1, q_2)$$

    $$M_{11} = (m_1 + m_2) l_1^2 + m_2 l_2^2 + 2 m_2 l_1 l_2 \cos q_2, \qquad
    M_{12} = m_2 l_2^2 + m_2 l_1 l_2 \cos q_2, \qquad M_{22} = m_2 l_2^2$$

    Here $h$ holds the Coriolis and centrifugal torques, and $G$ holds the torques of
    gravity. The state is (shoulder $q_1$ [rad], elbow $q_2$ [rad], shoulder_rate
    [rad/s], elbow_rate [rad/s]), the control is (shoulder_torque [N m], elbow_torque [N
    m]). The angle of the shoulder is measured from the x axis and the angle of the
    elbow from the first link: if both angles are zero, the arm is stretched along the x
    axis. The vector field is smooth.

    If `gravity` is positive, gravity pulls **along the x axis**. If `gravity` is
    negative, it pulls the opposite way. In the experiments of the Deluca paper, the
    plant and its model have different values of `gravity`. For ordinary gravity, pass
    `gravity=9.81` and let the x axis point down.

    **Arguments:**

    - `mass_1`, `mass_2`: $m_1$ and $m_2$ [kg], 1 by default.
    - `length_1`, `length_2`: $l_1$ and $l_2$ [m], 1 by default.
    - `gravity`: the acceleration of gravity along the x axis [m/s^2], 0 by default.

    **Raises:** `ValueError` if a mass or length is not positive, or a number is not
    finite.

    Source: Gradu et al., 2021 (Deluca); Spong, Hutchinson and Vidyasagar, 2006.

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp

        arm = dlx.systems.Reacher(gravity=-10.0)
        x = jnp.array([0.8, 1.6, 0.0, 0.0])
        arm.tip(x), arm.vector_field(0.0, x, jnp.zeros(2), None)
        ```

        ```text
        (Array([-0.041,  1.393], dtype=float32),
         Array([ 0.   ,  0.   ,  7.275, -0.308], dtype=float32))
        ```
    """

    mass_1: Real = parameter(1.0, constraint=positive)
    mass_2: Real = parameter(1.0, constraint=positive)
    length_1: Real = parameter(1.0, constraint=positive)
    length_2: Real = parameter(1.0, constraint=positive)
    gravity: Real = parameter(0.0)

    state_names = ("shoulder", "elbow", "shoulder_rate", "elbow_rate")
    state_units = ("rad", "rad", "rad/s", "rad/s")
    control_names, control_units = ("shoulder_torque", "elbow_torque"), ("N m", "N m")
    angle_names = ("shoulder", "elbow")

    def tip(self, x: State) -> Vector:
        """The position of the tip of the arm.

        **Arguments:** `x`: state, shape `(4,)`.

        **Returns:** the position [m], shape `(2,)`.
        """
        l1, l2, both = self.length_1, self.length_2, x[0] + x[1]
        return jnp.stack([l1 * along(x[0]) + l2 * along(both) for along in (cos, sin)])

    def vector_field(self, t: Time, x: State, u: Control, w: Disturbance) -> State:
        m2, l1, l2 = self.mass_2, self.length_1, self.length_2
        total = self.mass_1 + m2
        d1, d2 = x[2], x[3]
        c, s = cos(x[1]), sin(x[1])
        coupling = m2 * l1 * l2
        # Gravity pulls along x, so its torque grows with the sine of the angle.
        far = m2 * l2 * self.gravity * sin(x[0] + x[1])
        near = total * l1 * self.gravity * sin(x[0])
        # M a = b, with the Coriolis and centrifugal forces on the right.
        b1 = u[0] + coupling * (2 * d1 + d2) * d2 * s - far - near
        b2 = u[1] - coupling * (d1 * d1) * s - far
        m22 = m2 * l2**2
        m12 = m22 + coupling * c
        m11 = total * l1**2 + m22 + 2 * coupling * c
        # Not as m11 m22 - m12^2, which would lose digits.
        determinant = m22 * l1**2 * (self.mass_1 + m2 * (s * s))
        a1 = (m22 * b1 - m12 * b2) / determinant
        a2 = (m11 * b2 - m12 * b1) / determinant
        return jnp.stack([d1, d2, a1, a2])

    @host_unless_traced
    def equilibrium(self) -> tuple[State, Control]:
        """The arm stretched along the x axis, at rest.

        **Returns:** the zero state and control, shapes `(4,)` and `(2,)`.
        """
        return xp.zeros(4), xp.zeros(2)
