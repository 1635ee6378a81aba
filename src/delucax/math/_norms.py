"""Norms whose gradient is finite at zero."""

import jax.numpy as jnp
from jaxtyping import Array, ArrayLike


def safe_norm(x: ArrayLike, axis: int | None = -1, keepdims: bool = False) -> Array:
    """The Euclidean norm with gradient 0 (not NaN) at 0.

    **Arguments:**

    - `x`: any array.
    - `axis`: the axis to reduce; `None` for all.
    - `keepdims`: keep the reduced axis with size 1.

    **Returns:** the norm along `axis`.

    !!! example

        ```python
        import delucax as dlx
        import jax
        import jax.numpy as jnp

        jax.grad(dlx.math.safe_norm)(jnp.zeros(3))
        ```
    """
    x = jnp.asarray(x)
    squared = jnp.sum(x * x, axis=axis, keepdims=keepdims)
    at_zero = squared == 0
    return jnp.where(at_zero, 0.0, jnp.sqrt(jnp.where(at_zero, 1.0, squared)))


def within_ball(x: Array, radius: ArrayLike) -> Array:
    """The nearest point of a ball in the Euclidean (Frobenius) norm, with a finite
    gradient everywhere."""
    norm = safe_norm(x, axis=None)
    over = norm > radius
    return jnp.where(over, radius / jnp.where(over, norm, 1), 1).astype(x.dtype) * x
