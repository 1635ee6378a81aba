"""Two tanks, the upper of which drains into the lower."""

from typing import Any, ClassVar

import jax.numpy as jnp
from jaxtyping import Array

from .._module import parameter, positive
from .._typing import Control, Disturbance, State, Time
from ._base import AbstractSystem


class TwoTank(AbstractSystem):
    r"""A pump fills the upper of two tanks, which drains into the lower one, which
    drains away:

    `A1 d(upper)/dt = flow - a1 sqrt(2 g) root(upper)`,
    `A2 d(lower)/dt = a1 sqrt(2 g) root(upper) - a2 sqrt(2 g) root(lower)`.

    The state is the levels (upper [cm], lower [cm]), the control is (flow [cm^3/s]).

    Torricelli's law has `root(h) = sqrt(h)`, whose slope is infinite at an empty tank,
    and which has no value below. Here it is `root(h) = h / (h^2 + smoothing^2)^(1/4)`,
    odd and smooth everywhere, and off by `(smoothing / h)^2 / 4` relatively: 2.5e-5 at
    a level of 1 cm, by default. With a smaller `smoothing` an empty tank is stiffer.

    **Arguments:**

    - `upper_area`, `lower_area`: A1 and A2, of the tanks [cm^2], 28 by default.
    - `upper_outlet`, `lower_outlet`: a1 and a2, of the holes [cm^2], 0.071 by default.
    - `gravity`: g [cm/s^2], 981 by default.
    - `smoothing`: a level [cm], 0.01 by default.

    **Raises:** `ValueError` if a number is not positive.

    Source: Johansson, 2000 (one branch of the quadruple tank).

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp

        tanks = dlx.systems.TwoTank()
        x, u = tanks.equilibrium(level=12.0)
        tanks.vector_field(0.0, x, u, None)
        ```
    """

    upper_area: Array = parameter(28.0, constraint=positive)
    lower_area: Array = parameter(28.0, constraint=positive)
    upper_outlet: Array = parameter(0.071, constraint=positive)
    lower_outlet: Array = parameter(0.071, constraint=positive)
    gravity: Array = parameter(981.0, constraint=positive)
    smoothing: Array = parameter(0.01, constraint=positive)

    state_names: ClassVar = ("upper", "lower")
    control_names: ClassVar = ("flow",)
    state_units: ClassVar = ("cm", "cm")
    control_units: ClassVar = ("cm^3/s",)

    def _outflow(self, outlet: Array, level: Array) -> Array:
        root = level * (level * level + self.smoothing**2) ** -0.25
        return outlet * (2 * self.gravity) ** 0.5 * root

    def vector_field(self, t: Time, x: State, u: Control, w: Disturbance) -> State:
        upper = self._outflow(self.upper_outlet, x[0])
        lower = self._outflow(self.lower_outlet, x[1])
        filling = (u[0] - upper) / self.upper_area
        return jnp.stack([filling, (upper - lower) / self.lower_area])

    def equilibrium(self, level: Any = 10.0) -> tuple[State, Control]:
        """Where the pump holds the lower tank at a level.

        **Arguments:** `level`: of the lower tank, not negative [cm]; 10 by default.

        **Returns:** `(x, u)`.
        """
        level = jnp.asarray(level, float)
        flow = self._outflow(self.lower_outlet, level)
        # The level with that outflow: root(h)^2 = r solves for h^2 by a quadratic.
        r = (flow / self.upper_outlet) ** 2 / (2 * self.gravity)
        square = r * (r + (r * r + 4 * self.smoothing**2) ** 0.5) / 2
        return jnp.stack([square**0.5, level]), jnp.stack([flow])
