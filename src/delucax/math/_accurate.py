"""Products of matrices in more digits than their precision has."""

import functools
import math
import operator

import jax.lax as lax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float


_MORE_DIGITS = 30
"""Binary digits beyond those of the precision."""
_SMALL = 8192
"""Up to here XLA compiles a sum of products as one kernel with all around it, and a
product of matrices not: that costs the solvers much of their compile time."""


def product(
    left: Float[Array, "n k"], right: Float[Array, "k m"]
) -> tuple[Float[Array, "n m"], Float[Array, "n m"]]:
    """The product of two matrices, and by how much its entries may be wrong.

    Where terms cancel, what is left has digits too: each factor is cut into slices of
    so few bits that products of slices are exact, in any order of summation and with
    fused operations. These are added from high to low.

    Source: Ozaki, Ogita, Oishi and Rump, 2012.
    """
    (n, k), m, dtype = left.shape, right.shape[1], left.dtype
    digits = jnp.finfo(dtype).nmant + 1
    bits = int((digits - math.log2(k)) / 2)
    count = -(-(digits + _MORE_DIGITS) // bits)
    both = jnp.concatenate([left, right.T])
    # In units in which the k-th column and the k-th row are alike.
    across, down = (jnp.max(jnp.abs(M), axis=0) for M in (both[:n], both[n:]))
    unit = _power(jnp.sqrt(down) / jnp.sqrt(jnp.where(across > 0, across, 1)))
    unit = jnp.where(unit > 0, unit, 1)
    both *= jnp.where(np.arange(n + m)[:, None] < n, unit, 1 / unit)
    power = _power(jnp.max(jnp.abs(both), axis=1, keepdims=True))
    power = lax.max(power, jnp.finfo(dtype).tiny)
    # Entries as multiples of ever smaller steps, and what each adds to the last.
    step = 2.0 ** (bits * np.arange(count + 1)[:, None, None] - 2)
    step = step.astype(dtype)
    parts = jnp.round(both / power * step) / step
    parts = power * (
        parts[1:] - jnp.where(np.arange(count)[:, None, None] > 0, parts[:-1], 0)
    )
    rows, columns = parts[:, :n].reshape(-1, k), parts[:, n:].reshape(-1, k)
    if n * k * m <= _SMALL:
        pairs = lax.fori_loop(
            0,
            k,
            lambda i, added: added + rows[:, i, None] * columns[:, i],
            jnp.zeros((count * n, count * m), dtype),
        )
    else:
        pairs = rows @ columns.T
    pairs = pairs.reshape(count, n, count, m)
    order = sorted(np.ndindex(count, count), key=sum)
    total = functools.reduce(operator.add, (pairs[i, :, j] for i, j in order))
    lost = 16 * k * 0.5 ** (count * bits) * power[:n] * power[n:].T
    return total, lost + count**2 * jnp.finfo(dtype).eps * jnp.abs(total)


def _power(x: Array) -> Array:
    """A power of two near each number."""
    # Rounded to no digit of the mantissa.
    return lax.reduce_precision(x, jnp.finfo(x.dtype).nexp, 0)
