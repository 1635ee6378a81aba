"""Residuals of matrix equations with rigorous rounding-error bounds, and Newton
steps."""

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
"""Covers the rounding of the norms that a residual is the quotient of."""
_NEWTON_STEPS = 8
_FEW = 2**13
"""Up to so many scalar products in an accurate residual it is taken at once: it is as
fast as one in working precision."""
_FINE = 64
"""Units of rounding in the relative residual that need no correction."""


def tolerance(dtype: Any) -> float:
    """The relative residual up to which an equation counts as solved."""
    return 1e-12 if xp.finfo(dtype).bits == 64 else 1e-5


class Residual(NamedTuple):
    """The residual of a Riccati equation.

    - `error`: the left side, evaluated at a rounded gain.
    - `relative`: its norm over the sum of the norms of the terms.
    - `bounds`: upper bounds on the exact relative residual, at the exact gain and
      without rounding, in each of the requested units.
    - `K`: the best gain at `X`.
    - `closed_loop`: `A - B K`, or `E^-1 (A - B K)`.
    - `terms`: the sum of the norms of the terms, in each of these units.
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

    The left side is stationary in the gain, so that one in working precision is enough.
    With `N = -K`, `L = A + B N` and `T = S' + R N` it is

    `L'XE + E'XL + Q + S N + N'T - G'W^-1 G`, `W = R`, `G = B'XE + T`, or
    `L'XL - E'XE + Q + S N + N'T - G'W^-1 G`, `W = R + B'XB`, `G = B'XL + T`,

    in continuous and in discrete time. G is rounding alone, and the last term its
    square. The rounding of each product is bounded by the product of the absolute
    values of its factors. Where this bound is too wide they are evaluated `accurately`.

    The last `maximisers` controls are those of a maximising player, whose terms are
    counted separately. `others` are other units of the states, in which rows and
    columns of the equation are multiplied by these.
    """
    A, B, Q, _, _, E = data
    (n, m), dtype = B.shape, A.dtype
    moved, cross, weight = stationary(discrete, data, X)
    weighted = X if E is None else E.T @ X
    # One factorisation for the gain and for the inverse, whose absolute value bounds
    # the last term: G is small, so that its own rounding matters little.
    solved = solve(weight, xp.concatenate([cross.T, xp.eye(m, dtype=dtype)], axis=1))
    K, inverse = solved[:, :n], xp.abs(solved[:, n:])
    # The terms of the equation, for their norms. A game's two quadratic terms have
    # opposite signs: their sum would hide how large they are.
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
            # Where nothing cancels the first bound may be the sharper one.
            better = left.lost < wide.lost
            error = xp.where(better, left.error, wide.error)
            lost = xp.minimum(left.lost, wide.lost)
            return _Left(
                error, lost, wide.gap, xp.minimum(left.gap_lost, wide.gap_lost)
            )

        left = if_needed(needed, sharper, left, (X, K))
    error, lost, gap, gap_lost = left
    gap = xp.abs(gap) + gap_lost
    # |G'W^-1 G| <= |G|' |W^-1| |G| entry by entry; 2 covers the rounding of W^-1.
    bound = xp.abs(error) + lost + 2 * matmul(gap.T, matmul(inverse, gap))

    both, terms = xp.stack([error, bound]), xp.stack(terms)

    def in_units(d):
        factor = d[:, None] * d
        return relative_and_total_size(both * factor, terms * factor)

    # Powers of two: their products have no rounding.
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
    """`function(value, *operands)` where it is needed, else `value`.

    By a loop of at most one round, which is not run for a batch in which no member
    needs it; `lax.cond` would compute both branches. The operands are carried and
    changed, or compilers would hoist the work out of the loop.
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
    """`E'X`, `E'XB + S` and `R`, or `A'X`, `A'XB + S` and `R + B'XB` in discrete time:
    of the last two follows the best gain."""
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
    # Higham's model: fl(a op b) = (a op b) (1 + d) with |d| <= unit, and a product of k
    # terms is off by k units of the product of absolute values. `lost_M` is that bound
    # for M, `from_L` is what an error of L does to XL. The rounded gain -N is taken for
    # exact: any gain gives a valid bound.
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
    # In discrete time an error of L is in both factors, as the second one is XL.
    both = matmul(lost_L.T, size_Y + from_L / 2)
    if discrete:
        lost = lost + _twice(both)
        if E is not None:
            lost = lost + xp.abs(E).T @ (n * unit * xp.abs(Z) + lost_Z)
    else:
        square, lost = _twice(square), _twice(lost + both)
    lost = lost + m * unit * matmul(size_S, size_N)
    lost = lost + matmul(size_N.T, m * unit * size_T + lost_T)
    # Four additions, each of a sum no larger than that of the sizes, and a margin.
    lost = lost + 5 * unit * sum(xp.abs(M) for M in (square, subtracted, Q, SN, NT))
    gap_lost = matmul(size_B.T, (n + 2) * unit * size_Y + lost_Y + from_L)
    gap_lost = gap_lost + lost_T + 2 * unit * size_T
    error = square - subtracted + Q + SN + NT
    return _Left(error, lost, matmul(B.T, Y) + T, gap_lost)


def _sharper(discrete, A, B, Q, R, S, E, X, N, L, T, Y, Z) -> _Left:
    """The residual in more digits.

    The rests are the rounding errors of L, T, Y and Z. They enter the sum once for each
    place at which their matrix stands in the equation.
    """
    n, m = B.shape
    eps, nothing = xp.finfo(A.dtype).eps, xp.zeros_like(X)
    right = dict(N=N, L=L, Y=Y, T=T) | ({} if E is None else dict(E=E, Z=Z))
    # Each row: the factors of N, L, ..., what is added, what is subtracted; and how a
    # rest stands in the equation.
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
    # The second-order terms, an error of L times one of the factor beside it, are far
    # below those of the first order: the largest entries will do.
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
    """A matrix and its transpose."""
    return M + M.T


def linear_residual(discrete, A, B, C, X) -> Array:
    """The residual of `A X + X B = C`, or of `X - A X B = C`, over
    `(|A| + |B|) |X| + |C|`, or over `(|A| |B| + 1) |X| + |C|`.

    It is the backward error: the relative change of the data that makes `X` exact.
    Relative to these norms rounding is small, and its bound is added.
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
    """The best point of a refinement: `X`, its gain and closed loop one below the
    other; and its residual, as of `Residual`."""

    point: Float[Array, "rows n"]
    relative: Scalar
    bounds: Float[Array, " units"]
    terms: Float[Array, " units"]

    X = property(lambda self: matrices_of(self.point)[0])
    K = property(lambda self: matrices_of(self.point)[1])
    closed_loop = property(lambda self: matrices_of(self.point)[2])


