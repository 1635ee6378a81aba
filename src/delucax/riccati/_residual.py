"""What is left of a matrix equation, bounded from above with all rounding counted."""

from typing import NamedTuple

import jax
import jax.lax as lax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from ..math._accurate import in_parts, product
from ..math._linear_solve import solve, symmetric
from ..math._size import relative_and_total_size
from ._arguments import RiccatiData


_MARGIN = 1.01
"""Covers the rounding of the norms that a residual is the quotient of."""


class Residual(NamedTuple):
    """What is left of a Riccati equation.

    - `error`: the left side, with the gain in place of the best one.
    - `relative`: its norm over the sum of those of the terms.
    - `bounds`: an upper bound on what this is at the best gain and without rounding, in
      each of the units that were asked for.
    - `closed_loop`: `A - B K`, or `E^-1 (A - B K)`.
    - `terms`: the sum of the norms of the terms, in each of these units.
    """

    error: Float[Array, "n n"]
    relative: Float[Array, ""]
    bounds: Float[Array, " units"]
    closed_loop: Float[Array, "n n"]
    terms: Float[Array, " units"]


def no_residual(X: Float[Array, "n n"], units: int) -> Residual:
    """A residual of nothing, of the shapes of that at `X`."""
    matrix, number, vector = (jnp.zeros(s, X.dtype) for s in (X.shape, (), units))
    return Residual(matrix, number, vector, matrix, vector)


def riccati_residual(
    discrete: bool,
    data: RiccatiData,
    X: Float[Array, "n n"],
    accurately: Bool[Array, ""] | bool,
    *others: Float[Array, " n"],
    players: int = 0,
) -> Residual:
    r"""What is left of the Riccati equation at `X`.

    The left side is stationary in the gain, so that one in working precision will do.
    With `N = -K`, `L = A + B N` and `T = S' + R N` it is

    `L'XE + E'XL + Q + S N + N'T - G'W^-1 G`, `W = R`, `G = B'XE + T`, or
    `L'XL - E'XE + Q + S N + N'T - G'W^-1 G`, `W = R + B'XB`, `G = B'XL + T`,

    in continuous and in discrete time. G is rounding alone, and the last term its
    square. The rounding of each product is bounded by that of the absolute values of
    its factors. Where that is too wide they are evaluated `accurately`.

    The last `players` controls are a second player's, whose terms count apart. In other
    units of the states the equation is this one, with rows and columns times those of
    `others`.
    """
    A, B, Q, _, _, E = data
    (n, m), dtype = B.shape, A.dtype
    moved, cross, weight = stationary(discrete, data, X)
    weighted = X if E is None else E.T @ X
    solved = solve(weight, jnp.concatenate([cross.T, jnp.eye(m, dtype=dtype)], axis=1))
    K, inverse = solved[:, :n], jnp.abs(solved[:, n:])
    first = m - players
    moved = moved @ A
    if discrete and E is not None:
        weighted = weighted @ E
    terms = [moved, weighted if discrete else moved, Q, cross[:, :first] @ K[:first]]
    if players:
        terms.append(cross[:, first:] @ K[first:])

    working, left = _evaluated(discrete, *data, X, K)
    closed_loop = working[1] if E is None else solve(E, working[1])
    needed = jnp.asarray(accurately)
    if accurately is not False:

        def more_accurate(carry):
            _, working, left = carry
            left = _sharper(discrete, *data, X, working, left)
            return jnp.zeros_like(needed), jax.tree.map(jnp.zeros_like, working), left

        # A loop of one round is not run for a batch in which no member needs it. What
        # it works on is carried and changes: else compilers move work ahead of it.
        start = needed, working, left
        *_, left = lax.while_loop(lambda carry: carry[0], more_accurate, start)
    error, lost, gap, gap_lost = left
    gap = jnp.abs(gap) + gap_lost
    bound = jnp.abs(error) + lost + 2 * gap.T @ (inverse @ gap)

    both, terms = jnp.stack([error, bound]), jnp.stack(terms)

    def in_units(d):
        factor = d[:, None] * d
        return relative_and_total_size(both * factor, terms * factor)

    # Powers of two: their products have no rounding.
    units = jnp.stack([jnp.ones(n, dtype), *others])
    relative, sizes = jax.vmap(in_units)(units)
    bounds = _MARGIN * relative[:, 1]
    relative = jnp.where(needed, bounds[0], relative[0, 0])
    return Residual(error, relative, bounds, closed_loop, sizes)


