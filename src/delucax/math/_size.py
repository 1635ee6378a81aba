"""Sizes of matrices whose squares may overflow or underflow."""

import jax.lax as lax
import jax.numpy as jnp
from jaxtyping import Array


def size(matrix: Array) -> Array:
    """The Frobenius norm."""
    scale = one_if_zero(jnp.max(jnp.abs(matrix)))
    return scale * _norm(matrix / scale)


def relative_size(error: Array, *terms: Array) -> Array:
    """The norm of what is left of an equation, over the sum of those of its terms."""
    return relative_and_total_size(error, *terms)[0]


def relative_and_total_size(error: Array, *terms: Array) -> tuple[Array, Array]:
    """The norm of what is left of an equation over the sum of those of its terms, and
    this sum. All have one shape."""
    stack = jnp.stack(terms)
    # A NaN stays one.
    scale = one_if_zero(jnp.max(jnp.abs(stack)))
    total = jnp.sum(_norm(stack / scale))
    return _norm(error / scale) / one_if_zero(total), scale * total


def one_if_zero(x: Array) -> Array:
    """Numbers to divide by."""
    return x + (x == 0)


def _norm(matrix):
    return jnp.sqrt(jnp.sum(matrix * matrix, axis=(-2, -1)))


def power_of_two(x: Array) -> Array:
    """A power of two near each number, to the last bit, which `jnp.exp2` is not."""
    # Rounded to no digit of the mantissa.
    return lax.reduce_precision(x, jnp.finfo(x.dtype).nexp, 0)
