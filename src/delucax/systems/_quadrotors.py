"""Quadrotors, in a vertical plane and in space."""

from collections.abc import Callable
from typing import Literal

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array

from .._check import check_choice
from .._jax import host_unless_traced, xp
from .._module import function_field, parameter, positive
from .._typing import Control, Disturbance, Real, Scalar, State, Time, Vector
from ..math import cos, sin
from ._base import AbstractSystem


class PlanarQuadrotor(AbstractSystem):
    r"""A quadrotor in a vertical plane, driven by the thrusts of its two rotors.

    $$\begin{aligned}
    m \ddot x &= -(u_\mathrm{left} + u_\mathrm{right}) \sin\theta + F_x \\
    m \ddot y &= (u_\mathrm{left} + u_\mathrm{right}) \cos\theta - m g + F_y \\
    m l \ddot\theta &= u_\mathrm{right} - u_\mathrm{left}
    \end{aligned}$$

    The state is (x [m], y [m], angle [rad], vx [m/s], vy [m/s], rate [rad/s]), the
    control is (left [N], right [N]). The force $F$ is the sum of the `wind` and the
    disturbance (force_x [N], force_y [N]). The vector field is smooth if the wind is a
    smooth function. Thrusts may have either sign.

    **Arguments:**

    - `mass`: $m$ [kg], 0.1 by default.
    - `length`: $l$ [m], 0.2 by default.
    - `gravity`: $g$ [m/s^2], 9.81 by default.
    - `wind`: a function `(t, x) -> force` that returns a force of shape `(2,)` [N],
        such as [`delucax.systems.DissipativeWind`][],
        [`delucax.systems.ConstantWind`][] or [`delucax.systems.VortexWind`][]; none by
        default.

    **Raises:** `ValueError` if a mass or length is not positive, a number is not finite
    or the wind is not a function.

    Source: Gradu et al., 2021 (Deluca).

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp

        gusts = lambda t, x: 0.1 * jnp.stack([jnp.sin(t), 0.0 * t])
        quadrotor = dlx.systems.PlanarQuadrotor(wind=gusts)
        quadrotor.vector_field(0.0, jnp.zeros(6), jnp.array([0.5, 0.5]), None)
        ```

        ```text
        Array([0.  , 0.  , 0.  , 0.  , 0.19, 0.  ], dtype=float32)
        ```
    """

    mass: Real = parameter(0.1, constraint=positive)
    length: Real = parameter(0.2, constraint=positive)
    gravity: Real = parameter(9.81)
    wind: Callable[..., Array] | None = function_field(None, of="t, x")

    state_names = ("x", "y", "angle", "vx", "vy", "rate")
    state_units = ("m", "m", "rad", "m/s", "m/s", "rad/s")
    control_names, control_units = ("left", "right"), ("N", "N")
    angle_names = ("angle",)
    disturbance_names = ("force_x", "force_y")

    def vector_field(self, t: Time, x: State, u: Control, w: Disturbance) -> State:
        thrust, lean = (u[0] + u[1]) / self.mass, x[2]
        # Angles are counter-clockwise: a positive angle leans to the left, towards -x.
        ax, ay = -thrust * sin(lean), thrust * cos(lean) - self.gravity
        wind = None if self.wind is None else self.wind(t, x)
        if wind is not None and jnp.shape(wind) != (2,):
            raise ValueError(
                "PlanarQuadrotor: wind must return a force of shape (2,), got shape "
                f"{jnp.shape(wind)}."
            )
        for force in (wind, w):
            if force is not None:
                ax, ay = ax + force[0] / self.mass, ay + force[1] / self.mass
        # The inertia is m l^2, with all mass at the rotors, as in Deluca.
        turn = (u[1] - u[0]) / (self.mass * self.length)
        return jnp.stack([x[3], x[4], x[5], ax, ay, turn])

    def equilibrium(self) -> tuple[State, Control]:
        """Hovering at the origin, leaning against the wind that blows at the origin at
        time 0.

        If the wind changes with time, the quadrotor does not stay at this point.

        **Returns:** the state, shape `(6,)`, and half of the thrust for each rotor,
            shape `(2,)`. Without wind, the zero state and half of the weight for each
            rotor.
        """
        if self.wind is None:
            return _hovering(self.mass, self.gravity)
        weight, level = self.mass * self.gravity, jnp.zeros(6)
        force = self.wind(jnp.zeros(()), level)
        up = weight - force[1]
        # The thrust balances the wind and the weight in size and direction.
        half = (force[0] * force[0] + up * up) ** 0.5 / 2
        return level.at[2].set(jnp.arctan2(force[0], up)), jnp.stack([half, half])


@host_unless_traced
def _hovering(mass: Scalar, gravity: Scalar) -> tuple[State, Control]:
    """The zero state, and half of the weight for each rotor."""
    return xp.zeros(6), xp.stack([mass * gravity / 2] * 2)