def stationary(
    discrete: bool, data: RiccatiData, X: Float[Array, "n n"]
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
    """The left side and G, and by how much rounding may have changed each entry."""

    error: Array
    lost: Array
    gap: Array
    gap_lost: Array


def _evaluated(discrete, A, B, Q, R, S, E, X, K) -> tuple[tuple, _Left]:
    """N, L, T, Y = XL (XE in continuous time) and Z = XE, and what is left."""
    n, m = B.shape
    unit = jnp.finfo(A.dtype).eps / 2
    size_B, size_S, size_X, size_N = (jnp.abs(M) for M in (B, S, X, K))
    N = -K
    BN, units_BN = in_parts(B, N)
    L, T = A + BN, S.T + R @ N
    lost_L = (units_BN + 1) * unit * (jnp.abs(A) + size_B @ size_N)
    lost_T = (m + 1) * unit * (size_S.T + jnp.abs(R) @ size_N)
    most_L, size_T = jnp.abs(L) + lost_L, jnp.abs(T)
    Z, lost_Z = X, jnp.zeros_like(X)
    if E is not None:
        Z, units = in_parts(X, E)
        lost_Z = units * unit * (size_X @ jnp.abs(E))
    if discrete:
        Y, units = in_parts(X, L)
        lost_Y, from_L = units * unit * (size_X @ most_L), size_X @ lost_L
        subtracted = Z if E is None else E.T @ Z
    else:
        Y, lost_Y, from_L = Z, lost_Z, jnp.zeros_like(X)
        subtracted = jnp.zeros_like(X)
    size_Y = jnp.abs(Y)
    square, units = in_parts(L.T, Y)
    SN, NT = S @ N, N.T @ T
    lost = most_L.T @ (units * unit * size_Y + lost_Y)
    # What is wrong with L is in both factors where the second is XL.
    both = lost_L.T @ (size_Y + from_L / 2)
    if discrete:
        lost += _twice(both)
        if E is not None:
            lost += jnp.abs(E).T @ (n * unit * jnp.abs(Z) + lost_Z)
    else:
        square, lost = _twice(square), _twice(lost + both)
    lost += m * unit * (size_S @ size_N) + size_N.T @ (m * unit * size_T + lost_T)
    lost += 5 * unit * sum(jnp.abs(M) for M in (square, subtracted, Q, SN, NT))
    gap_lost = size_B.T @ ((n + 2) * unit * size_Y + lost_Y + from_L)
    gap_lost += lost_T + 2 * unit * size_T
    error = square - subtracted + Q + SN + NT
    return (N, L, T, Y, Z), _Left(error, lost, B.T @ Y + T, gap_lost)


def _sharper(discrete, A, B, Q, R, S, E, X, working, wide: _Left) -> _Left:
    """What is left in more digits, and entry by entry the sharper bound.

    The rests are what rounding left out of L, T, Y and Z. They are summed with the rest
    of the equation, each as often as it is there.
    """
    N, L, T, Y, Z = working
    n, m = B.shape
    eps = jnp.finfo(A.dtype).eps
    stacked = jnp.concatenate
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
    # Pairs of what is left out and a bound on what this leaves out again.
    pair = product(stacked([B, R]), N, stacked([A, S.T]), -stacked([L, T]))
    rests = list(zip(*(jnp.split(M, [n]) for M in pair), strict=True))
    if of_X:
        rights, wholes, _ = (stacked(M, axis=1) for M in zip(*of_X, strict=True))
        pair = product(X, rights, -wholes)
        rests += zip(*(jnp.split(M, len(of_X), axis=1) for M in pair), strict=True)
    factor = stacked([2 * Y, N, *(M for *_, M in of_X)]).T
    rest, rest_lost = (stacked(M) for M in zip(*rests, strict=True))
    sizes = jnp.abs(rest)
    most = sizes + rest_lost
    left, right = (stacked(M) for M in zip(*terms, strict=True))
    error, lost = product(left.T, right, *added)
    error += factor @ rest
    lost += jnp.abs(factor) @ (rest_lost + (4 * n + 2 * m + 8) * eps * sizes)
    # What is wrong with L, times what is wrong with the factor beside it.
    most_L, most_T, around = most[:n], most[n : n + m], (n + 4) * eps * jnp.abs(Y)
    if of_X:
        most_Y = most[n + m : 2 * n + m]
        around += most_Y
        lost += 2 * most_L.T @ most_Y
    if discrete:
        from_L = jnp.abs(X) @ most_L
        around += from_L
        lost += most_L.T @ from_L
    gap_lost = jnp.abs(B.T) @ around + most_T + (n + 4) * eps * jnp.abs(T)
    lost = symmetric(lost)
    sharper = lost < wide.lost
    return _Left(
        jnp.where(sharper, symmetric(error), wide.error),
        jnp.where(sharper, lost, wide.lost),
        wide.gap,
        jnp.minimum(gap_lost, wide.gap_lost),
    )


def _twice(M):
    """A matrix and its transpose."""
    return M + M.T


def linear_residual(discrete, A, B, C, X) -> Array:
    """What is left of `A X + X B = C`, or of `X - A X B = C`, at `X`, over
    `(|A| + |B|) |X| + |C|`, or over `(|A| |B| + 1) |X| + |C|`.

    Relative to these norms, rounding counts for little, and its bound is added.
    """
    eps = jnp.finfo(X.dtype).eps
    size_A, size_B = jnp.linalg.norm(A), jnp.linalg.norm(B)
    if discrete:
        error, factor = X - A @ X @ B - C, 1 + size_A * size_B
        rounding = (sum(X.shape) + 2) * eps / 2
    else:
        error, factor = A @ X + X @ B - C, size_A + size_B
        rounding = (max(X.shape) + 2) * eps / 2
    terms = factor * jnp.linalg.norm(X) + jnp.linalg.norm(C)
    relative = jnp.linalg.norm(error) / jnp.where(terms == 0, 1, terms)
    relative = _MARGIN * (relative + rounding)
    return jnp.where(jnp.isfinite(relative), relative, jnp.inf)
