"""Plants with impacts: a ball that bounces, and a wheel of spokes that rolls."""

from collections.abc import Sequence

import jax.numpy as jnp

from .._module import parameter, positive
from .._typing import Control, Disturbance, Real, Scalar, State, Time
from ..math import cos, sin
from ._hybrid_base import AbstractHybridSystem


class BouncingBall(AbstractHybridSystem):
    r"""A ball that falls with quadratic drag and bounces off the ground.

    $$m \ddot h = F - m g - d\, \dot h |\dot h|, \qquad
    \dot h^+ = -e\, \dot h^- \text{ when } h \text{ falls to } 0$$

    Here $h$ is the height and $F$ the force. The state is (height [m], velocity [m/s]),
    the control is (force [N]).

    If bounces lose energy, infinitely many bounces happen in finite time. The control
    interval that would contain infinitely many bounces ends with the status
    `RESULTS.too_many_events`, and the ball is on the ground then.

    **Arguments:**

    - `mass`: $m$ [kg], 1 by default.
    - `gravity`: $g$ [m/s^2], 9.81 by default.
    - `drag`: $d$ [kg/m], 0 by default.
    - `restitution`: $e$, the fraction of its speed that the ball keeps in a bounce, 0.8
        by default.

    **Raises:** `ValueError` if the mass or the restitution is not positive, or a number
    is not finite.

    Source: Goebel, Sanfelice and Teel, 2012 (the model and its accumulation).

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp

        ball = dlx.systems.BouncingBall(restitution=0.9)
        dynamics = dlx.Discretized(ball, dt=0.1)
        dlx.open_loop(dynamics, jnp.array([1.0, 0.0]), jnp.zeros((10, 1)))[-1]
        ```

        ```text
        Array([ 0.711, -1.394], dtype=float32)
        ```
    """

    mass: Real = parameter(1.0, constraint=positive)
    gravity: Real = parameter(9.81)
    drag: Real = parameter(0.0)
    restitution: Real = parameter(0.8, constraint=positive)

    state_names, state_units = ("height", "velocity"), ("m", "m/s")
    control_names, control_units = ("force",), ("N",)
    event_names = ("bounce",)

    def vector_field(self, t: Time, x: State, u: Control, w: Disturbance) -> State:
        pull = u[0] - self.drag * x[1] * jnp.abs(x[1])
        return jnp.stack([x[1], pull / self.mass - self.gravity])

    def guards(self, t: Time, x: State, u: Control) -> Sequence[Scalar]:
        return (x[0],)

    def resets(self, t: Time, x: State, u: Control) -> Sequence[State]:
        return (jnp.stack([x[0], -self.restitution * x[1]]),)


class RimlessWheel(AbstractHybridSystem):
    r"""A wheel of spokes without a rim, which rolls down a slope from spoke to spoke.

    $$\ddot\theta = \frac{g}{l} \sin\theta + \frac{\tau}{m l^2}$$

    Here $\theta$ is the angle of the spoke that stands on the ground, measured from the
    vertical and positive downhill, and $\tau$ is the torque. The next spoke hits the
    ground at $\theta = \gamma + \alpha$. Angular momentum about the new foot is
    conserved, so that

    $$\theta^+ = \theta^- - 2 \alpha, \qquad
    \dot\theta^+ = \cos(2 \alpha)\, \dot\theta^-$$

    When the wheel rolls back, the spoke behind hits the ground in the same way. The
    state is (angle [rad], velocity [rad/s]), the control is (torque [N m]).

    Steady rolling is a limit cycle: each step multiplies a small deviation from the
    cycle by $\cos^2(2 \alpha)$.

    **Arguments:**

    - `length`: $l$, the length of a spoke [m], 1 by default.
    - `mass`: $m$, the mass of the wheel, which is concentrated at the hub [kg], 1 by
        default.
    - `gravity`: $g$ [m/s^2], 9.81 by default.
    - `half`: $\alpha$, half the angle between spokes [rad], pi / 8 by default.
    - `slope`: $\gamma$, the slope of the ground [rad], 0.08 by default.

    **Raises:** `ValueError` if the length, mass or half angle is not positive, or a
    number is not finite.

    Source: McGeer, 1990; Coleman, Chatterjee and Ruina, 1997.

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp

        wheel = dlx.systems.RimlessWheel(slope=0.1)
        dynamics = dlx.Discretized(wheel, dt=0.05)
        dlx.open_loop(dynamics, jnp.array([0.0, 1.0]), jnp.zeros((40, 1)))[-1]
        ```

        ```text
        Array([-0.096,  0.893], dtype=float32)
        ```
    """

    length: Real = parameter(1.0, constraint=positive)
    mass: Real = parameter(1.0, constraint=positive)
    gravity: Real = parameter(9.81)
    half: Real = parameter(float(jnp.pi / 8), constraint=positive)
    slope: Real = parameter(0.08)

    state_names, state_units = ("angle", "velocity"), ("rad", "rad/s")
    control_names, control_units = ("torque",), ("N m",)
    event_names = ("step", "step back")

    def vector_field(self, t: Time, x: State, u: Control, w: Disturbance) -> State:
        drive = u[0] / (self.mass * self.length**2)
        return jnp.stack([x[1], self.gravity / self.length * sin(x[0]) + drive])

    def guards(self, t: Time, x: State, u: Control) -> Sequence[Scalar]:
        lean = x[0] - self.slope
        return self.half - lean, self.half + lean

    def resets(self, t: Time, x: State, u: Control) -> Sequence[State]:
        lean, kept = x[0] - self.slope, cos(2 * self.half) * x[1]
        step, back = lean - 2 * self.half, lean + 2 * self.half
        return tuple(jnp.stack([self.slope + new, kept]) for new in (step, back))
