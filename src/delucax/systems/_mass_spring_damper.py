"""Masses on a line, joined by springs and dampers."""

from dataclasses import KW_ONLY
from typing import Any, ClassVar

import equinox as eqx
import jax.numpy as jnp

from .._check import check_count
from .._module import parameter, positive
from .._typing import Control, Disturbance, Real, State, Time
from ._base import AbstractSystem


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

    control_names: ClassVar = ("force",)
    control_units: ClassVar = ("N",)

    def __check_init__(self):
        for name in ("mass", "stiffness", "damping"):
            shape = jnp.shape(getattr(self, name))
            if shape not in ((), (self.masses,)):
                raise ValueError(
                    f"MassSpringDamper: {name} must be a number or have shape "
                    f"({self.masses},), got {shape}."
                )

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
        tension.append(u[0])
        # Loops compute the reciprocals once.
        lightness = 1 / m
        pulls = [(tension[i + 1] - tension[i]) * lightness[i] for i in range(n)]
        return jnp.stack([*(x[n + i] for i in range(n)), *pulls])

    def equilibrium(self) -> tuple[State, Control]:
        return jnp.zeros(2 * self.masses), jnp.zeros(1)
