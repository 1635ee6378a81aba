"""The Stein equation of a stable matrix, by doubling."""

import jax.lax as lax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..math._linear_solve import full_precision as full_precision, solve as solve
from ..math._size import relative_size
from ._spectrum import spectral_radius as spectral_radius


MAX_DOUBLINGS = 60
"""Beyond it the spectral radius cannot be told from 1: 2**60 > 1 / eps in float64."""


def stein(A: Float[Array, "n n"], Q: Float[Array, "n n"]) -> Float[Array, "n n"]:
    """The solution of `X = A' X A + Q` for a stable `A`, by doubling.

    It is differentiated as the linear solve that it is, to any order and in either
    mode.
    """
    return lax.custom_linear_solve(
        lambda X: X - A.T @ X @ A,
        Q,
        solve=lambda _, right: smith(A.T, None, right)[0],
        transpose_solve=lambda _, right: smith(A, None, right)[0],
    )


def smith(
    A: Float[Array, "n n"], B: Float[Array, "m m"] | None, C: Float[Array, "n m"]
) -> tuple[Float[Array, "n m"], Array]:
    """`X = A X B + C` for stable `A` and `B` (default `A'`), and the doublings taken.

    `X_2k = X_k + A^k X_k B^k`, the sum of the first 2k terms of the series.

    Source: Smith, 1968.
    """
    eps = jnp.finfo(C.dtype).eps
    powers = (A,) if B is None else (A, B)

    def more(carry):
        *_, relative, k = carry
        return (k < MAX_DOUBLINGS) & (relative > eps / 4)

    def body(carry):
        X, powers, _, k = carry
        left, right = powers if len(powers) == 2 else (powers[0], powers[0].T)
        change = left @ X @ right
        X = X + change
        # A NaN compares false, so that a lane that diverges stops.
        relative = relative_size(change, X)
        return X, tuple(power @ power for power in powers), relative, k + 1

    start = (C, powers, jnp.asarray(jnp.inf, C.dtype), jnp.asarray(0))
    X, *_, iterations = lax.while_loop(more, body, start)
    return X, iterations
