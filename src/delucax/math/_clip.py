"""Limits that XLA vectorises on CPU."""

from typing import Any

import jax.numpy as jnp
from jaxtyping import Array, ArrayLike


def clip(x: ArrayLike, low: Any, high: Any) -> Array:
    """`x` kept between `low` and `high`, either of which may be infinite.

    `jnp.clip` by comparisons: its own minimum and maximum must pass on a NaN of the
    limits, which costs a batch on CPU as much as all the rest of a pendulum's step. A
    NaN in `x` stays; one in the limits is no limit. The gradient goes to `x` within the
    limits and on them, and to the limit outside.

    **Arguments:**

    - `x`: any array.
    - `low`, `high`: the limits, numbers or arrays that broadcast against `x`.

    **Returns:** the clipped array, of the dtype that the three promote to.

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp

        dlx.math.clip(jnp.array([-3.0, 0.5, 3.0]), -2.0, 2.0)
        ```
    """
    x = jnp.where(x > high, high, x)
    return jnp.where(x < low, low, x)
