"""Problems of flight: a climbing rocket, and a hang glider in an updraft."""

import math

import jax.numpy as jnp

from .._check import check_count
from .._module import parameter, positive
from .._typing import Control, Disturbance, Real, State, Time
from ..dynamics import Discretized
from ..planning import Constraints, Unknowns
from ..systems import AbstractSystem
from ._base import FinalState, line, OptimalControl, Reach


class GoddardRocket(AbstractSystem):
    r"""A rocket that climbs through an atmosphere.

    $$\dot h = v, \qquad \dot v = \frac{u - D}{m} - \frac{1}{h^2}, \qquad
    \dot m = -\frac{u}{c}, \qquad D = \mathrm{drag}\, v^2 e^{-\mathrm{decay}\,(h - 1)}$$

    The height $h$ is the distance from the centre of the earth. Lengths are in units of
    the radius of the earth, accelerations in units of the gravity at the surface of the
    earth, and masses in units of the initial mass of the rocket.

    **Arguments:**

    - `drag`: the coefficient of the drag $D$, 310 by default.
    - `decay`: the rate at which the density of the air falls with height, 500 by
        default.
    - `exhaust`: $c$, the exhaust speed, 0.5 by default.

    Source: Goddard, 1919; Bryson, 1999; Dolan, More and Munson, 2004.

    !!! example

        ```python
        import delucax as dlx

        dlx.problems.GoddardRocket(drag=300.0)
        ```

        ```text
        GoddardRocket(drag=300.0, decay=500.0, exhaust=0.5)
        ```
    """

    drag: Real = parameter(310.0, constraint=positive)
    decay: Real = parameter(500.0, constraint=positive)
    exhaust: Real = parameter(0.5, constraint=positive)

    state_names, control_names = ("height", "speed", "mass"), ("thrust",)

    def vector_field(self, t: Time, x: State, u: Control, w: Disturbance) -> State:
        h, v, m = x[0], x[1], x[2]
        drag = self.drag * v**2 * jnp.exp(-self.decay * (h - 1))
        return jnp.stack([v, (u[0] - drag) / m - 1 / h**2, -u[0] / self.exhaust])


def goddard_rocket(steps: int = 100) -> OptimalControl:
    r"""Climb as high as possible with the given fuel.

    The final height is maximised. The rocket starts at rest at height 1 with mass 1,
    and ends with mass 0.6. The bounds are $0 \le u \le 3.5$, $h \ge 1$ and $v \ge 0$;
    the duration is free. The bounds $0.6 \le m \le 1$ of the benchmark need not be
    imposed, because they follow from the initial and the final mass. The published
    maximum is 1.01283. The optimal thrust is full at first, then between its bounds (a
    singular arc), then zero.

    The first guess is a straight line from the start to height 1.01, with half thrust
    and a duration of 0.2.

    **Arguments:** `steps`: T, the number of steps, 100 by default.

    **Returns:** a [`delucax.problems.OptimalControl`][].

    Source: Goddard, 1919; Bryson, 1999; Dolan, More and Munson, 2004.

    !!! example

        ```python
        import delucax as dlx

        dlx.problems.goddard_rocket().reference
        ```

        ```text
        1.01283
        ```
    """
    T = check_count(steps, "steps", "goddard_rocket")
    begin = [1.0, 0.0, 1.0]
    low, high = [1.0, 0.0, -math.inf], [math.inf, math.inf, math.inf]
    return OptimalControl(
        Discretized(GoddardRocket(), 0.2 / T),
        FinalState(jnp.array([-1.0, 0.0, 0.0])),
        jnp.array(begin),
        jnp.full((T, 1), 1.75),
        1.01283,
        line(begin, [1.01, 0.0, 0.6], T),
        (0.0, 3.5),
        Constraints(final_equality=Reach(jnp.array([0.6]), (2,)), states=(low, high)),
        Unknowns(duration=(0.01, 1.0)),
        is_maximised=True,
    )


