"""The spectral radius and abscissa of a matrix, by repeated squaring."""

import math

import numpy as np

from .._jax import matmul, while_loop, xp
from .._typing import BoolScalar, Scalar, Square
from ..math._norms import largest, power_of_two, size


_SQUARINGS = 60
"""Beyond it no more digits of `log |A^N| / N` are to be had in float64."""
_DIGITS = 1e-8
"""Of the logarithm of the spectral radius."""
_LARGE = 16
"""From here on it pays to look for the few directions that a power has left."""
_BLOCK = 4
_TAYLOR_DEGREE = 12
_SWEEPS = 24


def spectral_radius(A: Square) -> Scalar:
    """The spectral radius, from above up to rounding: `|A^N|^(1/N)` for a large `N`.

    The bound holds for every N (Gelfand), and is above the radius by a relative
    `log(cond) / N`, with `cond` the condition of the eigenvectors. Of a large matrix a
    few squarings leave only few directions; the rest is done in their span.
    """
    # In the span of the remaining directions the products are of small matrices.
    logarithm, is_narrow, span, _ = _growth(A, A.shape[0] > _LARGE)
    if A.shape[0] > _LARGE:
        within, *_ = _growth(span.T @ A @ span, False)
        logarithm = xp.where(is_narrow, within, logarithm)
    return xp.exp(logarithm)


def spectral_abscissa(A: Square) -> Scalar:
    """The largest real part of an eigenvalue, up to rounding of the balanced matrix."""
    return abscissa_and_size(balanced(A))[0]


def abscissa_and_size(
    A: Square,
) -> tuple[Scalar, Scalar]:
    """The spectral abscissa, up to rounding of the matrix, and its norm.

    `h^-1 log` of the spectral radius of `exp(h A)`, with `h` small enough for a series.
    """
    value, is_narrow, span, kept = _slowest(A, A.shape[0] > _LARGE)
    if A.shape[0] > _LARGE:
        part = span.T @ A @ span
        # Directions left out come last.
        part = part - xp.diag(xp.where(kept, 0, size(part)))
        within, *_ = _slowest(part, False)
        value = xp.where(is_narrow, within, value)
    return value, size(A)


def _slowest(A, probing):
    flow, h = _short_flow(A)
    logarithm, *rest = _growth(flow, probing)
    return logarithm / h, *rest


def _short_flow(A):
    """`exp(hA)`, and `h`: `|exp(hA)^N|^(1/N)` tends to `exp(h abscissa)`, `h > 0`."""
    scale = size(A)
    h = 0.25 / xp.where(scale > 0, scale, 1)
    return _exponential(h * A), h


def is_stable(discrete: bool, A: Square, margin: Scalar | float) -> BoolScalar:
    """Whether the spectral radius is below one, or the abscissa below zero, by a
    margin. As the bounds hold for every power, a few squarings tell of most matrices.
    """
    if discrete:
        flow, limit = A, xp.log1p(-xp.asarray(margin, A.dtype))
    else:
        flow, h = _short_flow(balanced(A))
        limit = -margin * h
    return _growth(flow, False, limit)[0] < limit


def _exponential(A):
    """`exp(A)` for `|A| <= 1/4`, where the series is exact to rounding."""
    # By blocks of four terms, in Horner's way: six products for twelve terms
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
    """`log |A^N| / N` for a large `N`; with a `limit`, for one that tells on which
    side of it the value for all larger `N` is. If `probing`, also whether an earlier
    power has few directions left, a basis of them, and which of its columns are used.
    """
    n, dtype = A.shape[0], A.dtype
    eps = float(xp.finfo(dtype).eps)
    # Probes with a fixed seed: equal problems have equal results.
    count = max(n // 4 if n <= 64 else n // 16, min(n, _LARGE))
    probes = np.random.default_rng(0).normal(size=(n, count)) if probing else 0.0
    probes = xp.asarray(probes, dtype)

    def above(logarithm, weight):
        # |A| is at most n times the largest entry; the weight is of the next power.
        return logarithm + 2 * weight * math.log(n)

    def more(carry):
        *_, logarithm, weight, finished = carry
        # N = 1 / weight: for a log cond of up to 64 the bound is this close.
        rough = 64 * weight > _DIGITS * xp.maximum(xp.abs(logarithm), eps)
        if limit is not None:
            bound = above(logarithm, weight)
            rough = rough & (bound >= limit) & (bound - 64 * weight <= limit)
        return ~finished & rough & (weight > 0.5**_SQUARINGS)

    def squared(power, logarithm, weight):
        grown = largest(power)
        # A nilpotent matrix, whose radius is zero: no power of it is scaled any more.
        finished = ~(grown > 0)
        scaled = power * (1 / xp.where(finished, 1, grown))
        # log |A^2N| / 2N is this sum, as each square is of a matrix of norm one. The
        # norm is the largest entry, which for the flow of a short time is nearly one:
        # logarithms of others would cancel.
        logarithm = logarithm + weight * xp.log(grown)
        return matmul(scaled, scaled), logarithm, weight / 2, scaled, finished

    def body(carry):
        power, span, kept, logarithm, weight, _ = carry
        if probing:
            # Probing takes as long as a square: it is left out in between.
            power, logarithm, weight, *_ = squared(power, logarithm, weight)
        power, logarithm, weight, scaled, finished = squared(power, logarithm, weight)
        if probing:
            # A basis of the range of the power, as the probes see it. What is as small
            # as the rounding of the rest is no direction of it.
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


def balanced(A: Square) -> Square:
    """`D^-1 A D` with `D` diagonal, its rows and columns of like size.

    Powers of two, so that no digit is lost. Source: Osborne, 1960.
    """

    def more(carry):
        k, _, ratio = carry
        return (k < _SWEEPS) & (xp.max(xp.abs(xp.log2(ratio))) > 1)

    def sweep(carry):
        k, scale, _ = carry
        scaled = xp.abs(A) * scale[None, :] / scale[:, None]
        off = scaled - xp.diag(xp.diagonal(scaled))
        rows, columns = xp.sum(off, axis=1), xp.sum(off, axis=0)
        usable = (rows > 0) & (columns > 0)
        # The square root of this ratio makes a row as large as its column.
        ratio = xp.where(usable, rows, 1) / xp.where(usable, columns, 1)
        # All at once: half of the step that each would take alone.
        scale = scale * ratio**0.25
        return k + 1, scale / xp.exp2(xp.round(xp.mean(xp.log2(scale)))), ratio

    # Balancing need not be exact.
    one = xp.ones(A.shape[0], A.dtype)
    _, scale, _ = while_loop(more, sweep, (0, one, 4 * one))
    usable = xp.isfinite(scale) & (scale > 0)
    scale = power_of_two(xp.where(usable, scale, 1))
    return A * scale[None, :] / scale[:, None]
