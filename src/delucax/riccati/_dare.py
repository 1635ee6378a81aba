"""The discrete-time algebraic Riccati equation."""

from typing import Any

import equinox as eqx
import jax
import jax.lax as lax
import jax.numpy as jnp
from jaxtyping import Array

from .._check import as_matrix, is_concrete, symmetric_matrix
from .._results import choose, Result, RESULTS
from ._stein import full_precision, MAX_DOUBLINGS, solve, spectral_radius, stein


_NEWTON_STEPS = 2
"""Enough to take doubling's error of a few digits to the rounding of the equation."""


class RiccatiSolution(eqx.Module):
    """What a Riccati solver found, with the facts to judge it by.

    **Attributes:**

    - `X`: the solution, shape `(n, n)`, symmetric.
    - `K`: the gain of `u = -K x`, shape `(m, n)`.
    - `residual`: the norm of the equation's residual over the sum of the norms of its
        terms.
    - `closed_loop`: the matrix of `x_next = closed_loop x`, shape `(n, n)`.
    - `spectral_radius`: an upper bound on that of `closed_loop`, close to it: it is
        stable if the bound is below 1.
    - `iterations`: doublings taken.
    - `result`: success, or why not; one of `delucax.RESULTS`.

    `X`, `K` and `closed_loop` are differentiable. `residual` and `spectral_radius` are
    measurements and have no gradient.

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp

        A = jnp.array([[1.0, 1.0], [0.0, 1.0]])
        B = jnp.array([[0.0], [1.0]])
        solution = dlx.riccati.dare(A, B, jnp.eye(2), jnp.eye(1))
        solution.K, solution.spectral_radius
        ```
    """

    X: Array
    K: Array
    residual: Array
    closed_loop: Array
    spectral_radius: Array
    iterations: Array
    result: Result


def dare(
    A: Any,
    B: Any,
    Q: Any,
    R: Any,
    S: Any = None,
    E: Any = None,
    *,
    throw: bool = True,
) -> RiccatiSolution:
    r"""The stabilising solution of the discrete-time algebraic Riccati equation,

    `A'XA - E'XE - (A'XB + S) (R + B'XB)^-1 (B'XA + S') + Q = 0`,

    whose gain `K = (R + B'XB)^-1 (B'XA + S')` minimises the sum of
    `x'Qx + 2 x'Su + u'Ru` over all time along `E x_next = A x + B u`, at cost
    `(Ex)' X (Ex)` from `x`.

    Structure-preserving doubling, started at a multiple of the identity: the Riccati
    recursion from a positive final cost, 2, 4, 8, ... steps back. Then Newton steps on
    the equation itself. It takes products and solves alone, no eigenvalues, which suits
    accelerators and `jax.vmap`; in a batch, a member that fails harms no other. It is
    differentiable to any order, in either mode, by the implicit function theorem.

    **Arguments:**

    - `A`: shape `(n, n)`.
    - `B`: shape `(n, m)`.
    - `Q`: state weight, shape `(n, n)`, symmetric.
    - `R`: control weight, shape `(m, m)`, symmetric. May be singular.
    - `S`: cross weight, shape `(n, m)`; zero by default.
    - `E`: descriptor matrix, shape `(n, n)`, invertible; the identity by default.
    - `throw`: raise unless the solution is found and stabilising (default); if false,
        look at `result`.

    **Returns:** a [`delucax.riccati.RiccatiSolution`][]. It is successful if the
    `residual` is below `1000 n` rounding units and the closed loop is stable: a small
    residual alone is no certificate.

    **Raises:** `ValueError` on a matrix of the wrong shape, that is not finite or not
    symmetric; an error at run time as `throw` says.

    Source: Chu, Fan, Lin and Wang, 2004 (doubling).

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp

        A = jnp.array([[1.0, 1.0], [0.0, 1.0]])
        B = jnp.array([[0.0], [1.0]])
        K = dlx.riccati.dare(A, B, jnp.eye(2), jnp.eye(1)).K  # [[0.4221, 1.2439]]
        ```
    """
    A, B, Q, R, S, E = _checked(A, B, Q, R, S, E)
    solution = _solution(A, B, Q, R, S, E)
    return _thrown(solution) if throw else solution


