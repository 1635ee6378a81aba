"""Walkers without knees that go down a slope by themselves."""

from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np

from .._module import parameter, positive
from .._typing import BoolScalar, Control, Disturbance, Real, Scalar, State, Time
from ..math import cos, sin
from ._hybrid_base import AbstractHybridSystem


class SimplestWalker(AbstractHybridSystem):
    r"""Two straight legs with point feet far lighter than the hip, on a slope:

    `d2(stance)/dt2 = sin(stance - slope)` and
    `d2(swing)/dt2 = d2(stance)/dt2 + (d(stance)/dt)^2 sin(swing)
    - cos(stance - slope) sin(swing) + torque`

    in units of the leg and of `sqrt(length / gravity)`. The swing leg, at the angle
    `swing` from the stance leg, strikes where `swing = 2 stance`, once the stance leg
    has passed the normal of the slope: the legs' passing before is no event. The state
    is (stance, stance rate, swing, swing rate), the control is (torque) at the hip.

    **Arguments:**

    - `slope`: [rad], 0.009 by default.

    **Raises:** `ValueError` if the slope is not finite.

    Source: Garcia, Chatterjee, Ruina and Coleman, 1998.

    !!! example

        ```python
        import delucax as dlx

        dynamics = dlx.Discretized(dlx.systems.SimplestWalker(), dt=0.1)
        start = [0.2003, -0.1998, 0.4006, -0.0158]
        dlx.analysis.poincare_map(dynamics, "step", start).time
        ```
    """

    slope: Real = parameter(0.009)

    state_names = ("stance", "stance rate", "swing", "swing rate")
    control_names = ("torque",)
    event_names, event_directions = ("step",), (1,)

    def vector_field(self, t: Time, x: State, u: Control, w: Disturbance) -> State:
        stance, rate, swing, swing_rate = x
        lean = stance - self.slope
        falls = sin(lean)
        swings = falls + (rate**2 - cos(lean)) * sin(swing) + u[0]
        return jnp.stack([rate, falls, swing_rate, swings])

    def guards(self, t: Time, x: State, u: Control) -> Sequence[Scalar]:
        return (x[2] - 2 * x[0],)

    def enabled(self, t: Time, x: State, u: Control) -> Sequence[BoolScalar]:
        return (x[0] < -0.05,)

    def resets(self, t: Time, x: State, u: Control) -> Sequence[State]:
        stance, rate, _, _ = x
        kept = cos(2 * stance)
        after = -stance, kept * rate, -2 * stance, kept * (1 - kept) * rate
        return (jnp.stack(after),)


class CompassGait(AbstractHybridSystem):
    r"""Two straight legs with masses and a mass at the hip, on a slope:

    `M(x) q'' + N(x) + G(x) = (-torque, torque)`, `q = (swing, stance)`,

    both angles from the vertical. The swing foot strikes where
    `swing + stance = -2 slope` with the swing leg ahead; angular momentum of the whole
    about the new foot, and of the trailing leg about the hip, are kept, and the legs
    change their names. The state is (swing, stance, swing rate, stance rate) [rad,
    rad/s], the control is (torque) at the hip [N m].

    **Arguments:**

    - `leg_mass`: m [kg], 5 by default, at `lower` from the foot.
    - `hip_mass`: m_H [kg], 10 by default.
    - `lower`, `upper`: a and b, from the foot to the leg's mass and from there to the
        hip [m], 0.5 by default.
    - `gravity`: g [m/s^2], 9.81 by default.
    - `slope`: [rad], of 3 degrees by default.

    The numbers of the source are met with a gravity of 9.8.

    **Raises:** `ValueError` if a mass or length is not positive, or a number is not
    finite.

    Source: Goswami, Thuilot and Espiau, 1998.

    !!! example

        ```python
        import delucax as dlx

        dynamics = dlx.Discretized(dlx.systems.CompassGait(), dt=0.02)
        start = [-0.3234, 0.2187, -0.3772, -1.0918]
        dlx.analysis.poincare_map(dynamics, "step", start).time
        ```
    """

    leg_mass: Real = parameter(5.0, constraint=positive)
    hip_mass: Real = parameter(10.0, constraint=positive)
    lower: Real = parameter(0.5, constraint=positive)
    upper: Real = parameter(0.5, constraint=positive)
    gravity: Real = parameter(9.81)
    slope: Real = parameter(float(np.deg2rad(3.0)))

    state_names = ("swing", "stance", "swing rate", "stance rate")
    state_units = ("rad", "rad", "rad/s", "rad/s")
    control_names, control_units = ("torque",), ("N m",)
    event_names = ("step",)

    def vector_field(self, t: Time, x: State, u: Control, w: Disturbance) -> State:
        swing, stance, swing_rate, stance_rate = x
        m, h, a, b = self.leg_mass, self.hip_mass, self.lower, self.upper
        l = a + b
        coupling = m * l * b
        c, s = cos(stance - swing), sin(stance - swing)
        own, both, whole = m * b**2, -coupling * c, (h + m) * l**2 + m * a**2
        swings = -u[0] - coupling * s * stance_rate**2
        swings = swings - m * b * self.gravity * sin(swing)
        stands = u[0] + coupling * s * swing_rate**2
        stands = stands + (h * l + m * a + m * l) * self.gravity * sin(stance)
        first, second = _solved(own, both, both, whole, swings, stands)
        return jnp.stack([swing_rate, stance_rate, first, second])

    def guards(self, t: Time, x: State, u: Control) -> Sequence[Scalar]:
        # The height of the swing foot above the slope, in legs.
        return (cos(x[1] + self.slope) - cos(x[0] + self.slope),)

    def enabled(self, t: Time, x: State, u: Control) -> Sequence[BoolScalar]:
        # The foot that scuffs the ground as the legs pass is let through.
        return (x[0] - x[1] > 0.1,)

    def resets(self, t: Time, x: State, u: Control) -> Sequence[State]:
        swing, stance, swing_rate, stance_rate = x
        m, h, a, b = self.leg_mass, self.hip_mass, self.lower, self.upper
        l, c = a + b, cos(stance - swing)
        whole = -m * a * b * swing_rate
        whole = whole + (-m * a * b + (h * l**2 + 2 * m * a * l) * c) * stance_rate
        trailing = -m * a * b * stance_rate
        about_foot = m * b * (b - l * c), m * l * (l - b * c) + m * a**2 + h * l**2
        about_hip = m * b**2, -m * b * l * c
        rates = _solved(*about_foot, *about_hip, whole, trailing)
        return (jnp.stack([stance, swing, *rates]),)


def _solved(a, b, c, d, first, second):
    """The solution of two equations with the matrix `[[a, b], [c, d]]`."""
    det = a * d - b * c
    return (d * first - b * second) / det, (a * second - c * first) / det
