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
    r"""A mass pushed along a line.

    $$m \ddot p = F$$

    The state is (position [m], velocity [m/s]), the control is (force [N]).

    **Arguments:**

    - `mass`: $m$ [kg], 1 by default.

    **Raises:** `ValueError` if the mass is not positive.

    Source: Åström and Murray, 2008.

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp

        mass = dlx.systems.DoubleIntegrator()
        mass.vector_field(0.0, jnp.array([1.0, 0.5]), jnp.ones(1), None)
        ```

        ```text
        Array([0.5, 1. ], dtype=float32)
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
    r"""A mass on a spring and a damper, or a chain of such masses. One end of the chain
    is fixed to a wall, and a force acts on the last mass.

    $$m_i \ddot q_i = T_{i+1} - T_i, \qquad
    T_i = k_i (q_i - q_{i-1}) + c_i (v_i - v_{i-1})$$

    The wall does not move, so $q_0 = v_0 = 0$, and $T_{n+1}$ is the force on the last
    mass. The state holds first the positions [m], measured from the positions at rest,
    and then the velocities [m/s]. The control is (force [N]).

    **Arguments:**

    - `mass`: $m$ [kg], one number or shape `(masses,)`, 1 by default.
    - `stiffness`: $k$ [N/m], one number or shape `(masses,)`, 1 by default.
    - `damping`: $c$ [N s/m], one number or shape `(masses,)`, 0.1 by default.
    - `masses`: the number of masses $n$, 1 by default.

    **Raises:** `ValueError` if a mass is not positive, a number is not finite, or a
    shape does not fit.

    Source: Åström and Murray, 2008.

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp

        chain = dlx.systems.MassSpringDamper(stiffness=[1.0, 2.0, 3.0], masses=3)
        chain.vector_field(0.0, jnp.ones(6), jnp.zeros(1), None)
        ```

        ```text
        Array([ 1. ,  1. ,  1. , -1.1,  0. ,  0. ], dtype=float32)
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
        # Reciprocals, because a loop computes them once.
        lightness = 1 / m
        # T_i pulls mass i back, and the mass before it along.
        pulls = [(tension[i + 1] - tension[i]) * lightness[i] for i in range(n)]
        return jnp.stack([*(x[n + i] for i in range(n)), *pulls])

    @host_unless_traced
    def equilibrium(self) -> tuple[State, Control]:
        return xp.zeros(2 * self.masses), xp.zeros(1)


class VanDerPol(AbstractSystem):
    r"""Van der Pol's oscillator with a control.

    $$\dot x = v, \qquad \dot v = \mu (1 - x^2) v - x + u$$

    Without control, every trajectory that does not start at the origin converges to one
    limit cycle, of amplitude near 2. The vector field is smooth, and the system is
    stiff for large $\mu$. States, control and time have no units.

    **Arguments:**

    - `mu`: $\mu$, the damping, 1 by default.

    **Raises:** `ValueError` if `mu` is not finite.

    Source: van der Pol, 1926.

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp

        oscillator = dlx.systems.VanDerPol(mu=2.0)
        oscillator.vector_field(0.0, jnp.ones(2), jnp.zeros(1), None)
        ```

        ```text
        Array([ 1., -1.], dtype=float32)
        ```
    """

    mu: Real = parameter(1.0)

    state_names, control_names, time_unit = ("x", "v"), ("u",), ""

    def vector_field(self, t: Time, x: State, u: Control, w: Disturbance) -> State:
        # For mu > 0 this feeds energy in where |x| < 1, and takes it out beyond.
        damping = self.mu * (1 - x[0] * x[0])
        return jnp.stack([x[1], damping * x[1] - x[0] + u[0]])

    @host_unless_traced
    def equilibrium(self) -> tuple[State, Control]:
        return xp.zeros(2), xp.zeros(1)


class Lorenz(AbstractSystem):
    r"""Lorenz's model of convection, with a control input.

    $$\dot x = \sigma (y - x) + u, \qquad \dot y = x (\rho - z) - y, \qquad
    \dot z = x y - \beta z$$

    The system is chaotic at the default constants: the distance between neighbouring
    trajectories grows by a factor of $e$ in a time of about 1.1. The vector field is
    smooth. States, control and time have no units.

    **Arguments:**

    - `sigma`: $\sigma$, 10 by default.
    - `rho`: $\rho$, 28 by default.
    - `beta`: $\beta$, 8/3 by default.

    **Raises:** `ValueError` if a number is not finite.

    Source: Lorenz, 1963; Kaiser, Kutz and Brunton, 2018, for where the control enters.

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp

        lorenz = dlx.systems.Lorenz()
        lorenz.vector_field(0.0, jnp.ones(3), jnp.zeros(1), None)
        ```

        ```text
        Array([ 0.   , 26.   , -1.667], dtype=float32)
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
        r"""The centre of the right wing, $x = y = \sqrt{\beta (\rho - 1)}$ and
        $z = \rho - 1$; or the origin if there are no wings ($\rho \le 1$).

        **Returns:** the state, shape `(3,)`, and a zero control, shape `(1,)`.
        """
        winged = (self.rho > 1) & (self.beta > 0)
        # Without wings the root of 1 is taken, because that of 0 has no gradient.
        height = xp.where(winged, self.rho - 1, 0.0)
        square = xp.where(winged, self.beta * height, 1.0)
        wing = xp.where(winged, xp.sqrt(square), 0.0)
        return xp.stack([wing, wing, height]), xp.zeros(1)
