"""Residuals of matrix equations with bounds on their rounding, and Newton steps."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
from jaxtyping import Float

from .._jax import matmul, numbers, vmap, while_loop, xp
from .._typing import Array, BoolScalar, Scalar, Square
from ..math._accurate import product, product_in_parts, units_of_sum
from ..math._linear_solve import solve, symmetric
from ..math._norms import largest, relative_and_total_size
from ._arguments import RiccatiData


_MARGIN = 1.01
"""A residual is a quotient of norms. This factor covers their rounding."""
_NEWTON_STEPS = 8
_FEW = 2**13
"""With at most this many multiplications, an accurate residual is as fast as one in
working precision, and is used from the start."""
_FINE = 64
"""A relative residual of this many units of rounding needs no correction."""


def tolerance(dtype: Any) -> float:
    """The largest relative residual of a solved equation."""
    return 1e-12 if xp.finfo(dtype).bits == 64 else 1e-5


class Residual(NamedTuple):
    """The residual of a Riccati equation.

    - `error`: the left side, evaluated at a rounded gain.
    - `relative`: the norm of `error`, divided by the sum of the norms of the terms.
    - `bounds`: upper bounds on the exact relative residual, at the exact gain and
      without rounding, in each of the requested units.
    - `K`: the best gain at `X`.
    - `closed_loop`: `A - B K`, or `E^-1 (A - B K)`.
    - `terms`: the sum of the norms of the terms, in each of the requested units.
    """

    error: Square
    relative: Scalar
    bounds: Float[Array, " units"]
    K: Float[Array, "m n"]
    closed_loop: Square
    terms: Float[Array, " units"]


def riccati_residual(
    discrete: bool,
    data: RiccatiData,
    X: Square,
    accurately: BoolScalar | bool,
    *others: Float[Array, " n"],
    maximisers: int = 0,
) -> Residual:
    r"""The residual of the Riccati equation at `X`.

    The left side is stationary in the gain, so a gain in working precision is enough.
    With `N = -K`, `L = A + B N` and `T = S' + R N`, the left side is

    `L'XE + E'XL + Q + S N + N'T - G'W^-1 G`, `W = R`, `G = B'XE + T`

    in continuous time, and in discrete time

    `L'XL - E'XE + Q + S N + N'T - G'W^-1 G`, `W = R + B'XB`, `G = B'XL + T`.

    G is only rounding, and the last term is of second order in it. The rounding of a
    product is bounded by the product of the absolute values of its factors. If this
    bound is too wide, the products are evaluated `accurately`, with more digits.

    The last `maximisers` controls maximise the cost, and their terms are counted
    separately. `others` are further units of the states: factors of the rows and
    columns of the equation.
    """
    A, B, Q, _, _, E = data
    (n, m), dtype = B.shape, A.dtype
    moved, cross, weight = stationary(discrete, data, X)
    weighted = X if E is None else E.T @ X
    # One factorisation gives the gain and the inverse. The absolute value of the
    # inverse bounds the last term. Its rounding matters little, because G is small.
    solved = solve(weight, xp.concatenate([cross.T, xp.eye(m, dtype=dtype)], axis=1))
    K, inverse = solved[:, :n], xp.abs(solved[:, n:])
    # The terms of the equation, for their norms. The two quadratic terms of a game are
    # separate, because they have opposite signs and may cancel in their sum.
    first = m - maximisers
    moved = matmul(moved, A)
    if discrete and E is not None:
        weighted = weighted @ E
    terms = [
        moved,
        weighted if discrete else moved,
        Q,
        matmul(cross[:, :first], K[:first]),
    ]
    if maximisers:
        terms.append(cross[:, first:] @ K[first:])

    working = _working(discrete, data, X, K)
    closed_loop = working[1] if E is None else solve(E, working[1])
    needed = xp.asarray(accurately)
    if accurately is True:
        left = _sharper(discrete, *data, X, *working)
    else:
        left = _evaluated(discrete, *data, X, *working)
    if not isinstance(accurately, bool):

        def sharper(wide, X, K):
            left = _sharper(discrete, *data, X, *_working(discrete, data, X, K))
            # If nothing cancels, the first bound may be the smaller one.
            better = left.lost < wide.lost
            error = xp.where(better, left.error, wide.error)
            lost = xp.minimum(left.lost, wide.lost)
            return _Left(
                error, lost, wide.gap, xp.minimum(left.gap_lost, wide.gap_lost)
            )

        left = if_needed(needed, sharper, left, (X, K))
    error, lost, gap, gap_lost = left
    gap = xp.abs(gap) + gap_lost
    # |G'W^-1 G| <= |G|' |W^-1| |G| entry by entry. 2 covers the rounding of W^-1.
    bound = xp.abs(error) + lost + 2 * matmul(gap.T, matmul(inverse, gap))

    both, terms = xp.stack([error, bound]), xp.stack(terms)

    def in_units(d):
        factor = d[:, None] * d
        return relative_and_total_size(both * factor, terms * factor)

    # The units are powers of two, so the products have no rounding.
    units = xp.stack([xp.ones(n, dtype), *others])
    relative, sizes = vmap(in_units)(units)
    bounds = _MARGIN * relative[:, 1]
    relative = xp.max(xp.where(needed, bounds, relative[:, 0]))
    return Residual(error, relative, bounds, K, closed_loop, sizes)


def is_small(B: Array) -> bool:
    """Whether an accurate residual costs no more than one in working precision."""
    n, m = B.shape
    return (3 * n + 2 * m) * 2 * (n + m) * n <= _FEW


def if_needed(needed: BoolScalar, function: Callable, value: Any, operands: tuple):
    """`function(value, *operands)` if it is needed, else `value`.

    This is a loop of at most one round. It does not run if no member of a batch needs
    it, but `lax.cond` would compute both branches. The operands are carried and
    changed, because compilers would otherwise hoist the work out of the loop.
    """

    def once(carry):
        _, operands, value = carry
        nothing = jax.tree.map(xp.zeros_like, operands)
        return xp.zeros_like(needed), nothing, function(value, *operands)

    start = needed, operands, value
    return while_loop(lambda carry: carry[0], once, start)[2]


def stationary(
    discrete: bool, data: RiccatiData, X: Square
) -> tuple[Array, Array, Array]:
    """`E'X`, `E'XB + S` and `R`, or in discrete time `A'X`, `A'XB + S` and `R + B'XB`.
    The best gain follows from the last two."""
    A, B, _, R, S, E = data
    if discrete:
        moved, weight = matmul(A.T, X), R + symmetric(matmul(B.T, matmul(X, B)))
    else:
        moved, weight = X if E is None else E.T @ X, R
    return moved, matmul(moved, B) + S, weight


class _Left(NamedTuple):
    """The left side and G, with bounds on the rounding error of each entry."""

    error: Array
    lost: Array
    gap: Array
    gap_lost: Array


def _working(discrete: bool, data: RiccatiData, X: Array, K: Array) -> tuple:
    """N, L, T, Y = XL (XE in continuous time) and Z = XE."""
    A, B, _, R, S, E = data
    N = -K
    L, T = A + product_in_parts(B, N), S.T + matmul(R, N)
    Z = X if E is None else product_in_parts(X, E)
    return N, L, T, product_in_parts(X, L) if discrete else Z, Z


def _evaluated(discrete, A, B, Q, R, S, E, X, N, L, T, Y, Z) -> _Left:
    """The residual, in working precision."""
    n, m = B.shape
    # Higham's model: fl(a op b) = (a op b) (1 + d) with |d| <= unit. The error of a sum
    # of k products is at most k units times the sum of their absolute values. `lost_M`
    # is this bound for M. `from_L` is the effect of an error in L on XL. The rounded
    # gain -N counts as exact, because any gain gives a valid bound.
    unit = xp.finfo(A.dtype).eps / 2
    size_B, size_S, size_X, size_N = (xp.abs(M) for M in (B, S, X, N))
    lost_L = (units_of_sum(m) + 1) * unit * (xp.abs(A) + matmul(size_B, size_N))
    lost_T = (m + 1) * unit * (size_S.T + matmul(xp.abs(R), size_N))
    most_L, size_T = xp.abs(L) + lost_L, xp.abs(T)
    units = units_of_sum(n)
    lost_Z = xp.zeros_like(X)
    if E is not None:
        lost_Z = units * unit * (size_X @ xp.abs(E))
    if discrete:
        lost_Y = units * unit * matmul(size_X, most_L)
        from_L = matmul(size_X, lost_L)
        subtracted = Z if E is None else E.T @ Z
    else:
        lost_Y, from_L = lost_Z, xp.zeros_like(X)
        subtracted = xp.zeros_like(X)
    size_Y = xp.abs(Y)
    square = product_in_parts(L.T, Y)
    SN, NT = matmul(S, N), matmul(N.T, T)
    lost = matmul(most_L.T, units * unit * size_Y + lost_Y)
    # In discrete time both factors, L and XL, have the error of L.
    both = matmul(lost_L.T, size_Y + from_L / 2)
    if discrete:
        lost = lost + _twice(both)
        if E is not None:
            lost = lost + xp.abs(E).T @ (n * unit * xp.abs(Z) + lost_Z)
    else:
        square, lost = _twice(square), _twice(lost + both)
    lost = lost + m * unit * matmul(size_S, size_N)
    lost = lost + matmul(size_N.T, m * unit * size_T + lost_T)
    # Four additions, each of a result no larger than this sum, and a margin.
    lost = lost + 5 * unit * sum(xp.abs(M) for M in (square, subtracted, Q, SN, NT))
    gap_lost = matmul(size_B.T, (n + 2) * unit * size_Y + lost_Y + from_L)
    gap_lost = gap_lost + lost_T + 2 * unit * size_T
    error = square - subtracted + Q + SN + NT
    return _Left(error, lost, matmul(B.T, Y) + T, gap_lost)


def _sharper(discrete, A, B, Q, R, S, E, X, N, L, T, Y, Z) -> _Left:
    """The residual with more digits.

    `rest` holds the rounding errors of L, T, Y and Z. They are added once for each
    place at which their matrix appears in the equation.
    """
    n, m = B.shape
    eps, nothing = xp.finfo(A.dtype).eps, xp.zeros_like(X)
    right = dict(N=N, L=L, Y=Y, T=T) | ({} if E is None else dict(E=E, Z=Z))
    # Each row: the factors of N, L, ..., the added and the subtracted matrix, and the
    # factor of the rest in the equation.
    rows = [(dict(N=B), A, L, 2 * Y), (dict(N=R), S.T, T, N)]
    if discrete:
        rows.append((dict(L=X), nothing, Y, L))
    if E is not None:
        rows.append((dict(E=X), nothing, Z, -E if discrete else 2 * L))
    whole = dict(N=S, Y=L.T, T=N.T)
    if discrete:
        whole |= {} if E is None else dict(Z=-E.T)
    else:
        whole |= dict(L=Y.T)
    rows.append((whole, Q, X if discrete and E is None else nothing, nothing))
    factors, added, subtracted, factor = zip(*rows, strict=True)
    factor = xp.concatenate(factor)
    pairs = [
        product(
            xp.concatenate([*blocks.values()], axis=1),
            xp.concatenate([right[name] for name in blocks]),
            plus,
            -minus,
        )
        for blocks, plus, minus in zip(factors, added, subtracted, strict=True)
    ]
    value, rounding = (xp.concatenate(M) for M in zip(*pairs, strict=True))
    rest, rest_lost, factor = value[:-n], rounding[:-n], factor[:-n].T
    sizes = xp.abs(rest)
    most = sizes + rest_lost
    error = value[-n:] + matmul(factor, rest)
    lost = rest_lost + (4 * n + 2 * m + 8) * eps * sizes
    lost = rounding[-n:] + matmul(xp.abs(factor), lost)
    # The second-order terms, an error of L times an error of the other factor, are far
    # smaller than the first-order terms, so their largest entries are enough.
    error_L, around = largest(most[:n]), (n + 4) * eps * xp.abs(Y)
    if discrete:
        beside = largest(most[n + m : 2 * n + m]) + n * largest(X) * error_L
        lost, around = lost + 2 * n * error_L * beside, around + beside
    elif E is not None:
        beside = largest(most[n + m :])
        lost, around = lost + 2 * n * error_L * beside, around + beside
    gap_lost = matmul(xp.abs(B.T), around) + most[n : n + m] + (n + 4) * eps * xp.abs(T)
    return _Left(symmetric(error), symmetric(lost), matmul(B.T, Y) + T, gap_lost)


def _twice(M):
    """The sum of a matrix and its transpose."""
    return M + M.T


def linear_residual(discrete, A, B, C, X) -> Array:
    """The relative residual of a linear matrix equation.

    The equation is `A X + X B = C`, and the residual is divided by
    `(|A| + |B|) |X| + |C|`. In discrete time these are `X - A X B = C` and
    `(|A| |B| + 1) |X| + |C|`.

    This is the backward error: the relative change of the data that makes `X` exact. A
    bound on its rounding, which is small, is added.
    """
    eps = xp.finfo(X.dtype).eps
    size_A, size_B = xp.linalg.norm(A), xp.linalg.norm(B)
    if discrete:
        error, factor = X - A @ X @ B - C, 1 + size_A * size_B
        rounding = (sum(X.shape) + 2) * eps / 2
    else:
        error, factor = A @ X + X @ B - C, size_A + size_B
        rounding = (max(X.shape) + 2) * eps / 2
    terms = factor * xp.linalg.norm(X) + xp.linalg.norm(C)
    relative = xp.linalg.norm(error) / xp.where(terms == 0, 1, terms)
    relative = _MARGIN * (relative + rounding)
    return xp.where(xp.isfinite(relative), relative, xp.inf)


class Refined(NamedTuple):
    """The best point of a refinement, and its residual as in `Residual`.

    The point holds `X`, its gain and its closed loop, one below the other.
    """

    point: Float[Array, "rows n"]
    relative: Scalar
    bounds: Float[Array, " units"]
    terms: Float[Array, " units"]

    X = property(lambda self: matrices_of(self.point)[0])
    K = property(lambda self: matrices_of(self.point)[1])
    closed_loop = property(lambda self: matrices_of(self.point)[2])


def matrices_of(point: Float[Array, "rows n"]) -> tuple[Square, Array, Square]:
    """`X`, `K` and the closed loop of a point."""
    n = point.shape[1]
    return point[:n], point[n:-n], point[-n:]


def newton_refine(
    residual: Callable[[Array, Array], Residual],
    correction: Callable[[Array, Array, Array], Array],
    X: Square,
    *,
    controls: int,
    units: int,
    to_working_precision: bool = False,
) -> Refined:
    """Newton refinement while the residual decreases.

    `residual(X, accurately)` evaluates the residual, and
    `correction(X, closed_loop, error)` is the Newton step. `controls` is the number of
    controls, and `units` the number of units of the residual. If the bound of the
    residual is too wide for a certificate, the steps continue with accurate residuals,
    unless `to_working_precision`.

    Source: Kleinman, 1968 (each step solves the Lyapunov equation of the last loop).
    """
    n, dtype = len(X), X.dtype
    fine, wide = _FINE * float(xp.finfo(dtype).eps), tolerance(dtype)

    def body(carry):
        X, loop, error, best, before = carry
        going, patient, accurately, k, least = before[:5]
        # The first step is zero, because its error is zero: the first round only
        # evaluates the residual.
        X = symmetric(X + correction(X, loop, error))
        new = residual(X, (going > 0) & (accurately > 0))
        first = k == 0
        better = first | (new.relative < least)
        # A step that helps little is at the level of rounding. But far from the
        # solution the residual may increase in the first step.
        helped = first | (new.relative < least / 4)
        point = xp.concatenate([X, new.K, new.closed_loop])
        best = xp.where(better, point, best)
        measured = xp.concatenate([new.bounds, new.terms])
        measured = xp.where(better, measured, before[5:])
        least = xp.where(better, new.relative, least)
        again = helped | (patient > 0) & (least > wide)
        again = again & (least > fine) & (k < _NEWTON_STEPS)
        # The bound is too wide for a certificate, so repeat from the best point with
        # accurate residuals.
        hidden = ~again & ~(accurately > 0) & (xp.max(measured[:units]) > wide)
        X = xp.where(hidden, best[:n], X)
        after = numbers(
            again | hidden,
            helped,
            (accurately > 0) | hidden,
            xp.where(hidden, 0, k + 1),
            least,
            dtype=dtype,
        )
        error = xp.where(again, new.error, 0)
        return X, new.closed_loop, error, best, xp.concatenate([after, measured])

    eye = xp.eye(n, dtype=dtype)
    # With a stable loop and a zero error the correction is zero.
    best = xp.zeros((2 * n + controls, n), dtype)
    begin = numbers(1, 1, to_working_precision, *[0] * (2 + 2 * units), dtype=dtype)
    start = X, -eye / 2, xp.zeros_like(X), best, begin
    *_, best, end = while_loop(lambda carry: carry[-1][0] > 0, body, start)
    return Refined(best, end[4], end[5 : 5 + units], end[5 + units :])
