"""The spectral radius and the spectral abscissa of a matrix, by repeated squaring."""

import math

import numpy as np

from .._jax import matmul, while_loop, xp
from .._typing import BoolScalar, Scalar, Square
from ..math._balancing import balanced
from ..math._norms import largest, size


_SQUARINGS = 60
"""More squarings give no further digits of `log |A^N| / N` in float64."""
_DIGITS = 1e-8
"""The relative error of the logarithm of the spectral radius."""
_LARGE = 16
"""For a larger matrix, the squaring continues in the few directions that remain."""
_BLOCK = 4
_TAYLOR_DEGREE = 12


def spectral_radius(A: Square) -> Scalar:
    """An upper bound on the spectral radius: `|A^N|^(1/N)` for a large `N`.

    It is an upper bound for every N (Gelfand), up to rounding. Its relative error is
    `log(cond) / N`, with `cond` the condition number of the eigenvectors. A few
    squarings of a large matrix leave only few directions. The rest is done in their
    span, with small matrices.
    """
    logarithm, is_narrow, span, _ = _growth(A, A.shape[0] > _LARGE)
    if A.shape[0] > _LARGE:
        within, *_ = _growth(span.T @ A @ span, False)
        logarithm = xp.where(is_narrow, within, logarithm)
    return xp.exp(logarithm)


def spectral_abscissa(A: Square) -> Scalar:
    """The largest real part of an eigenvalue, up to rounding of the balanced matrix."""
    return abscissa_and_size(balanced(A)[0])[0]


def abscissa_and_size(
    A: Square,
) -> tuple[Scalar, Scalar]:
    """The spectral abscissa, up to rounding of the matrix, and the norm of the matrix.

    The abscissa is `h^-1 log` of the spectral radius of `exp(h A)`. The series of
    `exp(h A)` needs a small `h`.
    """
    value, is_narrow, span, kept = _slowest(A, A.shape[0] > _LARGE)
    if A.shape[0] > _LARGE:
        part = span.T @ A @ span
        # The directions that are not kept get a very stable eigenvalue.
        part = part - xp.diag(xp.where(kept, 0, size(part)))
        within, *_ = _slowest(part, False)
        value = xp.where(is_narrow, within, value)
    return value, size(A)


def _slowest(A, probing):
    flow, h = _short_flow(A)
    logarithm, *rest = _growth(flow, probing)
    return logarithm / h, *rest


def _short_flow(A):
    """`exp(hA)` and `h > 0`: `|exp(hA)^N|^(1/N)` tends to `exp(h abscissa)`."""
    scale = size(A)
    h = 0.25 / xp.where(scale > 0, scale, 1)
    return _exponential(h * A), h


def is_stable(discrete: bool, A: Square, margin: Scalar | float) -> BoolScalar:
    """Whether the spectral radius is below 1, or the abscissa below 0, by a margin.

    The bounds hold for every power, so a few squarings are enough for most matrices.
    """
    if discrete:
        flow, limit = A, xp.log1p(-xp.asarray(margin, A.dtype))
    else:
        flow, h = _short_flow(balanced(A)[0])
        limit = -margin * h
    return _growth(flow, False, limit)[0] < limit


def _exponential(A):
    """`exp(A)` for `|A| <= 1/4`, where the series is exact to rounding."""
    # Blocks of four terms by Horner's rule: six products for twelve terms
    # (Paterson and Stockmeyer, 1973).
    powers = [xp.eye(A.shape[0], dtype=A.dtype), A]
    while len(powers) < _BLOCK:
        powers.append(powers[-1] @ A)
    step = powers[-1] @ A
    total = xp.zeros_like(A)
    for start in reversed(range(0, _TAYLOR_DEGREE, _BLOCK)):
        terms = (powers[j] / math.factorial(start + j) for j in range(_BLOCK))
        total = total @ step + sum(terms)
    return total


def _growth(A, probing, limit=None):
    """An upper bound on `log |A^N| / N` for a large `N`. With a `limit`, `N` is only so
    large that the value for all larger `N` is known to be above or below the limit.

    If `probing`, also whether few directions remain in the power, a basis of them, and
    which columns of the basis are used.
    """
    n, dtype = A.shape[0], A.dtype
    eps = float(xp.finfo(dtype).eps)
    # The seed of the probes is fixed, so equal problems have equal results.
    count = max(n // 4 if n <= 64 else n // 16, min(n, _LARGE))
    probes = np.random.default_rng(0).normal(size=(n, count)) if probing else 0.0
    probes = xp.asarray(probes, dtype)

    def above(logarithm, weight):
        # |A| is at most n times the largest entry. The weight is of the next power.
        return logarithm + 2 * weight * math.log(n)

    def more(carry):
        *_, logarithm, weight, finished = carry
        # N = 1 / weight. The bound is this close if log cond is at most 64.
        rough = 64 * weight > _DIGITS * xp.maximum(xp.abs(logarithm), eps)
        if limit is not None:
            bound = above(logarithm, weight)
            rough = rough & (bound >= limit) & (bound - 64 * weight <= limit)
        return ~finished & rough & (weight > 0.5**_SQUARINGS)

    def squared(power, logarithm, weight):
        grown = largest(power)
        # A power of a nilpotent matrix becomes zero, and then is not scaled.
        finished = ~(grown > 0)
        scaled = power * (1 / xp.where(finished, 1, grown))
        # log |A^2N| / 2N is this sum, because each squared matrix has norm one. The
        # norm is the largest entry, which is nearly one for the flow of a short time.
        # Logarithms of another norm would cancel in the sum.
        logarithm = logarithm + weight * xp.log(grown)
        return matmul(scaled, scaled), logarithm, weight / 2, scaled, finished

    def body(carry):
        power, span, kept, logarithm, weight, _ = carry
        if probing:
            # Probing takes as long as squaring, so square twice for each probing.
            power, logarithm, weight, *_ = squared(power, logarithm, weight)
        power, logarithm, weight, scaled, finished = squared(power, logarithm, weight)
        if probing:
            # A basis of the range of the power, from the probes. Directions that are as
            # small as the rounding of the others do not belong to it.
            basis, triangle = xp.linalg.qr(scaled @ probes)
            pivots = xp.abs(xp.diagonal(triangle))
            kept = pivots > math.sqrt(eps) * xp.max(pivots)
            span = xp.where(kept, basis, 0)
            left = largest(scaled - span @ (span.T @ scaled))
            finished = finished | (left < 4 * math.sqrt(n) * eps)
        return power, span, kept, logarithm, weight, finished

    zero, one = xp.zeros((), dtype), xp.ones((), dtype)
    start = (A, probes, xp.zeros(count, bool), zero, one, xp.asarray(False))
    _, span, kept, logarithm, weight, finished = while_loop(more, body, start)
    narrow = finished & xp.isfinite(logarithm)
    return above(logarithm, weight), narrow, span, kept
