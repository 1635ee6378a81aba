"""Quadrotors, in a vertical plane and in space, and the winds that push them."""

import abc
from collections.abc import Callable
from typing import Literal

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from .._check import check_choice
from .._jax import host_unless_traced, xp
from .._module import check_parameters, function_field, parameter, positive
from .._typing import Control, Disturbance, Real, Scalar, State, Time, Vector
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
    """

    mass: Real = parameter(0.1, constraint=positive)
    length: Real = parameter(0.2, constraint=positive)
    gravity: Real = parameter(9.81)
    wind: Callable[..., Array] | None = function_field(None)

    state_names = ("x", "y", "angle", "vx", "vy", "rate")
    state_units = ("m", "m", "rad", "m/s", "m/s", "rad/s")
    control_names, control_units = ("left", "right"), ("N", "N")
    angle_names = ("angle",)
    disturbance_names = ("force_x", "force_y")

    def vector_field(self, t: Time, x: State, u: Control, w: Disturbance) -> State:
        thrust, lean = (u[0] + u[1]) / self.mass, x[2]
        # Angles are counter-clockwise: a positive one leans to the left, towards -x.
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
        # (right - left) l / I with I = m l^2, all mass at the rotors, as in Deluca.
        turn = (u[1] - u[0]) / (self.mass * self.length)
        return jnp.stack([x[3], x[4], x[5], ax, ay, turn])

    def equilibrium(self) -> tuple[State, Control]:
        """Hovering at the origin, leaning against the wind that blows there at time 0.

        An equilibrium for as long as the wind depends on nothing but the place.

        **Returns:** the state, and a half of the thrust for each rotor; without wind
            the zero state, and a half of the weight.
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
    """At rest, and a half of the weight for each rotor."""
    return xp.zeros(6), xp.stack([mass * gravity / 2] * 2)