def _checked(A, B, Q, R, S, E):
    """The arguments as real matrices of one precision that fit each other."""
    where = "dare"
    A, B = as_matrix(A, "A", where), as_matrix(B, "B", where)
    Q, R = symmetric_matrix(Q, "Q", where), symmetric_matrix(R, "R", where)
    S = None if S is None else as_matrix(S, "S", where)
    E = None if E is None else as_matrix(E, "E", where)
    n, m = A.shape[0], B.shape[1]
    if A.shape != (n, n) or n == 0:
        raise ValueError(f"{where}: A must be square, got shape {A.shape}.")
    if B.shape != (n, m) or m == 0:
        raise ValueError(
            f"{where}: B must have as many rows as A ({n}), got shape {B.shape}."
        )
    shapes = {"Q": (Q, (n, n)), "R": (R, (m, m)), "S": (S, (n, m)), "E": (E, (n, n))}
    for name, (matrix, shape) in shapes.items():
        if matrix is not None and matrix.shape != shape:
            raise ValueError(
                f"{where}: {name} must have shape {shape} to fit A and B, got "
                f"{matrix.shape}."
            )
    given = [A, B, Q, R, S, E]
    dtype = jnp.result_type(*(M for M in given if M is not None))
    if not jnp.issubdtype(dtype, jnp.floating):
        raise ValueError(f"{where}: A, B, Q, R, S, E must be real, got {dtype}.")
    S = jnp.zeros((n, m), dtype) if S is None else S
    return tuple(None if M is None else M.astype(dtype) for M in (A, B, Q, R, S, E))


def _thrown(solution: RiccatiSolution) -> RiccatiSolution:
    """Raise if the solve failed: now if it can be seen, else at run time."""
    failed = solution.result != RESULTS.successful
    if not is_concrete(failed):
        return solution.result.error_if(solution, failed)
    if failed:
        raise RuntimeError(
            f"dare: {RESULTS[solution.result]} Relative residual "
            f"{float(solution.residual):.1e}, spectral radius of the closed loop "
            f"{float(solution.spectral_radius):.6g}. Pass throw=False to look at the "
            "solution."
        )
    return solution


@eqx.filter_jit
@full_precision
def _solution(A, B, Q, R, S, E):
    # With Y = E'XE the equation is the ordinary one of E^-1 A and E^-1 B.
    plain_A, plain_B = (A, B) if E is None else (solve(E, A), solve(E, B))
    Y, iterations = _riccati(plain_A, plain_B, Q, R, S)
    X = Y if E is None else _symmetric(solve(E.T, solve(E.T, Y).T))
    quadratic, K = _terms(plain_A, plain_B, R, S, Y)
    if E is not None:
        quadratic, K = _terms(A, B, R, S, X)
    weight = X if E is None else E.T @ X @ E
    moved = A.T @ X @ A
    size = sum(jnp.linalg.norm(M) for M in (moved, weight, quadratic, Q))
    error = jnp.linalg.norm(moved - weight - quadratic + Q)
    residual = lax.stop_gradient(error / jnp.where(size == 0, 1, size))
    closed_loop = plain_A - plain_B @ K
    # The bound follows the radius but its derivative does not where eigenvalues are
    # complex: their phase is in it, N times as fast as it is small.
    radius = lax.stop_gradient(spectral_radius(closed_loop))
    eps = jnp.finfo(A.dtype).eps
    stable = radius < 1 - A.shape[0] * eps
    solved = residual < 1000 * A.shape[0] * eps
    result = choose(solved, RESULTS.successful, RESULTS.not_converged)
    result = choose(stable, result, RESULTS.not_stabilising)
    return RiccatiSolution(X, K, residual, closed_loop, radius, iterations, result)


def _symmetric(X):
    return (X + X.T) / 2


def _terms(A, B, R, S, X):
    """`(A'XB + S) K` and the gain `K = (R + B'XB)^-1 (B'XA + S')`."""
    cross = A.T @ X @ B + S
    K = solve(R + B.T @ X @ B, cross.T)
    return cross @ K, K