class HangGlider(AbstractSystem):
    r"""A hang glider that crosses an updraft. The control $u$ is the lift coefficient.

    $$\dot x = v_x, \quad \dot y = v_y, \quad
    \dot v_x = -\frac{L \sin\eta + D \cos\eta}{m}, \quad
    \dot v_y = \frac{L \cos\eta - D \sin\eta}{m} - g$$

    $$D = \frac{(\mathrm{drag} + \mathrm{induced}\, u^2) \rho S v^2}{2}, \qquad
    L = \frac{u \rho S v^2}{2}$$

    The air rises with the speed $\mathrm{updraft}\,(1 - r) e^{-r}$, where
    $r = (x / 100 - 2.5)^2$. The velocity relative to the air is $(v_x, w)$. The speed
    relative to the air is $v$, and $\sin\eta = w / v$. Lengths are in m, times in s.

    **Arguments:**

    - `updraft`: the largest speed of the updraft [m/s], 2.5 by default.
    - `mass`: $m$ [kg], 100 by default.
    - `drag`, `induced`: the drag coefficients, 0.034 and 0.069662 by default.
    - `area`: $S$, the area of the wing [m^2], 14 by default.
    - `density`: $\rho$, the density of the air [kg/m^3], 1.13 by default.
    - `gravity`: $g$ [m/s^2], 9.81 by default.

    Source: Bulirsch, Nerz, Pesch and von Stryk, 1993; Dolan, More and Munson, 2004.

    !!! example

        ```python
        import delucax as dlx

        dlx.problems.HangGlider(updraft=2.0).state_names
        ```

        ```text
        ('x', 'y', 'v_x', 'v_y')
        ```
    """

    updraft: Real = parameter(2.5)
    mass: Real = parameter(100.0, constraint=positive)
    drag: Real = parameter(0.034, constraint=positive)
    induced: Real = parameter(0.069662, constraint=positive)
    area: Real = parameter(14.0, constraint=positive)
    density: Real = parameter(1.13, constraint=positive)
    gravity: Real = parameter(9.81, constraint=positive)

    state_names, state_units = ("x", "y", "v_x", "v_y"), ("m", "m", "m/s", "m/s")
    control_names = ("lift",)

    def vector_field(self, t: Time, x: State, u: Control, w: Disturbance) -> State:
        v_x, v_y = x[2], x[3]
        r = (x[0] / 100 - 2.5) ** 2
        rising = v_y - self.updraft * (1 - r) * jnp.exp(-r)
        # The forces per mass are divided by the speed here and multiplied by the
        # components of the velocity below, so no quotient by the speed is needed.
        speed = jnp.sqrt(v_x**2 + rising**2)
        size = self.density * self.area * speed / (2 * self.mass)
        drag = (self.drag + self.induced * u[0] ** 2) * size
        lift = u[0] * size
        dv_x = -lift * rising - drag * v_x
        dv_y = lift * v_x - drag * rising - self.gravity
        return jnp.stack([v_x, v_y, dv_x, dv_y])


def hang_glider(steps: int = 200) -> OptimalControl:
    r"""Glide as far as possible through an updraft.

    The final distance $x$ is maximised. The glider starts at $(0, 1000)$ and ends at a
    height of 900. The velocity of the glider is $(13.23, -1.288)$ at the start and at
    the end. The bounds are $0 \le u \le 1.4$, $x \ge 0$ and $v_x \ge 0$; the duration
    is free.

    The maximum is 1248.03 m (Betts). The benchmark gives 1255.05 m, which includes the
    error of a discretisation by the trapezoidal rule. The first guess is the constant
    lift coefficient $u = 0.7$ for 100 s.

    **Arguments:** `steps`: T, the number of steps, 200 by default.

    **Returns:** a [`delucax.problems.OptimalControl`][].

    Source: Bulirsch, Nerz, Pesch and von Stryk, 1993; Betts, 2010; Dolan, More and
    Munson, 2004.

    !!! example

        ```python
        import delucax as dlx

        dlx.problems.hang_glider(50).reference
        ```

        ```text
        1248.03
        ```
    """
    T = check_count(steps, "steps", "hang_glider")
    inf = math.inf
    low, high = [0.0, -inf, 0.0, -inf], [inf, inf, inf, inf]
    at_end = jnp.array([900.0, 13.23, -1.288])
    return OptimalControl(
        Discretized(HangGlider(), 100.0 / T, substeps=4),
        FinalState(jnp.array([-1.0, 0.0, 0.0, 0.0])),
        jnp.array([0.0, 1000.0, 13.23, -1.288]),
        jnp.full((T, 1), 0.7),
        1248.03,
        None,
        (0.0, 1.4),
        Constraints(final_equality=Reach(at_end, (1, 2, 3)), states=(low, high)),
        Unknowns(duration=(10.0, 200.0)),
        is_maximised=True,
    )
