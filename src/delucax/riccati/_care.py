"""The continuous-time algebraic Riccati equation."""

from typing import Any

import equinox as eqx
import jax
import jax.lax as lax
import jax.numpy as jnp
import lineax as lx

from ..math._linear_solve import full_precision, is_definite, solve, symmetric
from ..math._size import size
from ._arguments import riccati_arguments
from ._dare import double
from ._lyapunov import lyapunov
from ._newton import (
    attainable,
    found_tangent,
    outside,
    polish,
    solution_in_units,
    solution_of,
)
from ._residual import riccati_residual
from ._search import Attempt, Found, search, SECOND, weights
from ._solution import checked, RiccatiSolution
from ._spectrum import abscissa_and_size
from ._units import in_units


_SIGN_STEPS = 60


def care(
    A: Any,
    B: Any,
    Q: Any,
    R: Any,
    S: Any = None,
    E: Any = None,
    *,
    throw: bool = True,
) -> RiccatiSolution:
    r"""The stabilising solution of the continuous-time algebraic Riccati equation,

    `A'XE + E'XA - (E'XB + S) R^-1 (B'XE + S') + Q = 0`,

    whose gain `K = R^-1 (B'XE + S')` minimises the integral of
    `x'Qx + 2 x'Su + u'Ru` over all time along `E dx/dt = A x + B u`, at cost
    `(Ex)' X (Ex)` from `x`.

    The scaled sign iteration of the Hamiltonian matrix; if that fails, doubling of its
    Cayley transform. Then Newton steps on the equation itself, if its residual asks for
    them. It takes products and solves alone, no eigenvalues, which suits accelerators
    and `jax.vmap`; in a batch, a member that fails harms no other. It is differentiable
    to any order, in either mode, by the implicit function theorem.

    Where the cost does not see an unstable mode, the stabilising solution is not the
    cheapest: no control at all would cost less, and the state would grow.

    **Arguments:**

    - `A`: shape `(n, n)`. Real, or complex, as all others; then `'` is the conjugate
        transpose.
    - `B`: shape `(n, m)`.
    - `Q`: state weight, shape `(n, n)`, symmetric. An indefinite one is accepted.
    - `R`: control weight, shape `(m, m)`, symmetric, positive definite: with a singular
        one the control may be an impulse, and there is no such gain.
    - `S`: cross weight, shape `(n, m)`; zero by default.
    - `E`: descriptor matrix, shape `(n, n)`, invertible; the identity by default.
    - `throw`: raise unless the solution is found and stabilising (default); if false,
        look at `result`.

    **Returns:** a [`delucax.riccati.RiccatiSolution`][] with a `spectral_abscissa`. It
    is successful if the residual, in units of the states that balance the equation, is
    at most 1e-12 (1e-5 in single precision), or up to a hundred times that if rounding
    of `X` alone may leave it; and if the closed loop is stable: a small residual alone
    is no certificate. Else `result` is one of `RESULTS.not_stabilisable`,
    `not_stabilising` (no such solution), `on_boundary` (eigenvalues on the imaginary
    axis, or so close that data changed by rounding have no stabilising solution),
    `not_converged` and `ill_posed`.

    **Raises:** `ValueError` on a matrix of the wrong shape, that is not finite, not
    symmetric or (`R`) not definite; an error at run time as `throw` says.

    Source: Roberts, 1971 (sign); Byers, 1987 (scaling); Chu, Fan and Lin, 2005
    (doubling); Kleinman, 1968 (Newton); Benner, 2001 (balancing).

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp

        A = jnp.array([[0.0, 1.0], [0.0, 0.0]])
        B = jnp.array([[0.0], [1.0]])
        K = dlx.riccati.care(A, B, jnp.eye(2), jnp.eye(1)).K  # [[1.0, 1.7321]]
        ```
    """
    arguments = riccati_arguments("care", A, B, Q, R, S, E, definite=True)
    return checked(continuous_solution(*arguments), "care", throw)


