"""Residuals of matrix equations with rigorous rounding-error bounds, and Newton
steps."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
from jaxtyping import Float

from .._jax import vmap, while_loop, xp
from .._typing import Array, BoolScalar, Scalar, Square
from ..math._accurate import product, product_in_parts
from ..math._linear_solve import solve, symmetric
from ..math._norms import relative_and_total_size
from ._arguments import RiccatiData


_MARGIN = 1.01
"""Covers the rounding of the norms that a residual is the quotient of."""
_NEWTON_STEPS = 8
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
    moved = moved @ A
    if discrete and E is not None:
        weighted = weighted @ E
    terms = [moved, weighted if discrete else moved, Q, cross[:, :first] @ K[:first]]
    if maximisers:
        terms.append(cross[:, first:] @ K[first:])

    working, left = _evaluated(discrete, *data, X, K)
    closed_loop = working[1] if E is None else solve(E, working[1])
    needed = xp.asarray(accurately)
    if accurately is not False:
        sharper = lambda left, *working: _sharper(discrete, *data, X, working, left)
        left = if_needed(needed, sharper, left, working)
    error, lost, gap, gap_lost = left
    gap = xp.abs(gap) + gap_lost
    # |G'W^-1 G| <= |G|' |W^-1| |G| entry by entry; 2 covers the rounding of W^-1.
    bound = xp.abs(error) + lost + 2 * gap.T @ (inverse @ gap)

    both, terms = xp.stack([error, bound]), xp.stack(terms)

    def in_units(d):
        factor = d[:, None] * d
        return relative_and_total_size(both * factor, terms * factor)

    # Powers of two: their products have no rounding.
    units = xp.stack([xp.ones(n, dtype), *others])
    relative, sizes = vmap(in_units)(units)
    bounds = _MARGIN * relative[:, 1]
    relative = xp.where(needed, bounds[0], relative[0, 0])
    return Residual(error, relative, bounds, K, closed_loop, sizes)


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
        moved, weight = A.T @ X, R + symmetric(B.T @ (X @ B))
    else:
        moved, weight = X if E is None else E.T @ X, R
    return moved, moved @ B + S, weight


class _Left(NamedTuple):
    """The left side and G, with bounds on the rounding error of each entry."""

    error: Array
    lost: Array
    gap: Array
    gap_lost: Array


def _evaluated(discrete, A, B, Q, R, S, E, X, K) -> tuple[tuple, _Left]:
    """N, L, T, Y = XL (XE in continuous time), Z = XE, and the residual."""
    n, m = B.shape
    # Higham's model: fl(a op b) = (a op b) (1 + d) with |d| <= unit, and a product of k
    # terms is off by k units of the product of absolute values. `lost_M` is that bound
    # for M, `from_L` is what an error of L does to XL.
    unit = xp.finfo(A.dtype).eps / 2
    size_B, size_S, size_X, size_N = (xp.abs(M) for M in (B, S, X, K))
    # From here on the rounded gain -N is taken for exact: any gain gives a valid bound.
    N = -K
    BN, units_BN = product_in_parts(B, N)
    L, T = A + BN, S.T + R @ N
    lost_L = (units_BN + 1) * unit * (xp.abs(A) + size_B @ size_N)
    lost_T = (m + 1) * unit * (size_S.T + xp.abs(R) @ size_N)
    most_L, size_T = xp.abs(L) + lost_L, xp.abs(T)
    Z, lost_Z = X, xp.zeros_like(X)
    if E is not None:
        Z, units = product_in_parts(X, E)
        lost_Z = units * unit * (size_X @ xp.abs(E))
    if discrete:
        Y, units = product_in_parts(X, L)
        lost_Y, from_L = units * unit * (size_X @ most_L), size_X @ lost_L
        subtracted = Z if E is None else E.T @ Z
    else:
        Y, lost_Y, from_L = Z, lost_Z, xp.zeros_like(X)
        subtracted = xp.zeros_like(X)
    size_Y = xp.abs(Y)
    square, units = product_in_parts(L.T, Y)
    SN, NT = S @ N, N.T @ T
    lost = most_L.T @ (units * unit * size_Y + lost_Y)
    # In discrete time an error of L is in both factors, as the second one is XL.
    both = lost_L.T @ (size_Y + from_L / 2)
    if discrete:
        lost = lost + _twice(both)
        if E is not None:
            lost = lost + xp.abs(E).T @ (n * unit * xp.abs(Z) + lost_Z)
    else:
        square, lost = _twice(square), _twice(lost + both)
    lost = lost + m * unit * (size_S @ size_N)
    lost = lost + size_N.T @ (m * unit * size_T + lost_T)
    # Four additions, each of a sum no larger than that of the sizes, and a margin.
    added = sum(xp.abs(M) for M in (square, subtracted, Q, SN, NT))
    lost = lost + 5 * unit * added
    gap_lost = size_B.T @ ((n + 2) * unit * size_Y + lost_Y + from_L)
    gap_lost = gap_lost + lost_T + 2 * unit * size_T
    error = square - subtracted + Q + SN + NT
    return (N, L, T, Y, Z), _Left(error, lost, B.T @ Y + T, gap_lost)


def _sharper(discrete, A, B, Q, R, S, E, X, working, wide: _Left) -> _Left:
    """The residual in more digits, and entry by entry the sharper bound.

    The rests are the rounding errors of L, T, Y and Z. They enter the sum once for each
    place at which their matrix stands in the equation.
    """
    N, L, T, Y, Z = working
    n, m = B.shape
    eps = xp.finfo(A.dtype).eps
    stacked = xp.concatenate
    if discrete:
        terms, of_X, added = [(L, Y), (S.T, N), (N, T)], [(L, Y, L)], [Q]
        if E is None:
            added.append(-X)
        else:
            terms.append((-E, Z))
            of_X.append((E, Z, -E))
    else:
        terms, added = [(L, Z), (Z, L), (S.T, N), (N, T)], [Q]
        of_X = [] if E is None else [(E, Z, 2 * L)]
    # Pairs of a rest and the bound on its error. With S and R stacked under A and B one
    # product gives the rests of both L and T.
    pair = product(stacked([B, R]), N, stacked([A, S.T]), -stacked([L, T]))
    rests = list(zip(*(xp.split(M, [n]) for M in pair), strict=True))
    if of_X:
        rights, wholes, _ = (stacked(M, axis=1) for M in zip(*of_X, strict=True))
        pair = product(X, rights, -wholes)
        rests += zip(*(xp.split(M, len(of_X), axis=1) for M in pair), strict=True)
    factor = stacked([2 * Y, N, *(M for *_, M in of_X)]).T
    rest, rest_lost = (stacked(M) for M in zip(*rests, strict=True))
    sizes = xp.abs(rest)
    most = sizes + rest_lost
    left, right = (stacked(M) for M in zip(*terms, strict=True))
    error, lost = product(left.T, right, *added)
    error = error + factor @ rest
    lost = lost + xp.abs(factor) @ (rest_lost + (4 * n + 2 * m + 8) * eps * sizes)
    # The second-order terms: an error of L times an error of the factor beside it.
    most_L, most_T, around = most[:n], most[n : n + m], (n + 4) * eps * xp.abs(Y)
    if of_X:
        most_Y = most[n + m : 2 * n + m]
        around = around + most_Y
        lost = lost + 2 * most_L.T @ most_Y
    if discrete:
        from_L = xp.abs(X) @ most_L
        around = around + from_L
        lost = lost + most_L.T @ from_L
    gap_lost = xp.abs(B.T) @ around + most_T + (n + 4) * eps * xp.abs(T)
    lost = symmetric(lost)
    # Where nothing cancels the first bound may be the sharper one.
    sharper = lost < wide.lost
    return _Left(
        xp.where(sharper, symmetric(error), wide.error),
        xp.where(sharper, lost, wide.lost),
        wide.gap,
        xp.minimum(gap_lost, wide.gap_lost),
    )


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


def newton_refine(
    residual: Callable[[Array, Array], Residual],
    correction: Callable[[Array, Array, Array], Array],
    X: Square,
    *,
    controls: int,
    units: int,
    to_working_precision: bool = False,
) -> tuple[Array, Residual]:
    """Newton refinement while the residual decreases.

    `residual(X, accurately)` evaluates the residual, of so many `controls` and in so
    many `units`, and `correction(X, closed_loop, error)` is the Newton step. Where its
    bound is too wide for a certificate the steps go on with accurate residuals, unless
    they are to end in working precision. Returns the best `X`, and its residual.

    Source: Kleinman, 1968; each step solves the Lyapunov equation of the last loop.
    """
    fine, wide = _FINE * float(xp.finfo(X.dtype).eps), tolerance(X.dtype)

    def body(carry):
        X, last, best, accurately, going, patient, k = carry
        # The first round measures, those after it step: so there is one residual in
        # the compiled program, which is most of its size.
        first = k == 0
        step = if_needed(
            going & ~first,
            lambda _, *at: correction(*at),
            xp.zeros_like(X),
            (X, *last),
        )
        X = symmetric(X + step)
        new = residual(X, going & accurately)
        better = first | (new.relative < best[1].relative)
        # Steps that gain little are at the level of rounding. But far from the solution
        # the residual may rise in the first one.
        helped = first | (new.relative < best[1].relative / 4)
        best = jax.tree.map(lambda a, b: xp.where(better, a, b), (X, new), best)
        rest = best[1].relative
        again = helped | patient & (rest > wide)
        again = again & (rest > fine) & (k < _NEWTON_STEPS)
        # The bound is too wide for a certificate: once more, accurately, from the best.
        hidden = ~again & ~accurately & (xp.max(best[1].bounds) > wide)
        X = xp.where(hidden, best[0], X)
        k = xp.where(hidden, 0, k + 1)
        last = new.closed_loop, new.error
        return X, last, best, accurately | hidden, again | hidden, helped, k

    yes = xp.asarray(True)
    shapes = X.shape, (), units, (controls, len(X))
    matrix, number, vector, gain = (xp.zeros(shape, X.dtype) for shape in shapes)
    unknown = Residual(matrix, number, vector, gain, matrix, vector)
    accurately = xp.asarray(to_working_precision)
    start = X, (matrix, matrix), (X, unknown), accurately, yes, yes, xp.asarray(0)
    return while_loop(lambda carry: carry[4], body, start)[2]
