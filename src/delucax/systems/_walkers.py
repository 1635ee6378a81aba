"""Walkers without knees that walk down a slope without control."""

from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np

from .._module import parameter, positive
from .._typing import BoolScalar, Control, Disturbance, Real, Scalar, State, Time
from ..math import cos, sin
from ._hybrid_base import AbstractHybridSystem


class SimplestWalker(AbstractHybridSystem):
    r"""The simplest walker: two straight legs on a slope, with point feet that are far
    lighter than the hip.

    $$\ddot\theta = \sin(\theta - \gamma), \qquad
    \ddot\phi = \ddot\theta + \dot\theta^2 \sin\phi - \cos(\theta - \gamma) \sin\phi
    + \tau$$

    Here $\theta$ is the angle of the stance leg, $\phi$ the angle of the swing leg from
    the stance leg and $\tau$ the torque at the hip. The unit of length is the length
    $l$ of a leg, and the unit of time is $\sqrt{l / g}$. The swing foot strikes the
    ground when $\phi = 2 \theta$ and the stance leg has already passed the normal of
    the slope. Earlier in the step, $\phi = 2 \theta$ also holds when the legs pass each
    other, but the foot does not strike then. The state is (stance, stance rate, swing,
    swing rate), the control is (torque).

    **Arguments:**

    - `slope`: $\gamma$ [rad], 0.009 by default.

    **Raises:** `ValueError` if the slope is not finite.

    Source: Garcia, Chatterjee, Ruina and Coleman, 1998.

    !!! example

        ```python
        import delucax as dlx

        dynamics = dlx.Discretized(dlx.systems.SimplestWalker(), dt=0.1)
        start = [0.2003, -0.1998, 0.4006, -0.0158]
        dlx.analysis.poincare_map(dynamics, "step", start).time
        ```

        ```text
        Array(3.884, dtype=float32)
        ```
    """

    slope: Real = parameter(0.009)

    state_names = ("stance", "stance rate", "swing", "swing rate")
    control_names, time_unit = ("torque",), "sqrt(l/g)"
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
    r"""The compass-gait walker: two straight legs on a slope, with a mass on each leg
    and one at the hip.

    $$M(q) \ddot q + N(q, \dot q) + G(q) = (-\tau, \tau), \qquad
    q = (q_\mathrm{swing}, q_\mathrm{stance})$$

    Both angles are measured from the vertical, and $\tau$ is the torque at the hip. The
    swing foot strikes the ground when
    $q_\mathrm{swing} + q_\mathrm{stance} = -2 \gamma$ and the swing leg is ahead. This
    impact conserves two angular momenta: that of the whole walker about the foot that
    strikes, and that of the other leg about the hip. The legs exchange their names. The
    state is (swing [rad], stance [rad], swing rate [rad/s], stance rate [rad/s]), the
    control is (torque [N m]).

    **Arguments:**

    - `leg_mass`: mass of a leg [kg], concentrated at the distance `lower` from the
        foot; 5 by default.
    - `hip_mass`: mass at the hip [kg], 10 by default.
    - `lower`, `upper`: distances from the foot to the leg's mass and from this mass to
        the hip [m], 0.5 by default.
    - `gravity`: [m/s^2], 9.81 by default. The numbers in the cited paper were computed
        with a gravity of 9.8.
    - `slope`: $\gamma$ [rad], 3 degrees by default.

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

        ```text
        Array(0.735, dtype=float32)
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
        # The height of the swing foot above the slope, in lengths of a leg.
        return (cos(x[1] + self.slope) - cos(x[0] + self.slope),)

    def enabled(self, t: Time, x: State, u: Control) -> Sequence[BoolScalar]:
        # A leg without a knee scuffs the ground as the legs pass; that is no step.
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
