"""The matrix exponential."""

import functools
import math

from .._jax import fori_loop, stop_gradient, xp
from .._typing import Array, Scalar, Square
from ._linear_solve import solve
from ._norms import power_of_two


_ORDER = 13
_NEAR = 5.37
"""Up to this norm the Padé approximant is exact to rounding, also in float64."""
_MAX_SQUARINGS = 32


def exponential(A: Square) -> Square:
    """`exp(A)` by scaling and squaring; NaN if the norm of `A` is above 1e10.

    Source: Higham, 2005.
    """
    size = stop_gradient(xp.linalg.norm(A, 1))
    squarings = xp.maximum(xp.ceil(xp.log2(size / _NEAR)), 0)
    A = A * xp.where(squarings <= _MAX_SQUARINGS, 0.5**squarings, xp.nan)
    eye = xp.eye(len(A), dtype=A.dtype)
    square = A @ A
    powers = [eye, square, square @ square]
    powers.append(square @ powers[-1])
    c = [math.comb(_ORDER, k) / math.perm(2 * _ORDER, k) for k in range(_ORDER + 1)]

    def even(c):
        """The polynomial `c[0] + c[1] A^2 + c[2] A^4 + ...`."""
        low = sum(a * power for a, power in zip(c[:4], powers, strict=True))
        high = sum(a * power for a, power in zip(c[4:], powers[1:], strict=True))
        return low + powers[-1] @ high

    # The approximant p(A) / p(-A), from the even part V and the odd part U of p.
    V, U = even(c[::2]), A @ even(c[1::2])
    start = solve(V - U, V + U)

    # A loop of fixed length, which reverse mode needs.
    def double(k, E):
        more = k < squarings
        # Unused powers are set to zero, because an overflow would reach the derivative.
        safe = xp.where(more, E, 0)
        return xp.where(more, safe @ safe, E)

    return fori_loop(0, _MAX_SQUARINGS, double, start)


def exponential_of_blocks(A: Array, B: Array, C: Array) -> tuple[Array, Array, Array]:
    """The blocks of `exp([[A, B], [0, C]])` that are not zero: upper left, upper right
    and lower right.

    `B` is made smaller, because the squarings for a large `B` would lose the digits of
    `A` and `C`. The upper right block is linear in `B`.
    """
    n, unit = len(A), unit_beside(B, A, C)
    zero = xp.zeros((len(C), n), A.dtype)
    E = exponential(xp.block([[A, B / unit], [zero, C]]))
    return E[:n, :n], E[:n, n:] * unit, E[n:, n:]


def unit_beside(B: Array, *others: Array) -> Scalar:
    """A power of two of at least 1. In this unit, `B` is at most about as large as 1 or
    the largest of `others`."""
    size = lambda M: xp.linalg.norm(stop_gradient(M), 1)
    most = functools.reduce(xp.maximum, map(size, others), 1)
    return power_of_two(xp.maximum(size(B) / most, 1))
