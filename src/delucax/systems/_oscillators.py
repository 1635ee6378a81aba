"""Masses on springs, and oscillators whose equations are not linear."""

from dataclasses import KW_ONLY
from typing import Any

import equinox as eqx
import jax.numpy as jnp

from .._check import as_entries, check_count
from .._jax import host_unless_traced, xp
from .._module import parameter, positive
from .._typing import Control, Disturbance, Real, State, Time
from ._base import AbstractSystem


class DoubleIntegrator(AbstractSystem):
    """A mass pushed along a line,

    `m d2(position)/dt2 = force`.

    The state is (position [m], velocity [m/s]), the control is (force [N]).

    **Arguments:**

    - `mass`: m [kg], 1 by default.

    **Raises:** `ValueError` if the mass is not positive.

    Source: Åström and Murray, 2008.

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp

        mass = dlx.systems.DoubleIntegrator()
        mass.vector_field(0.0, jnp.array([1.0, 0.5]), jnp.ones(1), None)
        ```
    """

    mass: Real = parameter(1.0, constraint=positive)

    state_names, state_units = ("position", "velocity"), ("m", "m/s")
    control_names, control_units = ("force",), ("N",)

    def vector_field(self, t: Time, x: State, u: Control, w: Disturbance) -> State:
        return jnp.stack([x[1], u[0] / self.mass])

    @host_unless_traced
    def equilibrium(self) -> tuple[State, Control]:
        return xp.zeros(2), xp.zeros(1)


def _as_count(masses: Any) -> int:
    return check_count(masses, "masses", "MassSpringDamper")


class MassSpringDamper(AbstractSystem):
    """A mass on a spring and a damper, or a chain of them from a wall to the mass that
    the force acts on:

    `m_i d2(q_i)/dt2 = T_(i+1) - T_i`, `T_i = k_i (q_i - q_(i-1)) + c_i (v_i - v_(i-1))`

    with `q_0 = v_0 = 0` the wall and `T_(n+1)` the force. The state is the positions
    [m], measured from rest, and then the velocities [m/s]; the control is (force [N]).

    **Arguments:**

    - `mass`: m [kg], a number or one for each mass, 1 by default.
    - `stiffness`: k [N/m], a number or one for each spring, 1 by default.
    - `damping`: c [N s/m], a number or one for each damper, 0.1 by default.
    - `masses`: how many there are, 1 by default.

    **Raises:** `ValueError` if a mass is not positive, a number is not finite, or there
    are not as many numbers as masses.

    Source: Åström and Murray, 2008.

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp

        chain = dlx.systems.MassSpringDamper(stiffness=[1.0, 2.0, 3.0], masses=3)
        chain.vector_field(0.0, jnp.ones(6), jnp.zeros(1), None)
        ```
    """

    mass: Real = parameter(1.0, constraint=positive)
    stiffness: Real = parameter(1.0)
    damping: Real = parameter(0.1)
    _: KW_ONLY
    masses: int = eqx.field(static=True, default=1, converter=_as_count)

    control_names, control_units = ("force",), ("N",)

    def __check_init__(self):
        for name in ("mass", "stiffness", "damping"):
            as_entries(getattr(self, name), self.masses, name, "MassSpringDamper")

    @property
    def state_names(self) -> tuple[str, ...]:
        """Positions, then velocities; numbered if there are several masses."""
        if self.masses == 1:
            return ("position", "velocity")
        each = range(1, self.masses + 1)
        return (*(f"position_{i}" for i in each), *(f"velocity_{i}" for i in each))

    @property
    def state_units(self) -> tuple[str, ...]:
        """Metres, then metres per second."""
        return ("m",) * self.masses + ("m/s",) * self.masses

    def vector_field(self, t: Time, x: State, u: Control, w: Disturbance) -> State:
        n = self.masses
        m, k, c = (
            jnp.broadcast_to(a, (n,)).astype(x.dtype)
            for a in (self.mass, self.stiffness, self.damping)
        )
        tension, q, v = [], 0.0, 0.0
        for i in range(n):
            tension.append(k[i] * (x[i] - q) + c[i] * (x[n + i] - v))
            q, v = x[i], x[n + i]
        tension.append(u[0])  # the force acts where a further spring would
        # Loops compute the reciprocals once.
        lightness = 1 / m
        # T_i pulls mass i back, and the mass before it along.
        pulls = [(tension[i + 1] - tension[i]) * lightness[i] for i in range(n)]
        return jnp.stack([*(x[n + i] for i in range(n)), *pulls])

    @host_unless_traced
    def equilibrium(self) -> tuple[State, Control]:
        return xp.zeros(2 * self.masses), xp.zeros(1)


