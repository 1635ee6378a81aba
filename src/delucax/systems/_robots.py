"""Robots on the ground: cars as bicycles, on wheels that roll where they point and on
tyres that slip; and an arm of two links."""

import jax.numpy as jnp

from .._jax import host_unless_traced, xp
from .._module import parameter, positive
from .._typing import Control, Disturbance, Real, State, Time, Vector
from ..math import cos, sin
from ._base import AbstractSystem


class KinematicBicycle(AbstractSystem):
    r"""A car whose wheels roll without slip, as a bicycle about its centre of mass:

    `dx/dt = speed cos(heading + slip)`, `dy/dt = speed sin(heading + slip)`,
    `d(heading)/dt = speed sin(slip) / rear`, `d(speed)/dt = acceleration`,
    `tan(slip) = rear / (front + rear) tan(steering)`.

    The state is (x [m], y [m], heading [rad], speed [m/s]), the control is
    (acceleration [m/s^2], steering [rad]). Smooth for steering inside +-pi/2, where the
    tangent ends.

    **Arguments:**

    - `front`, `rear`: from the centre of mass to the axles [m], 1.105 and 1.738 by
        default.

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
    """

    front: Real = parameter(1.105, constraint=positive)
    rear: Real = parameter(1.738, constraint=positive)

    state_names, state_units = ("x", "y", "heading", "speed"), ("m", "m", "rad", "m/s")
    control_names, control_units = ("acceleration", "steering"), ("m/s^2", "rad")
    angle_names = ("heading",)

    def vector_field(self, t: Time, x: State, u: Control, w: Disturbance) -> State:
        share = self.rear / (self.front + self.rear)
        # Wheels that roll turn about the point where the axles' lines meet; the slip is
        # the angle of the velocity at the centre of mass to the heading.
        tangent = share * sin(u[1]) / cos(u[1])
        # Cosine and sine of the slip angle, from its tangent: no arctangent is needed.
        along = (1 + tangent * tangent) ** -0.5
        across = tangent * along
        c, s, v = cos(x[2]), sin(x[2]), x[3]
        dx, dy = v * (c * along - s * across), v * (s * along + c * across)
        return jnp.stack([dx, dy, v * across / self.rear, u[0]])

    @host_unless_traced
    def equilibrium(self) -> tuple[State, Control]:
        """Standing at the origin; a standing car is not controllable.

        **Returns:** the zero state and control.
        """
        return xp.zeros(4), xp.zeros(2)


