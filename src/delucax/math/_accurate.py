"""Matrix products with more digits than the precision of their factors."""

import itertools
import math

import numpy as np
from jaxtyping import Float

from .._jax import lax, matmul, on_host, scan, xp
from .._typing import Array
from ._linear_solve import full_precision
from ._norms import power_of_two


_SMALL = 2**15
"""Up to this number of scalar products, one loop over the sums is as fast as several
matrix products, and XLA compiles it in half the time."""
_PARTS = 8
_LONG = 64
_LONGEST = 512
"""Up to this number of terms, one slice of the factors suffices in double precision."""


@full_precision
def product(
    left: Float[Array, "n k"], right: Float[Array, "k m"], *added: Float[Array, "n m"]
) -> tuple[Float[Array, "n m"], Float[Array, "n m"]]:
    """The product of two matrices plus the `added` ones, and entrywise error bounds.

    It is accurate even under cancellation. The bounds include all rounding, but not
    underflow.
    """
    # Static sizes decide, so only one of the two is compiled. NumPy is slow at loops.
    if on_host() or left.size * right.shape[1] > _SMALL:
        return _by_slices(left, right, *added)
    return _term_by_term(left, right, *added)


def _term_by_term(left, right, *added):
    """The product by the exact parts of each term and the rounding error of each sum.

    Source: Ogita, Rump and Oishi, 2005.
    """
    eps, k = xp.finfo(left.dtype).eps, left.shape[1]
    column, row = left[:, :, None], right[None]
    (high, low), (high_row, low_row) = _halves(column), _halves(row)
    # These products have no rounding, so fused operations do not change the sums.
    middle, off = _sum(high * low_row, low * high_row)
    term, error = _sum(high * high_row, middle)
    off = off + error + low * low_row

    def add(one, other):
        total, error = _sum(one[0], other[0])
        return total, one[1] + other[1] + error, one[2] + other[2]

    # A reduction is one loop, also for a batch, and stores nothing.
    terms, zero = (term, off, xp.abs(term)), xp.zeros((), left.dtype)
    total, off, size = lax.reduce(terms, (zero, zero, zero), add, (1,))
    for part in added:
        total, error = _sum(total, part)
        off, size = off + error, size + xp.abs(part)
    total = total + off
    return total, eps * xp.abs(total) + (4 * (k + len(added) + 1) * eps) ** 2 * size


def _by_slices(left, right, *added):
    """The product by slices of the factors. Slices have so few bits that their products
    are exact, in any order of summation and with fused operations. The remainders of
    the factors are small, and so is the rounding of their products, which are added
    last.

    Source: Ozaki, Ogita, Oishi and Rump, 2012.
    """
    (n, k), m, dtype = left.shape, right.shape[1], left.dtype
    eps, digits = xp.finfo(dtype).eps, xp.finfo(dtype).nmant + 1
    # A long sum leaves few bits to a slice: the sum of k products of two slices must
    # fit into the digits.
    count = 1 if digits > 50 and k <= _LONGEST else 2
    bits = int((digits - math.log2(count * k)) / 2)
    both = xp.concatenate([left, right.T])
    # Scaled, so that each column and the row that it meets have about the same size.
    across, down = (xp.max(xp.abs(M), axis=0) for M in (both[:n], both[n:]))
    unit = power_of_two(xp.sqrt(down) / xp.sqrt(xp.where(across > 0, across, 1)))
    unit = xp.where(unit > 0, unit, 1)
    both = both * xp.where(np.arange(n + m)[:, None] < n, unit, 1 / unit)
    power = power_of_two(xp.max(xp.abs(both), axis=1, keepdims=True))
    power = lax.max(power, xp.finfo(dtype).tiny)
    # Entries are rounded to smaller and smaller steps. Slices are the differences.
    step = 2.0 ** (bits * np.arange(1, count + 1)[:, None, None] - 2)
    step = step.astype(dtype)
    whole = power * (xp.round(both / power * step) / step)
    rests = [both, *(both - M for M in whole)]
    slices = [whole[0], *(b - a for a, b in itertools.pairwise(whole))]

    def side_by_side(rows, columns):
        rows = xp.concatenate([M[:n] for M in rows], axis=1)
        return rows, xp.concatenate([M[n:] for M in columns], axis=1).T

    exact = (side_by_side(slices[: i + 1], slices[i::-1]) for i in range(count))
    parts = [*added, *(rows @ columns for rows, columns in exact)]
    rows, columns = side_by_side([*slices, rests[-1]], rests[::-1])
    total, off = parts[0], 0
    for part in parts[1:]:
        total, error = _sum(total, part)
        off = off + error
    total = total + off + rows @ columns
    lost = (rows.shape[1] + 2) * eps * (xp.abs(rows) @ xp.abs(columns))
    lost = lost + (len(parts) * eps) ** 2 * sum(xp.abs(part) for part in parts)
    return total, lost + eps * xp.abs(total)


def product_in_parts(
    left: Float[Array, "n k"], right: Float[Array, "k m"]
) -> Float[Array, "n m"]:
    """The product of two matrices, with long sums taken in parts. Its error is at most
    `units_of_sum(k)` units of rounding of the product of the absolute values.

    Source: Higham, 2002, sections 3.1 and 4.2; Jeannerod and Rump, 2013.
    """
    k = left.shape[1]
    if k < _LONG:
        return matmul(left, right)
    length = -(-k // _PARTS)
    pad = _PARTS * length - k
    left = xp.pad(left, ((0, 0), (0, pad))).reshape(len(left), _PARTS, length)
    right = xp.pad(right, ((0, pad), (0, 0))).reshape(_PARTS, length, -1)

    def add(total, factors):
        return total + factors[0] @ factors[1], None

    total = xp.zeros((len(left), right.shape[2]), left.dtype)
    return scan(add, total, (xp.swapaxes(left, 0, 1), right))[0]


def units_of_sum(k: int) -> int:
    """The bound of the error of `product_in_parts`, in units of rounding, for sums of
    `k` products in any order."""
    return k if k < _LONG else -(-k // _PARTS) + _PARTS


def _sum(a: Array, b: Array) -> tuple[Array, Array]:
    """`a + b`, and its rounding error (Knuth's two-sum)."""
    total = a + b
    part = total - a
    return total, (a - (total - part)) + (b - part)


def _halves(x: Array) -> tuple[Array, Array]:
    """`x` as the sum of two numbers of half the digits (Dekker's splitting)."""
    info = xp.finfo(x.dtype)
    high = lax.reduce_precision(x, info.nexp, (info.nmant + 1) // 2 - 1)
    return high, x - high
