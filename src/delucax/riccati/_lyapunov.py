"""The Sylvester and Lyapunov equations of stable matrices, by a Cayley transform."""

import jax.lax as lax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..math._linear_solve import solve
from ..math._size import relative_size
from ._stein import smith


_REFINEMENTS = 3


def lyapunov(F: Float[Array, "n n"], Q: Float[Array, "n n"]) -> Float[Array, "n n"]:
    """The solution of `F'X + XF + Q = 0` for a stable `F`.

    It is differentiated as the linear solve that it is, to any order and in either
    mode.
    """
    return lax.custom_linear_solve(
        lambda X: F.T @ X + X @ F,
        -Q,
        solve=lambda _, right: stable_sylvester(F.T, None, right)[0],
        transpose_solve=lambda _, right: stable_sylvester(F, None, right)[0],
    )


def stable_sylvester(
    A: Float[Array, "n n"], B: Float[Array, "m m"] | None, C: Float[Array, "n m"]
) -> tuple[Float[Array, "n m"], Array]:
    """`A X + X B = C` for stable `A` and `B` (default `A'`), and the doublings taken.

    With `P = (A - c)^-1 (A + c)` and likewise of `B` it is the Stein equation
    `X = P X P_B - 2c (A - c)^-1 C (B - c)^-1`. What the transform rounds away of a wide
    spectrum is won back by iterative refinement.
    """
    n, m = C.shape
    eps = jnp.finfo(C.dtype).eps
    other = A.T if B is None else B
    # The geometric mean of the eigenvalues' sizes: the transform maps what is far above
    # it and far below it towards the circle alike.
    logs = jnp.linalg.slogdet(A)[1]
    logs = 2 * logs if B is None else logs + jnp.linalg.slogdet(B)[1]
    c = jnp.exp(logs / (2 * n if B is None else n + m))
    eye_A, eye_B = jnp.eye(n, dtype=A.dtype), jnp.eye(m, dtype=A.dtype)
    moved_A, moved_B = A - c * eye_A, other.T - c * eye_B
    power_A = solve(moved_A, A + c * eye_A)
    power_B = None if B is None else solve(moved_B, B.T + c * eye_B).T

    def once(C):
        left = solve(moved_A, C)
        both = solve(moved_B, left.T).T
        return smith(power_A, power_B, -2 * c * both)

    def measured(X):
        left, right = A @ X, X @ other
        rest = C - left - right
        return rest, relative_size(rest, left, right, C)

    def more(carry):
        *_, going, k = carry
        return going & (k < _REFINEMENTS)

    def body(carry):
        X, rest, residual, iterations, _, k = carry
        change, doublings = once(rest)
        rest, found = measured(X + change)
        better = found < residual
        X = jnp.where(better, X + change, X)
        residual = jnp.where(better, found, residual)
        going = better & (residual > 10 * eps)
        return X, rest, residual, iterations + doublings, going, k + 1

    X, iterations = once(C)
    rest, residual = measured(X)
    start = (X, rest, residual, iterations, residual > 10 * eps, jnp.asarray(0))
    X, _, _, iterations, *_ = lax.while_loop(more, body, start)
    return X, iterations
