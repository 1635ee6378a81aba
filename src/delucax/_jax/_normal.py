"""Fast standard normal numbers on CPU (Box and Muller).

`jax.random.normal` inverts the error function, which on CPU takes longer than drawing
the random bits. The transform of Box and Muller (1958) makes two normal numbers from
two uniform ones, with a logarithm, a square root and the sine and cosine of this
package. All of these run in vector registers.
"""

import math
from typing import Any

import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
from jax.extend.random import threefry_2x32
from jaxtyping import Array

from .._typing import PRNGKey
from ..math._angles import cos, sin


_PAIRS = 16
"""Pairs of numbers made together: enough to fill the vector registers."""


def normal(key: PRNGKey, shape: tuple[int, ...], dtype: Any) -> Array:
    """Independent standard normal numbers.

    In single precision they reach 5.9 standard deviations. A number does not depend on
    how many are drawn after it, so the noise of a short horizon is the beginning of
    that of a long one. In other precisions it is `jax.random.normal`.
    """
    if dtype != jnp.float32:
        return jr.normal(key, shape, dtype)
    size = math.prod(shape)
    first, second = _pairs(key, -(-size // (2 * _PAIRS)))
    # The middles of 2^24 equal parts of (0, 1), because the logarithm of 0 is infinite.
    unit = (first >> 8).astype(jnp.float32) * np.float32(2.0**-24)
    # -2 log(u) is exponential with mean 2, like the squared length of two normal
    # numbers. The smallest u, 2^-25, gives the 5.9 standard deviations.
    radius = jnp.sqrt(-2 * jnp.log(unit + np.float32(2.0**-25)))
    # Signed words divided by 2^31 are in [-1, 1), so the angle is in [-pi, pi).
    angle = second.astype(jnp.int32).astype(jnp.float32) * np.float32(np.pi / 2**31)
    both = jnp.concatenate([radius * cos(angle), radius * sin(angle)], axis=1)
    return both.reshape(-1)[:size].reshape(shape)


def _pairs(key: PRNGKey, blocks: int) -> tuple[Array, Array]:
    """Random words in pairs, shapes `(blocks, _PAIRS)`: the two words that Threefry
    makes from a counter. `jax.random.bits` would combine both to a single word.
    """
    # Each pair has its own counter, so it does not depend on the number of pairs. With
    # the option `jax_threefry_partitionable` off, words of `jax.random.bits` do.
    typed = jnp.issubdtype(key.dtype, jax.dtypes.prng_key)
    shape = (blocks, _PAIRS)
    if typed and str(jr.key_impl(key)) not in ("threefry2x32", "fry"):
        words = jr.bits(key, (blocks, 2, _PAIRS), jnp.uint32)
        return words[:, 0], words[:, 1]
    index = jnp.arange(blocks * _PAIRS, dtype=jnp.uint32)
    counts = jnp.concatenate([jnp.zeros_like(index), index])
    words = threefry_2x32(jr.key_data(key) if typed else key, counts)
    return words[: index.size].reshape(shape), words[index.size :].reshape(shape)
