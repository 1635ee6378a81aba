"""Sizes of matrices whose squares may overflow or underflow."""

import jax.lax as lax
import jax.numpy as jnp
from jaxtyping import Array


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
