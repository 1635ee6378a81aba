"""Norms and limits, safe at zero, at infinity and where squares would overflow."""

from typing import Any

import jax.lax as lax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike


ULPS = 4
"""What rounding leaves of a drift, in units of the last place."""


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


def size(matrix: Array) -> Array:
    """The Frobenius norm."""
    scale = _divisor(jnp.max(jnp.abs(matrix)))
    return scale * _norm(matrix / scale)


def relative_size(error: Array, *terms: Array) -> Array:
    """The norm of what is left of an equation, over the sum of those of its terms."""
    return relative_and_total_size(error, jnp.stack(terms))[0]


def relative_and_total_size(error: Array, terms: Array) -> tuple[Array, Array]:
    """The norm of what is left of an equation, or of a stack of such, over the sum of
    those of its terms, which are stacked; and this sum."""
    scale = _divisor(jnp.max(jnp.abs(terms)))
    total = jnp.sum(_norm(terms / scale))
    return _norm(error / scale) / _divisor(total), scale * total


def one_if_zero(x: Array) -> Array:
    """Numbers, with 1 for each that is zero."""
    return x + (x == 0)


def _divisor(x):
    # A NaN stays one.
    return lax.max(x, jnp.finfo(x.dtype).tiny)


def _norm(matrix):
    return jnp.sqrt(jnp.sum(matrix * matrix, axis=(-2, -1)))


def power_of_two(x: Array) -> Array:
    """A power of two near each number, to the last bit, which `jnp.exp2` is not."""
    # Rounded to no digit of the mantissa.
    return lax.reduce_precision(x, jnp.finfo(x.dtype).nexp, 0)


def relative_drift(
    drift: Array, jacobian: Array, x: Array, u: Array, *, is_map: bool
) -> Array:
    """How far from rest a point is: the largest share of `drift` among its terms,

    `|drift_i| / (|drift_i| + sum_j |jacobian_ij| unit_j)`, row by row. Of a map the
    drift is `F(x) - x`, and what the rounding of `x_i` may leave is taken off. Axes in
    front are times, along which a unit is that of the largest value.
    """
    largest = lambda z: jnp.max(jnp.abs(z).reshape(-1, z.shape[-1]), axis=0)
    terms = jnp.abs(jacobian) @ jnp.concatenate(
        [units_of(largest(x)), units_of(largest(u))]
    )
    left = jnp.abs(drift)
    if is_map:
        rounding = ULPS * jnp.finfo(x.dtype).eps * largest(x)
        left = jnp.maximum(left - rounding, 0)
    return jnp.max(jnp.where(left == 0, 0, left / (left + terms)))


def units_of(z: Array) -> Array:
    """The size of each entry, or where it is zero up to rounding 1, or that of the
    largest entry if this is less and not zero."""
    size = jnp.abs(z)
    largest = jnp.max(size, initial=0)
    floor = jnp.where(largest > 0, jnp.minimum(largest, 1), 1)
    return jnp.where(size > 100 * jnp.finfo(z.dtype).eps * floor, size, floor)
