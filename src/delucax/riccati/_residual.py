"""What is left of a matrix equation, bounded from above with all rounding counted."""

from typing import NamedTuple

import jax
import jax.lax as lax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from ..math._accurate import product
from ..math._linear_solve import solve, symmetric
from ..math._size import relative_size, size


_MARGIN = 1.01
"""Covers the rounding of the norms that a residual is the quotient of."""


class Residual(NamedTuple):
    """What is left of a Riccati equation.

    - `error`: the left side, with the gain in place of the best one.
    - `relative`: its norm over the sum of those of the terms.
    - `bound`: an upper bound on what this is at the best gain and without rounding.
    - `closed_loop`: `A - B K`, or `E^-1 (A - B K)`.
    - `terms`: the sum of the norms of the terms.
    - `K`: the gain.
    """

    error: Array
    relative: Array
    bound: Array
    closed_loop: Array
    terms: Array
    K: Array


def riccati_residual(
    discrete: bool,
    A: Float[Array, "n n"],
    B: Float[Array, "n m"],
    Q: Float[Array, "n n"],
    R: Float[Array, "m m"],
    S: Float[Array, "n m"],
    E: Float[Array, "n n"] | None,
    X: Float[Array, "n n"],
    accurately: Bool[Array, ""] | bool,
    players: int = 0,
) -> Residual:
    r"""What is left of the Riccati equation at `X`.

    The left side is stationary in the gain, so that one in working precision will do.
    With `N = -K`, `L = A + B N` and `T = S' + R N` it is

    `L'XE + E'XL + Q + S N + N'T - G'W^-1 G`, `W = R`, `G = B'XE + T`, or
    `L'XL - E'XE + Q + S N + N'T - G'W^-1 G`, `W = R + B'XB`, `G = B'XL + T`,

    in continuous and in discrete time. G is rounding alone, and the last term its
    square. The rounding of the others is bounded by the same sum of absolute values.
    Where that is too wide they are evaluated `accurately`.

    The last `players` controls are a second player's, whose terms count apart.
    """
    n, m = B.shape
    dtype = A.dtype
    eps = jnp.finfo(dtype).eps
    weighted = X if E is None else E.T @ X
    moved = A.T @ X if discrete else weighted
    cross = moved @ B + S
    weight = R + symmetric(B.T @ (X @ B)) if discrete else R
    solved = solve(weight, jnp.concatenate([cross.T, jnp.eye(m, dtype=dtype)], axis=1))
    K, inverse = solved[:, :n], jnp.abs(solved[:, n:])
    first = m - players
    moved = moved @ A
    if discrete and E is not None:
        weighted = weighted @ E
    terms = [moved, weighted if discrete else moved, Q, cross[:, :first] @ K[:first]]
    if players:
        terms.append(cross[:, first:] @ K[first:])

    def left_side(sign, A, B, Q, R, S, E, X, K):
        N = sign * K
        L, T = A + B @ N, S.T + R @ N
        Z = X if E is None else X @ E
        Y = X @ L if discrete else Z
        square = L.T @ Y
        if not discrete:
            square += square.T
        else:
            square += sign * (X if E is None else E.T @ Z)
        return square + Q + S @ N + N.T @ T, B.T @ Y + T, L, T, Y, Z

    # In the second, absolute values take the places of the terms.
    given = (A, B, Q, R, S, E, X, K)
    error, gap, L, T, Y, Z = left_side(-1, *given)
    most = left_side(1, *jax.tree.map(jnp.abs, given))
    rounding = (n + m + 6) * eps

    def more_accurate(carry):
        K = carry[1]
        eye = jnp.eye(n, dtype=dtype)
        N, minus = -K, -eye if E is None else -E.T
        # The rows of one product with all of these; what rounding left out of L, T, Y
        # and Z, and the rest of the equation with them in these places.
        right = {"I": eye, "N": N, "L": L, "T": T, "Q": Q}
        rows = [
            {"I": A, "N": B, "L": -eye},
            {"I": S.T, "N": R, "T": -jnp.eye(m, dtype=dtype)},
        ]
        last = {"N": S, "T": N.T, "Q": eye}
        right["Z"] = Z
        last["Z"] = minus if discrete else L.T
        # What these are multiplied by in the equation.
        factors = [2 * Y.T, N.T]
        if discrete:
            right["Y"] = Y
            rows.append({"L": X, "Y": -eye})
            last["Y"] = L.T
            factors.append(L.T)
        else:
            last["L"] = Z.T
        if E is not None:
            right["E"] = E
            rows.append({"E": X, "Z": -eye})
            factors.append(minus if discrete else 2 * L.T)

        def row(blocks):
            height = len(next(iter(blocks.values())))
            return [
                blocks.get(name, jnp.zeros((height, len(M)), dtype))
                for name, M in right.items()
            ]

        both = product(
            jnp.block([row(blocks) for blocks in (*rows, last)]),
            jnp.concatenate(list(right.values())),
        )
        ends = np.cumsum([len(factor.T) for factor in factors])
        *rests, error = jnp.split(both[0], ends)
        *losts, lost = jnp.split(both[1], ends)
        most = []
        for factor, rest, rest_lost in zip(factors, rests, losts, strict=True):
            error += factor @ rest
            rest = jnp.abs(rest)
            rest_lost += (4 * n + 2 * m + 8) * eps * rest
            lost += jnp.abs(factor) @ rest_lost
            most.append(rest + rest_lost)
        around = (n + 4) * eps * jnp.abs(Y)
        most_L, most_T, *most_Y = most
        if most_Y:
            around += most_Y[0]
            lost += 2 * most_L.T @ most_Y[0]
        if discrete:
            twice = jnp.abs(X) @ most_L
            around += twice
            lost += most_L.T @ twice
        gap_lost = jnp.abs(B.T) @ around + most_T + (n + 4) * eps * jnp.abs(T)
        # Both bounds hold, entry by entry.
        _, _, wide_error, wide, wide_gap = carry
        sharper = lost < wide
        return (
            jnp.zeros_like(needed),
            jnp.zeros_like(K),
            jnp.where(sharper, symmetric(error), wide_error),
            jnp.where(sharper, lost, wide),
            jnp.minimum(gap_lost, wide_gap),
        )

    lost, gap_lost = rounding * most[0], rounding * most[1]
    needed = jnp.asarray(accurately)
    if accurately is not False:
        # A loop of one round is not run for a batch in which no member needs it. What
        # it works on is carried and changes: else compilers move work ahead of it.
        start = needed, K, error, lost, gap_lost
        *_, error, lost, gap_lost = lax.while_loop(
            lambda carry: carry[0], more_accurate, start
        )
    gap = jnp.abs(gap) + gap_lost
    bound = jnp.abs(error) + lost + 2 * gap.T @ (inverse @ gap)
    closed_loop = L if E is None else solve(E, L)
    bound = _MARGIN * relative_size(bound, *terms)
    relative = jnp.where(needed, bound, relative_size(error, *terms))
    return Residual(error, relative, bound, closed_loop, size(*terms), K)


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
