"""The Stein equation, and what else repeated squaring tells of a matrix."""

import functools
from collections.abc import Callable

import jax
import jax.lax as lax
import jax.numpy as jnp
import lineax as lx
from jaxtyping import Array, Float


MAX_DOUBLINGS = 60
"""Beyond it the spectral radius cannot be told from 1: 2**60 > 1 / eps in float64."""
_SQUARINGS = 32


def full_precision(function: Callable) -> Callable:
    """`function` with products in the precision of their arguments.

    Accelerators round the arguments of a float32 product to fewer bits by default, and
    repeated squaring amplifies that.
    """

    @functools.wraps(function)
    def wrapped(*arguments):
        with jax.default_matmul_precision("highest"):
            return function(*arguments)

    return wrapped


def solve(
    matrix: Float[Array, "n n"], right: Float[Array, "n k"]
) -> Float[Array, "n k"]:
    """`matrix^-1 right`, with one factorisation; NaN where `matrix` is singular."""
    operator, solver = lx.MatrixLinearOperator(matrix), lx.LU()
    state = solver.init(operator, {})

    def column(b):
        return lx.linear_solve(operator, b, solver, state=state, throw=False).value

    return jax.vmap(column, in_axes=1, out_axes=1)(right)


def stein(A: Float[Array, "n n"], Q: Float[Array, "n n"]) -> Float[Array, "n n"]:
    """The solution of `X = A' X A + Q` for a stable `A`, by doubling.

    `X_2k = X_k + (A^k)' X_k A^k`, the sum of the first 2k terms of the series. It is
    differentiated as the linear solve that it is, to any order and in either mode.
    """
    return lax.custom_linear_solve(
        lambda X: X - A.T @ X @ A,
        Q,
        solve=lambda _, right: _double(A, right),
        transpose_solve=lambda _, right: _double(A.T, right),
    )


def _double(A, Q):
    eps = jnp.finfo(Q.dtype).eps

    def more(carry):
        _, _, relative, k = carry
        return (k < MAX_DOUBLINGS) & (relative > eps / 4)

    def body(carry):
        X, power, _, k = carry
        change = power.T @ X @ power
        X = X + change
        # A NaN compares false, so that a lane that diverges stops.
        relative = jnp.linalg.norm(change) / jnp.linalg.norm(X)
        return X, power @ power, relative, k + 1

    start = (Q, A, jnp.asarray(jnp.inf, Q.dtype), jnp.asarray(0))
    return lax.while_loop(more, body, start)[0]


def spectral_radius(A: Float[Array, "n n"]) -> Float[Array, ""]:
    """An upper bound on the spectral radius, `|A^N|^(1/N)` with `N = 2**32`.

    The bound holds for every N (Gelfand); at this one it is above the radius by a
    relative `log(cond) / N`, with `cond` the condition of the eigenvectors.
    """

    def square(carry, weight):
        power, log_bound, is_zero = carry
        size = jnp.linalg.norm(power)
        is_zero = is_zero | (size == 0)
        size = jnp.where(is_zero, 1, size)
        scaled = power / size
        return (scaled @ scaled, log_bound + weight * jnp.log(size), is_zero), None

    weights = 0.5 ** jnp.arange(_SQUARINGS + 1, dtype=A.dtype)
    start = (A, jnp.zeros((), A.dtype), jnp.zeros((), bool))
    (_, log_bound, is_zero), _ = lax.scan(square, start, weights)
    return jnp.where(is_zero, 0, jnp.exp(log_bound))
