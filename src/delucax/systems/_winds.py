"""Force fields in the plane: what a wind does to a vehicle."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from .._module import check_parameters, parameter, positive
from .._typing import State, Time, Vector


class DissipativeWind(eqx.Module):
    """The force `strength (x, y)`.

    The name is the paper's. With a positive strength the force points away from the
    origin and grows with the distance: it takes nothing away, it drives off.

    **Arguments:**

    - `strength`: [N/m], 0.1 by default.

    **Raises:** `ValueError` if the strength is not finite.

    Source: Gradu, Hallman, Suo, Yu, Agarwal, Ghai, Singh, Zhang, Majumdar and Hazan,
    2021 (Deluca).

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp

        dlx.systems.DissipativeWind(0.4)(0.0, jnp.array([1.0, 2.0]))
        ```
    """

    strength: Array = parameter(0.1)

    def __check_init__(self):
        check_parameters(self)

    def __call__(self, t: Time, x: State) -> Vector:
        """The force.

        **Arguments:** `t`: time. `x`: a state whose first two entries are the position.

        **Returns:** shape `(2,)`.
        """
        return jnp.stack([self.strength * x[0], self.strength * x[1]])


class ConstantWind(eqx.Module):
    """The force `strength (cos(direction), sin(direction))`.

    **Arguments:**

    - `strength`: [N], 0.1 by default.
    - `direction`: [rad], pi / 4 by default.

    **Raises:** `ValueError` if a number is not finite.

    Source: Gradu, Hallman, Suo, Yu, Agarwal, Ghai, Singh, Zhang, Majumdar and Hazan,
    2021 (Deluca).

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp

        dlx.systems.ConstantWind(0.4)(0.0, jnp.zeros(6))
        ```
    """

    strength: Array = parameter(0.1)
    direction: Array = parameter(np.pi / 4)

    def __check_init__(self):
        check_parameters(self)

    def __call__(self, t: Time, x: State) -> Vector:
        """The force.

        **Arguments:** `t`: time. `x`: a state, which plays no part.

        **Returns:** shape `(2,)`.
        """
        along, across = jnp.cos(self.direction), jnp.sin(self.direction)
        return jnp.stack([self.strength * along, self.strength * across])


class VortexWind(eqx.Module):
    """The force of vortices that turn counter-clockwise about their centres c,

    `strength sum_c 2 core turn(p - c) / (|p - c|^2 + core^2)`, `turn(x, y) = (-y, x)`.

    One vortex is strongest, `strength`, at the distance `core` from its centre, rotates
    as a solid inside and dies out as 1 / distance outside. Smooth everywhere.

    **Arguments:**

    - `strength`: [N], 0.1 by default.
    - `core`: the radius of the core [m], 0.25 by default.
    - `centres`: shape `(n, 2)` [m]; (1, 0), (0.5, 0.5) and (0, 1) by default.

    **Raises:** `ValueError` if a number is not finite, the core is not positive or the
        centres are not pairs.

    Source: Gradu, Hallman, Suo, Yu, Agarwal, Ghai, Singh, Zhang, Majumdar and Hazan,
    2021 (Deluca), for the centres; Scully, 1975, for the profile.

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp

        dlx.systems.VortexWind(0.4)(0.0, jnp.array([1.0, 2.0]))
        ```
    """

    strength: Array = parameter(0.1)
    core: Array = parameter(0.25, constraint=positive)
    centres: Array = parameter(((1.0, 0.0), (0.5, 0.5), (0.0, 1.0)))

    def __check_init__(self):
        check_parameters(self)
        if self.centres.ndim != 2 or self.centres.shape[1] != 2:
            raise ValueError(
                f"VortexWind: centres must have shape (n, 2), got {self.centres.shape}."
            )

    def __call__(self, t: Time, x: State) -> Vector:
        """The force.

        **Arguments:** `t`: time. `x`: a state whose first two entries are the position.

        **Returns:** shape `(2,)`.
        """
        centres = self.centres.astype(x.dtype)
        across, along = jnp.zeros((), x.dtype), jnp.zeros((), x.dtype)
        for i in range(centres.shape[0]):
            dx, dy = x[0] - centres[i, 0], x[1] - centres[i, 1]
            size = 2 * self.core / (dx * dx + dy * dy + self.core**2)
            across, along = across - size * dy, along + size * dx
        return jnp.stack([self.strength * across, self.strength * along])
