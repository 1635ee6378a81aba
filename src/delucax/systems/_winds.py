"""Winds: forces in the plane that push a `PlanarQuadrotor`."""

import abc

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from .._module import check_parameters, parameter, positive, shown
from .._typing import Real, State, Time, Vector


class _AbstractWind(eqx.Module):
    """A force in the plane, a function of time and the state."""

    __repr__ = shown

    def __check_init__(self):
        check_parameters(self)

    @abc.abstractmethod
    def __call__(self, t: Time, x: State) -> Vector:
        """The force.

        **Arguments:** `t`: time. `x`: a state whose first two entries are the position.

        **Returns:** the force [N], shape `(2,)`.
        """


class DissipativeWind(_AbstractWind):
    r"""A wind whose force grows with the distance from the origin.

    $$F = s\, (x, y)$$

    A positive strength destabilises the plant, because the force points away from the
    origin. The Deluca paper uses this name.

    **Arguments:**

    - `strength`: $s$ [N/m], 0.1 by default.

    **Raises:** `ValueError` if the strength is not finite.

    Source: Gradu et al., 2021 (Deluca).

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp

        dlx.systems.DissipativeWind(0.4)(0.0, jnp.array([1.0, 2.0]))
        ```

        ```text
        Array([0.4, 0.8], dtype=float32)
        ```
    """

    strength: Real = parameter(0.1)

    def __call__(self, t: Time, x: State) -> Vector:
        return jnp.stack([self.strength * x[0], self.strength * x[1]])


class ConstantWind(_AbstractWind):
    r"""A constant wind.

    $$F = s\, (\cos\alpha, \sin\alpha)$$

    **Arguments:**

    - `strength`: $s$ [N], 0.1 by default.
    - `direction`: $\alpha$, the direction of the force [rad], pi / 4 by default.

    **Raises:** `ValueError` if a number is not finite.

    Source: Gradu et al., 2021 (Deluca).

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp

        dlx.systems.ConstantWind(0.4)(0.0, jnp.zeros(6))
        ```

        ```text
        Array([0.283, 0.283], dtype=float32, weak_type=True)
        ```
    """

    strength: Real = parameter(0.1)
    direction: Real = parameter(np.pi / 4)

    def __call__(self, t: Time, x: State) -> Vector:
        along, across = jnp.cos(self.direction), jnp.sin(self.direction)
        return jnp.stack([self.strength * along, self.strength * across])


class VortexWind(_AbstractWind):
    r"""A wind of vortices that turn counter-clockwise about their centres $c_i$.

    $$F(p) = s \sum_i \frac{2 r\, J (p - c_i)}{|p - c_i|^2 + r^2}, \qquad
    J = \begin{pmatrix} 0 & -1 \\ 1 & 0 \end{pmatrix}$$

    Here $p$ is the position. Each vortex is strongest at the distance $r$ from its
    centre, where its force is $s$. Near its centre, it rotates like a solid. Far
    outside of the core, the force is inversely proportional to the distance from the
    centre. The force is smooth everywhere.

    **Arguments:**

    - `strength`: $s$ [N], 0.1 by default.
    - `core`: $r$, the radius of the core [m], 0.25 by default.
    - `centres`: $c_i$, shape `(n, 2)` [m]; (1, 0), (0.5, 0.5) and (0, 1) by default.

    **Raises:** `ValueError` if a number is not finite, the core is not positive or the
    centres do not have shape `(n, 2)`.

    Source: Gradu et al., 2021 (Deluca), for the centres; Scully, 1975, for the profile.

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp

        dlx.systems.VortexWind(0.4)(0.0, jnp.array([1.0, 2.0]))
        ```

        ```text
        Array([-0.313,  0.136], dtype=float32)
        ```
    """

    strength: Real = parameter(0.1)
    core: Real = parameter(0.25, constraint=positive)
    centres: Real = parameter(((1.0, 0.0), (0.5, 0.5), (0.0, 1.0)))

    def __check_init__(self):
        check_parameters(self)
        if self.centres.ndim != 2 or self.centres.shape[1] != 2:
            raise ValueError(
                f"VortexWind: centres must have shape (n, 2), got {self.centres.shape}."
            )

    def __call__(self, t: Time, x: State) -> Vector:
        centres = self.centres.astype(x.dtype)
        across, along = jnp.zeros((), x.dtype), jnp.zeros((), x.dtype)
        for i in range(centres.shape[0]):
            dx, dy = x[0] - centres[i, 0], x[1] - centres[i, 1]
            # 2 core r / (r^2 + core^2) is 1 at r = core, where it is largest.
            size = 2 * self.core / (dx * dx + dy * dy + self.core**2)
            across, along = across - size * dy, along + size * dx
        return jnp.stack([self.strength * across, self.strength * along])