def continuous_solution(A, B, Q, R, S, E) -> RiccatiSolution:
    """The solution of the equation with checked arguments."""
    return solution_of(_solution, False, A, B, Q, R, S, E)


@eqx.filter_jit
@full_precision
def _solution(A, B, Q, R, S, E):
    return solution_in_units(_find, _terms, "spectral_abscissa", A, B, Q, R, S, E)


def _terms(A, B, R, S, E, X):
    """`E'X`, `(E'XB + S) K`, `K = R^-1 (B'XE + S')` and the closed loop."""
    weighted = X if E is None else E.T @ X
    cross = weighted @ B + S
    K = solve(R, cross.T)
    closed_loop = A - B @ K
    if E is not None:
        closed_loop = solve(E, closed_loop)
    return weighted, cross @ K, K, closed_loop


def _equation(A, B, Q, R, S, E, X):
    """What is left of the equation at `X`, and the closed loop; for derivatives."""
    weighted, quadratic, _, closed_loop = _terms(A, B, R, S, E, X)
    moved = weighted @ A
    return symmetric(moved + moved.T - quadratic + Q), closed_loop


@jax.custom_jvp
def _find(A, B, Q, R, S, E, by) -> Found:
    """The stabilising `X`, and what is known about it."""
    n, m, dtype = A.shape[0], B.shape[1], A.dtype
    eps = float(jnp.finfo(dtype).eps)
    plain_A, plain_B = (A, B) if E is None else (solve(E, A), solve(E, B))
    slack = eps * size(R)
    posed = is_definite(R - slack * jnp.eye(m, dtype=dtype))
    for M in (plain_A, plain_B, Q, R, S):
        posed = posed & jnp.all(jnp.isfinite(M))

    magnified = 1 if E is None else size(E) ** 2

    def attempt(kind, balanced):
        # From the units that balance the problem to those of the attempt.
        back = jnp.where(balanced, 1, 1 / by)
        a, b, q, r, s, e = in_units(back, A, B, Q, R, S, E)
        q, r, s, size_Q = weights(kind, q, r, s)
        # Those of E^-1 A and E^-1 B have the units of the states in their rows.
        state, row = back
        plain = jnp.stack([state, state])
        plain_a, plain_b, *_ = in_units(plain, plain_A, plain_B, Q, R, S, None)
        X, size_G, iterations = _start(plain_a, plain_b, q, r, s, kind == SECOND)
        units = by[0] * state, state
        X, left = polish(
            lambda *at: riccati_residual(False, a, b, q, r, s, e, *at, *units),
            lambda loop, error: outside(e, lyapunov(loop, error)),
            outside(e, X),
        )
        abscissa, scale = abscissa_and_size(left.closed_loop)
        rounding = n * eps * scale
        # A change of Q by rounding moves eigenvalues on the axis off it by its root.
        reach = jnp.sqrt(10 * n * eps * size_G * size_Q) + 10 * rounding
        # The rest is said in balanced units.
        balanced_X = X * (row[:, None] * row)
        loop = left.closed_loop * (state / state[:, None])
        return Attempt(
            X=balanced_X,
            residual=left.bounds[2],
            given=left.bounds[1],
            bound=abscissa,
            gap=-abscissa,
            rounding=rounding,
            near=jnp.abs(abscissa) < reach,
            least=attainable(balanced_X, 2 * size(loop) * magnified, left.terms[2]),
            modest=size(X) * eps**0.5 < size_Q,
            around=jnp.abs(abscissa) < 4 * eps**0.125 * size(left.closed_loop),
            iterations=iterations,
        )

    return search(attempt, jnp.full_like(Q, jnp.nan), posed, jnp.any(by != 1))


