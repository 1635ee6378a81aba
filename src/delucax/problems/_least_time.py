"""Minimum-time problems: particle steering and a robot arm."""

import math
from typing import Any

import jax.numpy as jnp

from .._check import check_count
from .._module import parameter, positive
from .._typing import Control, Disturbance, Real, State, Time
from ..dynamics import Discretized
from ..planning import Constraints, Unknowns
from ..systems import AbstractSystem
from ._base import FinalState, line, OptimalControl, Reach


class ParticleSteering(AbstractSystem):
    r"""A particle under a constant force. The control $u$ is the angle of the force.

    $$\dot x = v_x, \qquad \dot y = v_y, \qquad \dot v_x = a \cos u, \qquad
    \dot v_y = a \sin u$$

    **Arguments:** `acceleration`: $a$, 100 by default.

    Source: Bryson and Ho, 1975; Dolan, More and Munson, 2004.

    !!! example

        ```python
        import delucax as dlx

        dlx.problems.ParticleSteering(acceleration=50.0)
        ```

        ```text
        ParticleSteering(acceleration=50.0)
        ```
    """

    acceleration: Real = parameter(100.0, constraint=positive)

    state_names, control_names = ("x", "y", "v_x", "v_y"), ("angle",)

    def vector_field(self, t: Time, x: State, u: Control, w: Disturbance) -> State:
        push = self.acceleration * jnp.stack([jnp.cos(u[0]), jnp.sin(u[0])])
        return jnp.concatenate([x[2:], push])


def particle_steering(steps: int = 100) -> OptimalControl:
    r"""Steer a particle to a height and a velocity in the least time.

    The particle starts at rest at the origin. The particle ends at $y = 5$ with the
    velocity $(45, 0)$. The bounds are $|u| \le \pi / 2$. The published minimum time is
    0.554577. The first guess is a straight line from the start to the end, with an
    angle of zero and a duration of 1.

    **Arguments:** `steps`: T, the number of steps, 100 by default.

    **Returns:** a [`delucax.problems.OptimalControl`][].

    Source: Bryson and Ho, 1975; Dolan, More and Munson, 2004.

    !!! example

        ```python
        import delucax as dlx

        problem = dlx.problems.particle_steering(steps=20)
        problem.horizon, problem.reference
        ```

        ```text
        (20, 0.554577)
        ```
    """
    T = check_count(steps, "steps", "particle_steering")
    return OptimalControl(
        Discretized(ParticleSteering(), 1.0 / T),
        FinalState(),
        jnp.zeros(4),
        jnp.zeros((T, 1)),
        0.554577,
        line([0.0, 0.0, 0.0, 0.0], [0.0, 5.0, 45.0, 0.0], T),
        (-math.pi / 2, math.pi / 2),
        Constraints(final_equality=Reach(jnp.array([5.0, 45.0, 0.0]), (1, 2, 3))),
        Unknowns(duration=(0.01, 10.0)),
    )


class RobotArm(AbstractSystem):
    r"""A robot arm that slides, turns and lifts.

    $$\ddot\rho = \frac{u_1}{L}, \quad \ddot\theta = \frac{u_2}{I_\theta}, \quad
    \ddot\phi = \frac{u_3}{I_\phi}, \quad
    I_\phi = \frac{(L - \rho)^3 + \rho^3}{3}, \quad I_\theta = I_\phi \sin^2 \phi$$

    The two parts of the arm, of length $\rho$ and $L - \rho$, have the inertia of thin
    rods.

    **Arguments:** `length`: $L$, 5 by default.

    Source: Moessner-Beigel, 1995; Dolan, More and Munson, 2004.

    !!! example

        ```python
        import delucax as dlx

        dlx.problems.RobotArm(length=4.0)
        ```

        ```text
        RobotArm(length=4.0)
        ```
    """

    length: Real = parameter(5.0, constraint=positive)

    state_names = ("rho", "theta", "phi", "v_rho", "v_theta", "v_phi")
    control_names = ("slide", "turn", "lift")

    def vector_field(self, t: Time, x: State, u: Control, w: Disturbance) -> State:
        L, rho, phi = self.length, x[0], x[2]
        lift = ((L - rho) ** 3 + rho**3) / 3
        turn = lift * jnp.sin(phi) ** 2
        return jnp.concatenate([x[3:], jnp.stack([u[0] / L, u[1] / turn, u[2] / lift])])


def robot_arm(steps: int = 90) -> OptimalControl:
    r"""Turn a robot arm from rest to rest in the least time.

    The arm moves from $(\rho, \theta, \phi) = (4.5, 0, \pi/4)$ to
    $(4.5, 2\pi/3, \pi/4)$. The bounds are $|u| \le 1$, $0 \le \rho \le 5$,
    $|\theta| \le \pi$ and $0 \le \phi \le \pi$. The published minimum time is 9.14138.
    The first guess is a straight line from the start to the end, with controls of zero
    and a duration of 10.

    For some numbers of steps, for example 100, a control of the solution switches
    exactly at the beginning of a step. In these cases, the derivatives of the solution
    are NaN.

    **Arguments:** `steps`: T, the number of steps, 90 by default.

    **Returns:** a [`delucax.problems.OptimalControl`][].

    Source: Moessner-Beigel, 1995; Dolan, More and Munson, 2004.

    !!! example

        ```python
        import delucax as dlx

        dlx.problems.robot_arm().bounds
        ```

        ```text
        (-1.0, 1.0)
        ```
    """
    T = check_count(steps, "steps", "robot_arm")
    begin = [4.5, 0.0, math.pi / 4, 0.0, 0.0, 0.0]
    end = [4.5, 2 * math.pi / 3, math.pi / 4, 0.0, 0.0, 0.0]
    inf: Any = math.inf
    low = [0.0, -math.pi, 0.0, -inf, -inf, -inf]
    high = [5.0, math.pi, math.pi, inf, inf, inf]
    return OptimalControl(
        Discretized(RobotArm(), 10.0 / T),
        FinalState(),
        jnp.array(begin),
        jnp.zeros((T, 3)),
        9.14138,
        line(begin, end, T),
        (-1.0, 1.0),
        Constraints(
            final_equality=Reach(jnp.array(end), tuple(range(6))), states=(low, high)
        ),
        Unknowns(duration=(0.1, 100.0)),
    )