class DynamicBicycle(AbstractSystem):
    r"""A car on tyres whose lateral force is proportional to the slip angle:

    `d(vx)/dt = acceleration - F_f sin(steering) / m + vy rate`,
    `d(vy)/dt = (F_f cos(steering) + F_r) / m - vx rate`,
    `d(rate)/dt = (front F_f cos(steering) - rear F_r) / I`,
    `F_f = -C_f (angle(vy + front rate, vx) - steering)`,
    `F_r = -C_r angle(vy - rear rate, vx)`,

    `angle(v, vx) = atan(v / sqrt(vx^2 + standstill^2))`. The state is (x [m], y [m],
    heading [rad], vx [m/s], vy [m/s], rate [rad/s]), the velocities those of the centre
    of mass along and across the car; the control is (acceleration [m/s^2], steering
    [rad]).

    The slip angle itself, `atan(v / vx)`, has no value at rest: `standstill` is what
    keeps this one smooth there. It is meant for driving forward, much faster than that.

    **Arguments:**

    - `mass`: m [kg], 1573 by default.
    - `inertia`: I, about the vertical axis [kg m^2], 2873 by default.
    - `front`, `rear`: from the centre of mass to the axles [m], 1.1 and 1.58 by
        default.
    - `front_stiffness`, `rear_stiffness`: C_f and C_r, of both tyres of an axle
        [N/rad], 160000 by default.
    - `standstill`: a speed [m/s], 1 by default.

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
        # The angle from where a tyre points to where it moves; the force is against it.
        slip_front = jnp.arctan2(vy + self.front * rate, speed) - u[1]
        slip_rear = jnp.arctan2(vy - self.rear * rate, speed)
        force_front = -self.front_stiffness * slip_front
        force_rear = -self.rear_stiffness * slip_rear
        c, s = cos(heading), sin(heading)
        dx, dy = vx * c - vy * s, vx * s + vy * c
        aside = force_front * cos(u[1])
        # vy rate and -vx rate: the axes that the velocities are given in turn.
        along = u[0] - force_front * sin(u[1]) / self.mass + vy * rate
        across = (aside + force_rear) / self.mass - vx * rate
        turn = (self.front * aside - self.rear * force_rear) / self.inertia
        return jnp.stack([dx, dy, rate, along, across, turn])

    @host_unless_traced
    def equilibrium(self) -> tuple[State, Control]:
        """Standing at the origin.

        **Returns:** the zero state and control.
        """
        return xp.zeros(6), xp.zeros(2)


class Reacher(AbstractSystem):
    r"""Two massless links with a point mass at the end of each, and a torque at each
    joint:

    `M(q) d2q/dt2 = u + h(q, dq/dt) - G(q)`, `q = (shoulder, elbow)`,

    `M11 = (m1 + m2) l1^2 + m2 l2^2 + 2 m2 l1 l2 cos(elbow)`,
    `M12 = m2 l2^2 + m2 l1 l2 cos(elbow)`, `M22 = m2 l2^2`.

    The state is (shoulder [rad], elbow [rad], their rates), the control two torques
    [N m]. The shoulder's angle is measured from the x axis, the elbow's from the first
    link, so the arm is stretched along x at zero. The vector field is smooth.

    A positive `gravity` pulls **along the x axis**, towards the arm stretched at zero,
    and a negative one away from it: this is what the paper's experiments change to make
    a plant that differs from its model. For ordinary gravity, let the x axis point
    down.

    **Arguments:**

    - `mass_1`, `mass_2`: [kg], 1 by default.
    - `length_1`, `length_2`: [m], 1 by default.
    - `gravity`: [m/s^2], 0 by default.

    **Raises:** `ValueError` if a mass or length is not positive, or a number is not
    finite.

    Source: Gradu et al., 2021 (Deluca); Spong, Hutchinson and Vidyasagar, 2006.

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp

        arm = dlx.systems.Reacher(gravity=-10.0)
        arm.vector_field(0.0, jnp.array([0.8, 1.6, 0.0, 0.0]), jnp.zeros(2), None)
        arm.tip(jnp.zeros(4))
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
        """The position of the hand.

        **Arguments:** `x`: state.

        **Returns:** shape `(2,)` [m].
        """
        l1, l2, both = self.length_1, self.length_2, x[0] + x[1]
        return jnp.stack([l1 * along(x[0]) + l2 * along(both) for along in (cos, sin)])

    def vector_field(self, t: Time, x: State, u: Control, w: Disturbance) -> State:
        m2, l1, l2 = self.mass_2, self.length_1, self.length_2
        total = self.mass_1 + m2
        d1, d2 = x[2], x[3]
        c, s = cos(x[1]), sin(x[1])
        coupling = m2 * l1 * l2
        # Gravity pulls along x: its torque is as the sine of the angle from there.
        far = m2 * l2 * self.gravity * sin(x[0] + x[1])
        near = total * l1 * self.gravity * sin(x[0])
        # M a = b, with the Coriolis and centrifugal forces on the right.
        b1 = u[0] + coupling * (2 * d1 + d2) * d2 * s - far - near
        b2 = u[1] - coupling * (d1 * d1) * s - far
        m22 = m2 * l2**2
        m12 = m22 + coupling * c
        m11 = total * l1**2 + m22 + 2 * coupling * c
        # The determinant without the cancellation of m11 m22 - m12^2.
        determinant = m22 * l1**2 * (self.mass_1 + m2 * (s * s))
        a1 = (m22 * b1 - m12 * b2) / determinant
        a2 = (m11 * b2 - m12 * b1) / determinant
        return jnp.stack([d1, d2, a1, a2])

    @host_unless_traced
    def equilibrium(self) -> tuple[State, Control]:
        """The arm stretched along the x axis, at rest.

        **Returns:** the zero state and control.
        """
        return xp.zeros(4), xp.zeros(2)