def _start(A, B, Q, R, S, second):
    """A solution to begin with, by the sign iteration or, if `second`, by doubling; the
    size of `B R^-1 B'`; and the steps taken."""
    n = A.shape[0]
    solved = solve(R, jnp.concatenate([B.T, S.T], axis=1))
    G = symmetric(B @ solved[:, :n])
    A = A - B @ solved[:, n:]
    Q = symmetric(Q - S @ solved[:, n:])
    by_sign, sign_steps = _by_sign(A, G, Q, ~second)
    by_doubling, doublings = _by_doubling(A, G, Q, second)
    X = jnp.where(second, by_doubling, by_sign)
    return X, size(G), jnp.where(second, doublings, sign_steps)


def _by_sign(A, G, Q, wanted):
    """`X` from the sign of the Hamiltonian matrix `H = [[A, -G], [-Q, -A']]`.

    With `J = [[0, I], [-I, 0]]`, the iteration `H <- (H + H^-1) / 2` is one of the
    symmetric `W = JH`: `W <- (W + J W^-1 J) / 2`.
    """
    n, dtype = A.shape[0], A.dtype
    eps = jnp.finfo(dtype).eps
    eye, both = jnp.eye(n, dtype=dtype), jnp.eye(2 * n, dtype=dtype)

    def J(M):
        return jnp.concatenate([M[n:], -M[:n]])

    def more(carry):
        *_, going, k = carry
        return going & (k < _SIGN_STEPS)

    def body(carry):
        W, before, _, k = carry
        turned = J(solve(W, J(both)))
        ratio = size(turned) / size(W)
        # Scaling speeds up the way to the neighbourhood of the limit, where it would
        # keep the iteration from settling.
        scale = jnp.where(before < 1e-2, 1, jnp.sqrt(ratio))
        new = symmetric(scale * W + turned / scale) / 2
        change = size(new - W) / size(new)
        stalled = (change < 1e-6) & (change > before / 2)
        # A NaN compares false, so that a lane that diverges stops.
        going = (change > 10 * eps) & ~stalled
        return new, change, going, k + 1

    W = jnp.block([[-Q, -A.T], [-A, G]])
    start = (W, jnp.asarray(jnp.inf, dtype), jnp.asarray(wanted), jnp.asarray(0))
    W, *_, iterations = lax.while_loop(more, body, start)
    # I - sign(H) = [I; X] M projects onto the stable subspace; H = J'W.
    upper = jnp.concatenate([eye + W[n:, :n], W[n:, n:]], axis=1)
    lower = jnp.concatenate([-W[:n, :n], eye - W[:n, n:]], axis=1)
    operator, solver = lx.MatrixLinearOperator(upper.T), lx.QR()
    state = solver.init(operator, {})

    def row(b):
        return lx.linear_solve(operator, b, solver, state=state, throw=False).value

    return symmetric(jax.vmap(row)(lower)), iterations


def _by_doubling(A, G, Q, wanted):
    """`X` by doubling of the Cayley transform `(H - shift)^-1 (H + shift)`."""
    eye = jnp.eye(A.shape[0], dtype=A.dtype)
    shift = size(A)
    shift = jnp.where(shift > 0, shift, 1)
    moved = A - shift * eye
    left = solve(moved, G)
    mixed = moved.T + Q @ left
    right = solve(mixed.T, jnp.concatenate([mixed.T + 2 * shift * eye, left.T], axis=1))
    power, weighted = right[:, : A.shape[0]], right[:, A.shape[0] :]
    H = solve(mixed, solve(moved.T, Q).T)
    H, G = symmetric(2 * shift * H), symmetric(2 * shift * weighted)
    return double(power, G, H, jnp.zeros_like(H), wanted)


@_find.defjvp
@full_precision
def _find_jvp(primals, tangents):
    found = _find(*primals)
    E = primals[5]

    def correction(closed_loop, error):
        return outside(E, lyapunov(closed_loop, error))

    return found, found_tangent(_equation, correction, found, primals, tangents)
