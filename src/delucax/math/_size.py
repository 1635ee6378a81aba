"""Sizes of matrices whose squares may overflow or underflow."""

import jax.lax as lax
import jax.numpy as jnp
from jaxtyping import Array


def size(*matrices: Array) -> Array:
    """The sum of the Frobenius norms."""
    scale = _largest(*matrices)
    return scale * sum(jnp.linalg.norm(M / scale) for M in matrices)


def relative_size(error: Array, *terms: Array) -> Array:
    """The norm of what is left of an equation, over the sum of those of its terms."""
    scale = _largest(*terms)
    total = sum(jnp.linalg.norm(M / scale) for M in terms)
    return jnp.linalg.norm(error / scale) / jnp.where(total == 0, 1, total)


def _largest(*matrices):
    """The largest magnitude, or 1 if there is none. A NaN stays one."""
    largest = jnp.max(jnp.stack([jnp.max(jnp.abs(M), initial=0) for M in matrices]))
    return jnp.where(largest == 0, 1, largest)


def power_of_two(x: Array) -> Array:
    """A power of two near each number, to the last bit, which `jnp.exp2` is not."""
    # Rounded to no digit of the mantissa.
    return lax.reduce_precision(x, jnp.finfo(x.dtype).nexp, 0)
