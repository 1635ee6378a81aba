"""What is left of a matrix equation, bounded from above with all rounding counted."""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array

from ..math._accurate import added, pair, product, rounded, slices
from ..math._linear_solve import solve, symmetric
from ..math._size import relative_size, size


_MARGIN = 1.01
"""Covers the rounding of the norms that a residual is the quotient of."""


class Residual(NamedTuple):
    """What is left of a Riccati equation.

    - `error`: the left side, with the gain in place of the best one.
    - `relative`: a bound on the left side's norm over the sum of those of its terms.
    - `closed_loop`: `A - B K`, or `E^-1 (A - B K)`.
    - `terms`: the sum of the norms of the terms.
    - `K`: the gain.
    """

    error: Array
    relative: Array
    closed_loop: Array
    terms: Array
    K: Array


def riccati_residual(discrete, A, B, Q, R, S, E, X, players=0) -> Residual:
    r"""What is left of the Riccati equation at `X`.

    A gain K in working precision will do, as the left side is stationary in it. With
    `L = A - B K` and `T = S' - R K` it is

    `L'XE + E'XL + Q - S K - K'T - G'W^-1 G`, `W = R`, `G = B'XE + T`, or
    `L'XL - E'XE + Q - S K - K'T - G'W^-1 G`, `W = R + B'XB`, `G = B'XL + T`,

    in continuous and in discrete time. G is rounding alone, and the last term its
    square; all before it cancels, and is evaluated in higher precision.

    The last `players` controls are a second player's, whose terms count apart.
    """
    n, m = B.shape
    dtype = A.dtype
    weighted = X if E is None else E.T @ X
    moved = A.T @ X if discrete else weighted
    cross = moved @ B + S
    weight = R + symmetric(B.T @ X @ B) if discrete else R
    solved = solve(weight, jnp.concatenate([cross.T, jnp.eye(m, dtype=dtype)], axis=1))
    K, inverse = solved[:, :n], solved[:, n:]
    first = m - players
    terms = [weighted @ A] * 2 + [Q, cross[:, :first] @ K[:first]]
    if discrete:
        terms[:2] = moved @ A, weighted if E is None else weighted @ E
    if players:
        terms.append(cross[:, first:] @ K[first:])
    closed_loop = A - B @ K
    if E is not None:
        closed_loop = solve(E, closed_loop)

    s, eye = slices(2 * (n + m), dtype), jnp.eye(n, dtype=dtype)
    data, feedback = jnp.block([[A, B], [S.T, R]]), jnp.concatenate([eye, -K])
    both, lost = rounded(*product(pair(data), pair(feedback), s))
    loop, T, lost_loop, lost_T = both[:, :n], both[:, n:], lost[:n], lost[n:]
    # By how much the entries may be wrong, row by row.
    lost = lost_T @ jnp.abs(K)
    left = top = pair(X)
    if discrete:
        bottom, lost_bottom = rounded(*product(left, loop, s))
        lost_bottom += jnp.abs(X) @ lost_loop
        lost += lost_loop @ jnp.abs(bottom[0]) + lost_bottom @ jnp.abs(loop[0])
        left = pair(-eye)
        if E is not None:
            left = pair(-E.T)
            top, lost_top = rounded(*product(top, pair(E), s))
            lost += lost_top @ jnp.abs(E)
    else:
        if E is not None:
            left, lost_left = rounded(*product(pair(E.T), left, s))
            lost += 2 * jnp.sum(lost_left) * _largest(loop)
        top, bottom = loop, jnp.swapaxes(left, 1, 2)
        lost += 2 * jnp.abs(left[0]) @ lost_loop
    rows = [left, jnp.swapaxes(loop, 1, 2), pair(S), pair(-K.T)]
    columns = [top, bottom, pair(-K), T]
    rows, columns = jnp.concatenate(rows, axis=2), jnp.concatenate(columns, axis=1)
    levels, lost_last = product(rows, columns, s)
    error = symmetric(added(levels, Q))

    gap = jnp.sum(B.T @ bottom + T, axis=0)
    terms_of_gap = jnp.abs(B.T) @ jnp.abs(bottom[0]) + jnp.abs(T[0])
    gap = jnp.abs(gap) + (n + 4) * jnp.finfo(dtype).eps * terms_of_gap
    error_bound = jnp.abs(error) + 2 * gap.T @ (jnp.abs(inverse) @ gap)
    error_bound += (lost + lost_last)[:, None]
    relative = _MARGIN * relative_size(error_bound, *terms)
    return Residual(error, relative, closed_loop, size(*terms), K)


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


def _largest(M: Array) -> Array:
    return jnp.max(jnp.abs(M))
