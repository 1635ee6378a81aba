"""Products of matrices in more digits than their precision has."""

import functools
import math
import operator
from typing import NamedTuple

import jax.lax as lax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float


class Slices(NamedTuple):
    """How a sum of matrices is cut: into `count` matrices of `bits` bits."""

    count: int
    bits: int


def slices(k: int, dtype) -> Slices:
    """For products with up to `k` terms of sums of two."""
    digits = jnp.finfo(dtype).nmant + 1
    cuts = (
        Slices(count, int((digits - math.log2(k * count)) / 2 - 1))
        for count in range(4, 33)
    )
    cuts = list(cuts)
    enough = [s for s in cuts if s.count * s.bits >= 1.7 * digits]
    return enough[0] if enough else max(cuts, key=lambda s: s.count * s.bits)


def pair(M: Float[Array, "n m"]) -> Float[Array, "2 n m"]:
    """A matrix as an unevaluated sum of two."""
    return jnp.stack([M, jnp.zeros_like(M)])


def product(
    left: Float[Array, "2 n k"], right: Float[Array, "2 k m"], s: Slices
) -> tuple[Float[Array, "levels n m"], Float[Array, " n"]]:
    """`sum(left) @ sum(right)` as a sum from high to low, and by how much entries in
    each row may be wrong.

    Each factor is cut into slices of so few bits that the products of slices, and their
    sums, are exact. So the result depends neither on the order of summation nor on
    fused operations, which compilers choose, and one product of larger matrices does
    the work.

    Source: Ozaki, Ogita, Oishi and Rump, 2012.
    """
    (n, k), m, count = left.shape[1:], right.shape[2], s.count
    both = jnp.concatenate([left, jnp.swapaxes(right, 1, 2)], axis=1)
    sizes = jnp.sum(jnp.abs(both), axis=0)
    # In units in which the k-th column and the k-th row are alike.
    across, down = jnp.max(sizes[:n], axis=0), jnp.max(sizes[n:], axis=0)
    unit = _power(jnp.sqrt(down) / jnp.sqrt(jnp.where(across > 0, across, 1)))
    unit = jnp.where(unit > 0, unit, 1)
    parts, size = _sliced(
        both * jnp.where(np.arange(n + m)[:, None] < n, unit, 1 / unit), s
    )
    rows, columns = parts[:, :n].reshape(-1, k), parts[:, n:].reshape(-1, k)
    products = (rows @ columns.T).reshape(count, n, count, m)
    # Slices i and j make a product of level i + j: each row of products moves one to
    # the right of the one above it, and the columns are summed.
    pairs = jnp.pad(jnp.swapaxes(products, 1, 2), ((0, 0), (0, count), (0, 0), (0, 0)))
    pairs = pairs.reshape(2 * count**2, n, m)[:-count]
    levels = jnp.sum(pairs.reshape(count, 2 * count - 1, n, m), axis=0)
    lost = 16 * k * 0.5 ** (count * s.bits) * jnp.max(size[n:])
    return levels, lost * size[:n, 0]


def rounded(levels: Float[Array, "levels n m"], lost: Array) -> tuple[Array, Array]:
    """A sum from high to low as one of two, and by how much entries may be wrong now,
    having been `lost` before."""
    room = math.ceil(math.log2(len(levels)))
    s = Slices(2, jnp.finfo(levels.dtype).nmant - 1 - room)
    pair, size = _sliced(levels, s)
    return pair, lost + 4 * len(levels) * 0.5 ** (2 * s.bits) * size[:, 0]


def added(levels: Float[Array, "levels n m"], M: Float[Array, "n m"]) -> Array:
    """A sum from high to low and a matrix that it nearly cancels."""
    # What is left of the higher levels is as small as those below them.
    return functools.reduce(operator.add, levels, M)


def _sliced(terms: Array, s: Slices) -> tuple[Array, Array]:
    """The sum of the terms as a sum of matrices of few bits, from high to low; and a
    power of two for each row, of which its entries are whole multiples."""
    size = jnp.max(jnp.sum(jnp.abs(terms), axis=0), axis=1, keepdims=True)
    power = lax.max(_power(size), jnp.finfo(terms.dtype).tiny)

    def multiples(slices):
        # Nothing is a multiple of the step of slice 0.
        step = 2.0 ** (s.bits * np.arange(*slices)[:, None, None, None] - 2)
        step = step.astype(terms.dtype)
        return jnp.round(terms / power * step) / step

    parts = multiples((1, s.count + 1)) - multiples((0, s.count))
    return power * jnp.sum(parts, axis=1), power


def _power(x: Array) -> Array:
    """A power of two near each number."""
    # Rounded to no digit of the mantissa.
    return lax.reduce_precision(x, jnp.finfo(x.dtype).nexp, 0)