class Quadrotor(AbstractSystem):
    r"""A rigid body with four rotors, at front, left, back and right:

    `dp/dt = v`, `dq/dt = q (0, omega) / 2`,
    `m dv/dt = thrust R(q) e_z - m g e_z - drag v + F`,
    `J domega/dt = torque - omega x J omega`, `J` diagonal.

    The state is the position p [m] and, after the unit quaternion q = (qw, qx, qy, qz)
    from body to world, the velocity v [m/s], both in a world whose z axis points up,
    and the body rates omega [rad/s]. The disturbance is the force F [N] in the world.

    The control is the thrust of each rotor [N], with

    `thrust = front + left + back + right`,
    `torque = (l (left - right), l (back - front), k (left + right - front - back))`,

    or, with `inputs="wrench"`, (thrust [N], torque [N m]) itself. Smooth, and takes
    thrusts of either sign.

    `project` puts the quaternion back on the unit sphere after each control interval,
    and `difference` takes that one of q and -q which is closer to the reference. Design
    a regulator on the linearisation of [`delucax.Discretized`][], which projects, and
    give it this `difference`. The length of the quaternion is not controllable: the
    projection makes it 1 after one step, while in the linearisation of the system
    itself it is a marginal mode, for which no regulator exists.

    **Arguments:**

    - `mass`: m [kg], 0.716 by default.
    - `arm`: l, from the centre to a rotor [m], 0.17 by default.
    - `inertia_x`, `inertia_y`, `inertia_z`: J [kg m^2], 0.007, 0.007 and 0.012 by
        default.
    - `moment`: k, torque per thrust of a rotor [m], 0.016 by default.
    - `drag`: of the air [N s/m], 0 by default.
    - `gravity`: g [m/s^2], 9.81 by default.
    - `inputs`: `"rotors"` (default) or `"wrench"`.

    **Raises:** `ValueError` if a mass, length or inertia is not positive, a number is
    not finite or `inputs` is neither of the two.

    Source: Mahony, Kumar and Corke, 2012; Furrer, Burri, Achtelik and Siegwart, 2016
    (RotorS), for the constants of the Hummingbird.

    !!! example

        ```python
        import delucax as dlx

        quadrotor = dlx.systems.Quadrotor(mass=0.8)
        x, u = quadrotor.equilibrium()
        quadrotor.vector_field(0.0, x, u, None)
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
        """Those of the rotors, or of the thrust and torque."""
        if self.inputs == "rotors":
            return ("front", "left", "back", "right")
        return ("thrust", "torque_x", "torque_y", "torque_z")

    @property
    def control_units(self) -> tuple[str, ...]:
        """Newtons, and newton metres."""
        return ("N",) * 4 if self.inputs == "rotors" else ("N", "N m", "N m", "N m")

    def wrench(self, u: Control) -> Control:
        """The thrust and torque of the rotors on the body.

        **Arguments:** `u`: control.

        **Returns:** (thrust [N], torque [N m]), shape `(4,)`.
        """
        if self.inputs == "wrench":
            return u
        front, left, back, right = u[0], u[1], u[2], u[3]
        thrust = front + left + back + right
        # r x F with x forward, y left and z up: the rotor at (0, l, 0) rolls by +l, and
        # that at (l, 0, 0) pitches by -l, nose up being negative.
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
        # q (0, omega) / 2, and Euler's equations.
        # Rates in the body multiply q from the right; those in the world would do so
        # from the left. In Euler's equations (J omega) x omega couples the axes.
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
        """`x` with a quaternion of length 1.

        **Arguments:** `x`: state.

        **Returns:** the projected state.
        """
        square = x[3] * x[3] + x[4] * x[4] + x[5] * x[5] + x[6] * x[6]
        # A quaternion of zeros has no direction: it is returned unchanged, not NaN.
        scale = jnp.where(square > 0, square, 1.0) ** -0.5
        q = [scale * x[i] for i in range(3, 7)]
        return jnp.stack([x[0], x[1], x[2], *q, *(x[i] for i in range(7, 13))])

    @staticmethod
    def difference(x: State, x_ref: State) -> State:
        """`x - x_ref`, with q or -q, which represent the same rotation, whichever is
        closer to the quaternion of `x_ref`.

        **Arguments:** `x`: state. `x_ref`: the state to measure from.

        **Returns:** the deviation, a vector.
        """
        # The cosine of half the angle between the two: below zero, -q is the closer
        # one.
        along = sum(x[i] * x_ref[i] for i in range(3, 7))
        sign = jnp.where(along < 0, -1.0, 1.0).astype(x.dtype)
        q = [sign * x[i] - x_ref[i] for i in range(3, 7)]
        d = x - x_ref
        return jnp.stack([d[0], d[1], d[2], *q, *(d[i] for i in range(7, 13))])

    @staticmethod
    def rotation(x: State) -> Vector:
        """The rotation matrix from body to world.

        **Arguments:** `x`: state, with a quaternion of length 1.

        **Returns:** its entries row by row, shape `(9,)`.
        """
        w, a, b, c = x[3], x[4], x[5], x[6]
        # Hamilton's convention, i j = k, with the real part first; that of JPL gives
        # the transpose.
        entries = [
            *(1 - 2 * (b * b + c * c), 2 * (a * b - w * c), 2 * (a * c + w * b)),
            *(2 * (a * b + w * c), 1 - 2 * (a * a + c * c), 2 * (b * c - w * a)),
            *(2 * (a * c - w * b), 2 * (b * c + w * a), 1 - 2 * (a * a + b * b)),
        ]
        return jnp.stack(entries)

    @host_unless_traced
    def equilibrium(self) -> tuple[State, Control]:
        """Hovering at the origin.

        **Returns:** the state, level and at rest, and a quarter of the weight for each
            rotor.
        """
        x = xp.array([0.0] * 3 + [1.0] + [0.0] * 9)
        weight = self.mass * self.gravity
        if self.inputs == "rotors":
            return x, xp.stack([weight / 4] * 4)
        return x, xp.stack([weight, *[xp.zeros_like(weight)] * 3])


class _AbstractWind(eqx.Module):
    """A force in the plane, a function of time and the state."""

    def __check_init__(self):
        check_parameters(self)

    @abc.abstractmethod
    def __call__(self, t: Time, x: State) -> Vector:
        """The force.

        **Arguments:** `t`: time. `x`: a state whose first two entries are the position.

        **Returns:** shape `(2,)`.
        """


class DissipativeWind(_AbstractWind):
    """The force `strength (x, y)`.

    The name is the paper's. Despite it, a positive strength destabilises: the force
    points away from the origin and grows with the distance.

    **Arguments:**

    - `strength`: [N/m], 0.1 by default.

    **Raises:** `ValueError` if the strength is not finite.

    Source: Gradu et al., 2021 (Deluca).

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp

        dlx.systems.DissipativeWind(0.4)(0.0, jnp.array([1.0, 2.0]))
        ```
    """

    strength: Real = parameter(0.1)

    def __call__(self, t: Time, x: State) -> Vector:
        return jnp.stack([self.strength * x[0], self.strength * x[1]])


class ConstantWind(_AbstractWind):
    """The force `strength (cos(direction), sin(direction))`.

    **Arguments:**

    - `strength`: [N], 0.1 by default.
    - `direction`: [rad], pi / 4 by default.

    **Raises:** `ValueError` if a number is not finite.

    Source: Gradu et al., 2021 (Deluca).

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp

        dlx.systems.ConstantWind(0.4)(0.0, jnp.zeros(6))
        ```
    """

    strength: Real = parameter(0.1)
    direction: Real = parameter(np.pi / 4)

    def __call__(self, t: Time, x: State) -> Vector:
        along, across = jnp.cos(self.direction), jnp.sin(self.direction)
        return jnp.stack([self.strength * along, self.strength * across])


class VortexWind(_AbstractWind):
    """The force of vortices that turn counter-clockwise about their centres c,

    `strength sum_c 2 core turn(p - c) / (|p - c|^2 + core^2)`, `turn(x, y) = (-y, x)`.

    One vortex is strongest, `strength`, at the distance `core` from its centre, rotates
    as a solid inside and dies out as 1 / distance outside. Smooth everywhere.

    **Arguments:**

    - `strength`: [N], 0.1 by default.
    - `core`: the radius of the core [m], 0.25 by default.
    - `centres`: shape `(n, 2)` [m]; (1, 0), (0.5, 0.5) and (0, 1) by default.

    **Raises:** `ValueError` if a number is not finite, the core is not positive or the
        centres are not pairs.

    Source: Gradu et al., 2021 (Deluca), for the centres; Scully, 1975, for the profile.

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp

        dlx.systems.VortexWind(0.4)(0.0, jnp.array([1.0, 2.0]))
        ```
    """

    strength: Real = parameter(0.1)
    core: Real = parameter(0.25, constraint=positive)
    centres: Real = parameter(((1.0, 0.0), (0.5, 0.5), (0.0, 1.0)))

    def __check_init__(self):
        check_parameters(self)
        if self.centres.ndim != 2 or self.centres.shape[1] != 2:
            raise ValueError(
                f"VortexWind: centres must have shape (n, 2), got {self.centres.shape}."
            )

    def __call__(self, t: Time, x: State) -> Vector:
        centres = self.centres.astype(x.dtype)
        across, along = jnp.zeros((), x.dtype), jnp.zeros((), x.dtype)
        for i in range(centres.shape[0]):
            dx, dy = x[0] - centres[i, 0], x[1] - centres[i, 1]
            # 2 core r / (r^2 + core^2) is 1 at r = core, where it is largest.
            size = 2 * self.core / (dx * dx + dy * dy + self.core**2)
            across, along = across - size * dy, along + size * dx
        return jnp.stack([self.strength * across, self.strength * along])
