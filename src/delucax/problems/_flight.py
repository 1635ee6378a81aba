"""Problems of flight: a rocket that climbs, a glider in an updraft."""

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
    r"""A rocket that climbs through an atmosphere, in units of the radius of the earth,
    its gravity and the first mass:

    `h' = v`, `v' = (u - D) / m - 1 / h^2`, `m' = -u / c`, with the drag
    `D = drag v^2 exp(-decay (h - 1))`.

    **Arguments:**

    - `drag`: 310 by default.
    - `decay`: of the density of the air with height, 500 by default.
    - `exhaust`: the speed `c` of what it throws off, 0.5 by default.

    Source: Goddard, 1919; Bryson, 1999; Dolan, More and Munson, 2004.

    !!! example

        ```python
        import delucax as dlx

        dlx.problems.GoddardRocket(drag=300.0)
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
    r"""The greatest height at the end, with the mass 0.6 there, from rest at the height
    1 with the mass 1, and `0 <= u <= 3.5`, `h >= 1`, `v >= 0`. The time is free. The
    bounds `0.6 <= m <= 1` of the benchmark follow from the others. The height is
    1.01283. The best thrust is full, then between its bounds (a singular arc), then
    none.

    It starts from a line to the height 1.01, half thrust and a duration of 0.2.

    **Arguments:** `steps`: T, 100 by default.

    Source: Goddard, 1919; Bryson, 1999; Dolan, More and Munson, 2004.

    !!! example

        ```python
        import delucax as dlx

        dlx.problems.goddard_rocket().unknowns.duration
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
    r"""A hang glider that crosses an updraft, with the lift coefficient as its control:

    `x' = v_x`, `y' = v_y`, `v_x' = -(L sin eta + D cos eta) / m`,
    `v_y' = (L cos eta - D sin eta) / m - g`,

    in air that rises by `updraft (1 - r) exp(-r)`, `r = (x / 100 - 2.5)^2`. With the
    velocity `(v_x, w)` relative to the air and its size `v`, `sin eta = w / v`,
    `D = (drag + induced u^2) rho S v^2 / 2` and `L = u rho S v^2 / 2`. Lengths are in
    metres, times in seconds.

    **Arguments:**

    - `updraft`: [m/s], 2.5 by default.
    - `mass`: [kg], 100 by default.
    - `drag`, `induced`: the coefficients of drag, 0.034 and 0.069662 by default.
    - `area`: S [m^2], 14 by default.
    - `density`: rho [kg/m^3], 1.13 by default.
    - `gravity`: [m/s^2], 9.81 by default.

    Source: Bulirsch, Nerz, Pesch and von Stryk, 1993; Dolan, More and Munson, 2004.

    !!! example

        ```python
        import delucax as dlx

        dlx.problems.HangGlider(updraft=2.0)
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
        # The forces over the mass, each times the speed: no root of a zero is taken.
        speed = jnp.sqrt(v_x**2 + rising**2)
        size = self.density * self.area * speed / (2 * self.mass)
        drag = (self.drag + self.induced * u[0] ** 2) * size
        lift = u[0] * size
        dv_x = -lift * rising - drag * v_x
        dv_y = lift * v_x - drag * rising - self.gravity
        return jnp.stack([v_x, v_y, dv_x, dv_y])


def hang_glider(steps: int = 200) -> OptimalControl:
    r"""The greatest distance `x` at the end, from `(0, 1000)` down to a height of 900
    with the same velocity `(13.23, -1.288)`, with `0 <= u <= 1.4`, `x >= 0` and
    `v_x >= 0`. The time is free.

    The distance is 1248.03 m (Betts). That of the benchmark, 1255.05 m, is an error of
    its discretisation, by the trapezoidal rule.

    It starts from a lift of 0.7 for 100 s.

    **Arguments:** `steps`: T, 200 by default.

    Source: Bulirsch, Nerz, Pesch and von Stryk, 1993; Betts, 2010; Dolan, More and
    Munson, 2004.

    !!! example

        ```python
        import delucax as dlx

        dlx.problems.hang_glider(50).dynamics.state_names
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