class VanDerPol(AbstractSystem):
    """Van der Pol's oscillator, forced,

    `dx/dt = v`, `dv/dt = mu (1 - x^2) v - x + u`.

    Without control all trajectories but the origin converge to one limit cycle, of
    amplitude near 2.
    Smooth; stiff for large mu. The numbers have no units.

    **Arguments:**

    - `mu`: the damping, 1 by default.

    **Raises:** `ValueError` if `mu` is not finite.

    Source: van der Pol, 1926.

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp

        oscillator = dlx.systems.VanDerPol(mu=2.0)
        oscillator.vector_field(0.0, jnp.ones(2), jnp.zeros(1), None)
        ```
    """

    mu: Real = parameter(1.0)

    state_names, control_names, time_unit = ("x", "v"), ("u",), ""

    def vector_field(self, t: Time, x: State, u: Control, w: Disturbance) -> State:
        # With mu > 0 positive inside |x| = 1, where it feeds energy in: the origin is
        # unstable, and beyond it takes energy out.
        damping = self.mu * (1 - x[0] * x[0])
        return jnp.stack([x[1], damping * x[1] - x[0] + u[0]])

    @host_unless_traced
    def equilibrium(self) -> tuple[State, Control]:
        return xp.zeros(2), xp.zeros(1)


class Lorenz(AbstractSystem):
    """Lorenz's model of convection, forced,

    `dx/dt = sigma (y - x) + u`, `dy/dt = x (rho - z) - y`, `dz/dt = x y - beta z`.

    Chaotic at the default constants: two starts drift apart by a factor e in about 1.1.
    Smooth. The numbers have no units.

    **Arguments:**

    - `sigma`: 10 by default.
    - `rho`: 28 by default.
    - `beta`: 8/3 by default.

    **Raises:** `ValueError` if a number is not finite.

    Source: Lorenz, 1963; Kaiser, Kutz and Brunton, 2018, for where the control enters.

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp

        lorenz = dlx.systems.Lorenz()
        lorenz.vector_field(0.0, jnp.ones(3), jnp.zeros(1), None)
        ```
    """

    sigma: Real = parameter(10.0)
    rho: Real = parameter(28.0)
    beta: Real = parameter(8.0 / 3.0)

    state_names, control_names, time_unit = ("x", "y", "z"), ("u",), ""

    def vector_field(self, t: Time, x: State, u: Control, w: Disturbance) -> State:
        dx = self.sigma * (x[1] - x[0]) + u[0]
        dy = x[0] * (self.rho - x[2]) - x[1]
        return jnp.stack([dx, dy, x[0] * x[1] - self.beta * x[2]])

    @host_unless_traced
    def equilibrium(self) -> tuple[State, Control]:
        """The centre of the right wing, `x = y = sqrt(beta (rho - 1))`, `z = rho - 1`;
        the origin where there are no wings (`rho <= 1`).

        **Returns:** the state, and no control.
        """
        winged = (self.rho > 1) & (self.beta > 0)
        # The root of 1 where there are no wings: that of 0 has no gradient.
        height = xp.where(winged, self.rho - 1, 0.0)
        square = xp.where(winged, self.beta * height, 1.0)
        wing = xp.where(winged, xp.sqrt(square), 0.0)
        return xp.stack([wing, wing, height]), xp.zeros(1)