class Quadrotor(AbstractSystem):
    r"""A quadrotor in space: a rigid body with four rotors, at front, left, back and
    right.

    $$\dot p = v, \qquad \dot q = \tfrac12 q \otimes (0, \omega), \qquad
    m \dot v = T R(q) e_z - m g e_z - d v + F, \qquad
    J \dot\omega = \tau - \omega \times J \omega$$

    The state has 13 entries: the position $p$ [m], the unit quaternion $q$ = (qw, qx,
    qy, qz) from body to world, the velocity $v$ [m/s] and the body rates $\omega$
    [rad/s]. Position and velocity are those in the world frame, whose z axis points up.
    The disturbance is the force $F$ [N] in the world frame.

    The control is the thrust of each rotor, (front [N], left [N], back [N], right [N]).
    The thrust $T$ of the body is their sum, and its torque is

    $$\tau = \left(l (u_\mathrm{left} - u_\mathrm{right}),\
    l (u_\mathrm{back} - u_\mathrm{front}),\
    k (u_\mathrm{left} + u_\mathrm{right} - u_\mathrm{front} - u_\mathrm{back})\right)$$

    With `inputs="wrench"` the control is the total thrust and the three torques,
    (thrust [N], torque_x [N m], torque_y [N m], torque_z [N m]). The vector field is
    smooth. Thrusts may have either sign.

    `project` normalises the quaternion after each control interval. Because $q$ and
    $-q$ are the same rotation, `difference` uses the one that is closer to the
    reference.

    To design a regulator, linearise [`delucax.Discretized`][] dynamics, not the system
    itself, and pass the `difference` of the system to the regulator. The length of the
    quaternion is not controllable. The discrete-time dynamics set this length to 1 in
    every step. In the linearised system the length of the quaternion is a mode that is
    neither stable nor controllable, so no regulator exists.

    **Arguments:**

    - `mass`: $m$ [kg], 0.716 by default.
    - `arm`: $l$, distance from the centre to a rotor [m], 0.17 by default.
    - `inertia_x`, `inertia_y`, `inertia_z`: the diagonal entries of the inertia matrix
        $J$ [kg m^2], 0.007, 0.007 and 0.012 by default.
    - `moment`: $k$, the yaw torque of a rotor divided by its thrust [m], 0.016 by
        default.
    - `drag`: $d$, drag of the air [N s/m], 0 by default.
    - `gravity`: $g$ [m/s^2], 9.81 by default.
    - `inputs`: `"rotors"` (default) or `"wrench"`.

    **Raises:** `ValueError` if a mass, length or inertia is not positive, a number is
    not finite or `inputs` is neither `"rotors"` nor `"wrench"`.

    Source: Mahony, Kumar and Corke, 2012; Furrer, Burri, Achtelik and Siegwart, 2016
    (RotorS), for the constants of the Hummingbird.

    !!! example

        ```python
        import delucax as dlx

        quadrotor = dlx.systems.Quadrotor(mass=0.8)
        x, u = quadrotor.equilibrium()
        u
        ```

        ```text
        Array([1.962, 1.962, 1.962, 1.962], dtype=float32)
        ```
    """

    mass: Real = parameter(0.716, constraint=positive)
    arm: Real = parameter(0.17, constraint=positive)
    inertia_x: Real = parameter(0.007, constraint=positive)
    inertia_y: Real = parameter(0.007, constraint=positive)
    inertia_z: Real = parameter(0.012, constraint=positive)
    moment: Real = parameter(0.016, constraint=positive)
    drag: Real = parameter(0.0)
    gravity: Real = parameter(9.81)
    inputs: Literal["rotors", "wrench"] = eqx.field(static=True, default="rotors")

    state_names = (
        *("px", "py", "pz", "qw", "qx", "qy", "qz"),
        *("vx", "vy", "vz", "rate_x", "rate_y", "rate_z"),
    )
    state_units = (
        *("m", "m", "m", "1", "1", "1", "1"),
        *("m/s", "m/s", "m/s", "rad/s", "rad/s", "rad/s"),
    )
    disturbance_names = ("force_x", "force_y", "force_z")

    def __check_init__(self):
        check_choice(self.inputs, ("rotors", "wrench"), "inputs", "Quadrotor")

    @property
    def control_names(self) -> tuple[str, ...]:
        """The names of the rotors, or of the thrust and the torques."""
        if self.inputs == "rotors":
            return ("front", "left", "back", "right")
        return ("thrust", "torque_x", "torque_y", "torque_z")

    @property
    def control_units(self) -> tuple[str, ...]:
        """Newtons for thrusts, newton metres for torques."""
        return ("N",) * 4 if self.inputs == "rotors" else ("N", "N m", "N m", "N m")

    def wrench(self, u: Control) -> Control:
        """The thrust and the torque of the rotors on the body.

        **Arguments:** `u`: control, shape `(4,)`.

        **Returns:** (thrust [N], three torques [N m]), shape `(4,)`.
        """
        if self.inputs == "wrench":
            return u
        front, left, back, right = u[0], u[1], u[2], u[3]
        thrust = front + left + back + right
        # r x F with x forward, y left and z up. The rotor at (0, l, 0) rolls with +l,
        # the rotor at (l, 0, 0) pitches with -l: nose up is negative.
        roll, pitch = self.arm * (left - right), self.arm * (back - front)
        # Left and right turn one way, front and back the other.
        yaw = self.moment * (left + right - front - back)
        return jnp.stack([thrust, roll, pitch, yaw])

    def vector_field(self, t: Time, x: State, u: Control, w: Disturbance) -> State:
        qw, qx, qy, qz = x[3], x[4], x[5], x[6]
        a, b, c = x[10], x[11], x[12]
        wrench = self.wrench(u)
        lift, pull = wrench[0] / self.mass, self.drag / self.mass
        # The third column of R(q), along which the rotors push.
        ax = 2 * (qx * qz + qw * qy) * lift - pull * x[7]
        ay = 2 * (qy * qz - qw * qx) * lift - pull * x[8]
        az = (1 - 2 * (qx * qx + qy * qy)) * lift - pull * x[9] - self.gravity
        if w is not None:
            push = 1 / self.mass
            ax, ay, az = ax + push * w[0], ay + push * w[1], az + push * w[2]
        jx, jy, jz = self.inertia_x, self.inertia_y, self.inertia_z
        # Body rates multiply q from the right. World rates would multiply it from the
        # left.
        turning = [
            -0.5 * (qx * a + qy * b + qz * c),
            0.5 * (qw * a + qy * c - qz * b),
            0.5 * (qw * b + qz * a - qx * c),
            0.5 * (qw * c + qx * b - qy * a),
        ]
        spin = [
            (wrench[1] - (jz - jy) * b * c) / jx,
            (wrench[2] - (jx - jz) * c * a) / jy,
            (wrench[3] - (jy - jx) * a * b) / jz,
        ]
        return jnp.stack([x[7], x[8], x[9], *turning, ax, ay, az, *spin])

    @staticmethod
    def project(x: State) -> State:
        """The state with its quaternion normalised to length 1.

        **Arguments:** `x`: state, shape `(13,)`.

        **Returns:** the projected state, shape `(13,)`.
        """
        square = x[3] * x[3] + x[4] * x[4] + x[5] * x[5] + x[6] * x[6]
        # A quaternion of zeros has no direction: it is returned unchanged, not NaN.
        scale = jnp.where(square > 0, square, 1.0) ** -0.5
        q = [scale * x[i] for i in range(3, 7)]
        return jnp.stack([x[0], x[1], x[2], *q, *(x[i] for i in range(7, 13))])

    @staticmethod
    def difference(x: State, x_ref: State) -> State:
        r"""The deviation `x - x_ref`. The quaternions $q$ and $-q$ are the same
        rotation; the deviation uses the one that is closer to that of `x_ref`.

        **Arguments:** `x`: state, shape `(13,)`. `x_ref`: the state to measure from,
            shape `(13,)`.

        **Returns:** the deviation, shape `(13,)`.
        """
        # The cosine of half the angle between the rotations. If it is negative, -q is
        # closer.
        along = sum(x[i] * x_ref[i] for i in range(3, 7))
        sign = jnp.where(along < 0, -1.0, 1.0).astype(x.dtype)
        q = [sign * x[i] - x_ref[i] for i in range(3, 7)]
        d = x - x_ref
        return jnp.stack([d[0], d[1], d[2], *q, *(d[i] for i in range(7, 13))])

    @staticmethod
    def rotation(x: State) -> Vector:
        """The rotation matrix from body to world.

        **Arguments:** `x`: state, shape `(13,)`, with a quaternion of length 1.

        **Returns:** its entries row by row, shape `(9,)`.
        """
        w, a, b, c = x[3], x[4], x[5], x[6]
        # Hamilton's convention, i j = k, with the real part first. JPL's convention
        # would give the transpose.
        entries = [
            *(1 - 2 * (b * b + c * c), 2 * (a * b - w * c), 2 * (a * c + w * b)),
            *(2 * (a * b + w * c), 1 - 2 * (a * a + c * c), 2 * (b * c - w * a)),
            *(2 * (a * c - w * b), 2 * (b * c + w * a), 1 - 2 * (a * a + b * b)),
        ]
        return jnp.stack(entries)

    @host_unless_traced
    def equilibrium(self) -> tuple[State, Control]:
        """Hovering at the origin.

        **Returns:** the state, level and at rest, shape `(13,)`, and a quarter of the
            weight for each rotor (or the weight and zero torques), shape `(4,)`.
        """
        x = xp.array([0.0] * 3 + [1.0] + [0.0] * 9)
        weight = self.mass * self.gravity
        if self.inputs == "rotors":
            return x, xp.stack([weight / 4] * 4)
        return x, xp.stack([weight, *[xp.zeros_like(weight)] * 3])