def _equation(A, B, Q, R, S, X):
    """What is left of the equation at `X`, and the closed loop there."""
    quadratic, K = _terms(A, B, R, S, X)
    return _symmetric(A.T @ X @ A - X - quadratic + Q), A - B @ K


@jax.custom_jvp
def _riccati(A, B, Q, R, S):
    """The stabilising `X` for `E = I`, and the doublings that it took."""
    # About X0 = c I the control weight is invertible even where R is not, and the
    # recursion cannot rest at a solution that leaves an unstable mode unseen by Q.
    n = A.shape[0]
    c = jnp.linalg.norm(Q)
    c = jnp.where(c > 0, c, jnp.linalg.norm(R))
    X0 = jnp.where(c > 0, c, 1) * jnp.eye(n, dtype=A.dtype)
    cross = A.T @ X0 @ B + S
    solved = solve(R + B.T @ X0 @ B, jnp.concatenate([cross.T, B.T], axis=1))
    K, G = solved[:, :n], _symmetric(B @ solved[:, n:])
    reduced_Q = _symmetric(A.T @ X0 @ A - X0 - cross @ K + Q)
    X, iterations = _double(A - B @ K, G, reduced_Q, X0)
    return _polish(A, B, Q, R, S, X), iterations


def _double(A, G, H, X0):
    """Doubling of `X = A' X (I + G X)^-1 A + H`, as `X0 + X`."""
    n, eps = A.shape[0], jnp.finfo(A.dtype).eps
    eye = jnp.eye(n, dtype=A.dtype)

    def more(carry):
        *_, relative, k = carry
        return (k < MAX_DOUBLINGS) & (relative > eps)

    def body(carry):
        A, G, H, _, k = carry
        solved = solve(eye + G @ H, jnp.concatenate([A, G], axis=1))
        moved, weighted = solved[:, :n], solved[:, n:]
        change = _symmetric(A.T @ H @ moved)
        after = (A @ moved, _symmetric(G + A @ weighted @ A.T), H + change)
        finite = jnp.all(jnp.stack([jnp.all(jnp.isfinite(M)) for M in after]))
        # What overflows is left at the last finite step: it has no stable loop, and
        # the caller finds that out.
        A, G, H = (
            jnp.where(finite, new, old)
            for new, old in zip(after, (A, G, H), strict=True)
        )
        relative = jnp.linalg.norm(change) / jnp.linalg.norm(X0 + H)
        return A, G, H, jnp.where(finite, relative, 0), k + 1

    start = (A, G, H, jnp.asarray(jnp.inf, A.dtype), jnp.asarray(0))
    _, _, H, _, iterations = lax.while_loop(more, body, start)
    return X0 + H, iterations


def _polish(A, B, Q, R, S, X):
    """Newton steps on the equation itself, for as long as they bring `X` closer."""
    small = A.shape[0] * jnp.finfo(A.dtype).eps

    def more(carry):
        *_, relative, k = carry
        return (k <= _NEWTON_STEPS) & (relative > small)

    def body(carry):
        X, error, closed_loop, relative, k = carry
        candidate = _symmetric(X + stein(closed_loop, error))
        error, closed_loop = _equation(A, B, Q, R, S, candidate)
        found = jnp.linalg.norm(error) / jnp.linalg.norm(candidate)
        better = found < relative
        X = jnp.where(better, candidate, X)
        return X, error, closed_loop, jnp.where(better, found, 0), k + 1

    # The first round, with no error to correct, only measures.
    nothing = jnp.zeros_like(X)
    start = (X, nothing, nothing, jnp.asarray(jnp.inf, X.dtype), jnp.asarray(0))
    return lax.while_loop(more, body, start)[0]


@_riccati.defjvp
@full_precision
def _riccati_jvp(primals, tangents):
    X, iterations = _riccati(*primals)

    def equation(*arguments):
        return _equation(*arguments, X)  # pyright: ignore[reportCallIssue]

    _, error_tangent, closed_loop = jax.jvp(equation, primals, tangents, has_aux=True)
    X_tangent = stein(closed_loop, error_tangent)
    return (X, iterations), (X_tangent, _no_tangent(iterations))


def _no_tangent(integer):
    return jnp.zeros(integer.shape, jax.dtypes.float0)