def matrices_of(point: Float[Array, "rows n"]) -> tuple[Square, Array, Square]:
    """`X`, `K` and the closed loop."""
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

    `residual(X, accurately)` evaluates the residual, of so many `controls` and in so
    many `units`, and `correction(X, closed_loop, error)` is the Newton step. Where its
    bound is too wide for a certificate the steps go on with accurate residuals, unless
    they are to end in working precision.

    Source: Kleinman, 1968; each step solves the Lyapunov equation of the last loop.
    """
    n, dtype = len(X), X.dtype
    fine, wide = _FINE * float(xp.finfo(dtype).eps), tolerance(dtype)

    def body(carry):
        X, loop, error, best, before = carry
        going, patient, accurately, k, least = before[:5]
        # The first step is zero, as its error is: the first round measures.
        X = symmetric(X + correction(X, loop, error))
        new = residual(X, (going > 0) & (accurately > 0))
        first = k == 0
        better = first | (new.relative < least)
        # Steps that gain little are at the level of rounding. But far from the solution
        # the residual may rise in the first one.
        helped = first | (new.relative < least / 4)
        point = xp.concatenate([X, new.K, new.closed_loop])
        best = xp.where(better, point, best)
        measured = xp.concatenate([new.bounds, new.terms])
        measured = xp.where(better, measured, before[5:])
        least = xp.where(better, new.relative, least)
        again = helped | (patient > 0) & (least > wide)
        again = again & (least > fine) & (k < _NEWTON_STEPS)
        # The bound is too wide for a certificate: once more, accurately, from the best.
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
    # Of a stable loop without an error the correction is zero.
    best = xp.zeros((2 * n + controls, n), dtype)
    begin = numbers(1, 1, to_working_precision, *[0] * (2 + 2 * units), dtype=dtype)
    start = X, -eye / 2, xp.zeros_like(X), best, begin
    *_, best, end = while_loop(lambda carry: carry[-1][0] > 0, body, start)
    return Refined(best, end[4], end[5 : 5 + units], end[5 + units :])
