"""Angles on the circle."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike


def wrap(angle: ArrayLike) -> Array:
    r"""The angle between -pi and pi that points the same way:
    `angle - 2 pi round(angle / (2 pi))`.

    Rounding is much cheaper than `%`. The gradient is 1 everywhere, the jump at an odd
    multiple of pi included.

    **Arguments:**

    - `angle`: radians, any shape.

    **Returns:** the wrapped angle, in [-pi, pi].

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp

        dlx.math.wrap(jnp.array(7.0))
        ```
    """
    angle = jnp.asarray(angle)
    return angle - (2 * np.pi) * jnp.round(angle * (1 / (2 * np.pi)))
