"""The discrete-time algebraic Riccati equation."""

from typing import Any

import equinox as eqx
import jax
import jax.lax as lax
import jax.numpy as jnp

from ..math._linear_solve import full_precision, is_definite, solve, symmetric
from ..math._size import size
from ._arguments import riccati_arguments
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
from ._spectrum import spectral_radius
from ._stein import MAX_DOUBLINGS, stein
from ._units import in_units


_SECOND_START = 1e4
"""How much higher the second start is than the first."""


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
    the equation itself, if its residual asks for them. It takes products and solves
    alone, no eigenvalues, which suits accelerators and `jax.vmap`; in a batch, a member
    that fails harms no other. It is differentiable to any order, in either mode, by the
    implicit function theorem.

    Where the cost does not see an unstable mode, the stabilising solution is not the
    cheapest: no control at all would cost less, and the state would grow.

    **Arguments:**

    - `A`: shape `(n, n)`. Real, or complex, as all others; then `'` is the conjugate
        transpose.
    - `B`: shape `(n, m)`.
    - `Q`: state weight, shape `(n, n)`, symmetric. An indefinite one is accepted.
    - `R`: control weight, shape `(m, m)`, symmetric, positive semidefinite. May be
        singular, and zero.
    - `S`: cross weight, shape `(n, m)`; zero by default.
    - `E`: descriptor matrix, shape `(n, n)`, invertible; the identity by default.
    - `throw`: raise unless the solution is found and stabilising (default); if false,
        look at `result`.

    **Returns:** a [`delucax.riccati.RiccatiSolution`][]. It is successful if the
    residual, in units of the states that balance the equation, is at most 1e-12 (1e-5
    in single precision), or up to a hundred times that if rounding of `X` alone may
    leave it; and if the closed loop is stable: a small residual alone is no
    certificate. Else `result` is one of `RESULTS.not_stabilisable`, `not_stabilising`
    (no such solution), `on_boundary` (eigenvalues on the unit circle, or so close that
    data changed by rounding have no stabilising solution), `not_converged` and
    `ill_posed`.

    **Raises:** `ValueError` on a matrix of the wrong shape, that is not finite, not
    symmetric or (`R`) not semidefinite; an error at run time as `throw` says.

    Source: Chu, Fan, Lin and Wang, 2004 (doubling); Benner, 2001 (balancing).

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp

        A = jnp.array([[1.0, 1.0], [0.0, 1.0]])
        B = jnp.array([[0.0], [1.0]])
        K = dlx.riccati.dare(A, B, jnp.eye(2), jnp.eye(1)).K  # [[0.4221, 1.2439]]
        ```
    """
    arguments = riccati_arguments("dare", A, B, Q, R, S, E, definite=False)
    return checked(discrete_solution(*arguments), "dare", throw)


def discrete_solution(A, B, Q, R, S, E) -> RiccatiSolution:
    """The solution of the equation with checked arguments."""
    return solution_of(_solution, True, A, B, Q, R, S, E)


@eqx.filter_jit
@full_precision
def _solution(A, B, Q, R, S, E):
    return solution_in_units(_find, _terms, "spectral_radius", A, B, Q, R, S, E)


def _terms(A, B, R, S, E, X):
    """`A'X`, `(A'XB + S) K`, `K = (R + B'XB)^-1 (B'XA + S')` and the closed loop."""
    moved = A.T @ X
    cross = moved @ B + S
    K = solve(R + symmetric(B.T @ (X @ B)), cross.T)
    closed_loop = A - B @ K
    if E is not None:
        closed_loop = solve(E, closed_loop)
    return moved, cross @ K, K, closed_loop


def _equation(A, B, Q, R, S, E, X):
    """What is left of the equation at `X`, and the closed loop; for derivatives."""
    moved, quadratic, _, closed_loop = _terms(A, B, R, S, E, X)
    weight = X if E is None else E.T @ X @ E
    return symmetric(moved @ A - weight - quadratic + Q), closed_loop


@jax.custom_jvp
def _find(A, B, Q, R, S, E, by) -> Found:
    """The stabilising `X`, and what is known about it."""
    n, dtype = A.shape[0], A.dtype
    eps = float(jnp.finfo(dtype).eps)
    plain_A, plain_B = (A, B) if E is None else (solve(E, A), solve(E, B))
    posed = _is_semidefinite(R)
    for M in (plain_A, plain_B, Q, R, S):
        posed = posed & jnp.all(jnp.isfinite(M))

    def attempt(kind, balanced):
        # From the units that balance the problem to those of the attempt.
        back = jnp.where(balanced, 1, 1 / by)
        a, b, q, r, s, e = in_units(back, A, B, Q, R, S, E)
        q, r, s, size_Q = weights(kind, q, r, s)
        # Those of E^-1 A and E^-1 B have the units of the states in their rows.
        state, row = back
        plain = jnp.stack([state, state])
        plain_a, plain_b, *_ = in_units(plain, plain_A, plain_B, Q, R, S, None)
        height = size_Q * jnp.where(kind == SECOND, _SECOND_START, 1)
        X, iterations = _start(plain_a, plain_b, q, r, s, height)
        units = by[0] * state, state
        X, left = polish(
            lambda *at: riccati_residual(True, a, b, q, r, s, e, *at, *units),
            lambda loop, error: outside(e, stein(loop, error)),
            outside(e, X),
        )
        radius = spectral_radius(left.closed_loop)
        # A stable loop may belong to a stationary point of a cost without a minimum.
        gap = jnp.where(_is_semidefinite(r + b.T @ X @ b), 1 - radius, -jnp.inf)
        # The rest is said in balanced units.
        balanced_X = X * (row[:, None] * row)
        loop = left.closed_loop * (state / state[:, None])
        magnified = (1 + size(loop) ** 2) * (1 if E is None else size(E) ** 2)
        return Attempt(
            X=balanced_X,
            residual=left.bounds[2],
            given=left.bounds[1],
            bound=radius,
            gap=gap,
            rounding=jnp.asarray(n * eps, dtype),
            near=jnp.abs(gap) < 10 * eps**0.5,
            least=attainable(balanced_X, magnified, left.terms[2]),
            modest=size(X) * eps**0.5 < size_Q,
            around=jnp.abs(gap) < 4 * eps**0.125,
            iterations=iterations,
        )

    return search(attempt, jnp.full_like(Q, jnp.nan), posed, jnp.any(by != 1))


def _is_semidefinite(weight):
    """Whether a symmetric matrix has no negative eigenvalue, up to rounding."""
    m, dtype = weight.shape[0], weight.dtype
    scale = size(weight)
    slack = 100 * m * jnp.finfo(dtype).eps * jnp.where(scale > 0, scale, 1)
    return is_definite(symmetric(weight) + slack * jnp.eye(m, dtype=dtype))


def _start(A, B, Q, R, S, height):
    """Doubling about `X0 = height I`."""
    # There the control weight is invertible even where R is not, and the recursion
    # cannot rest at a solution that leaves an unstable mode unseen by Q.
    n = A.shape[0]
    X0 = height * jnp.eye(n, dtype=A.dtype)
    cross = height * (A.T @ B) + S
    control = R + height * (B.T @ B)
    solved = solve(symmetric(control), jnp.concatenate([cross.T, B.T], axis=1))
    K, G = solved[:, :n], symmetric(B @ solved[:, n:])
    reduced_Q = symmetric(height * (A.T @ A) - X0 - cross @ K + Q)
    return double(A - B @ K, G, reduced_Q, X0, True)


def double(A, G, H, X0, wanted):
    """Doubling of `X = A' X (I + G X)^-1 A + H`, if it is wanted, as `X0 + X`."""
    n, eps = A.shape[0], jnp.finfo(A.dtype).eps
    eye = jnp.eye(n, dtype=A.dtype)

    def more(carry):
        *_, rest, k = carry
        return (k < MAX_DOUBLINGS) & (rest > eps)

    def body(carry):
        A, G, H, _, k = carry
        solved = solve(eye + G @ H, jnp.concatenate([A, G], axis=1))
        moved, weighted = solved[:, :n], solved[:, n:]
        change = symmetric(A.T @ (H @ moved))
        after = (A @ moved, symmetric(G + A @ weighted @ A.T), H + change)
        finite = jnp.all(jnp.stack([jnp.all(jnp.isfinite(M)) for M in after]))
        # What overflows is left at the last finite step: it has no stable loop, and
        # the caller finds that out.
        A, G, H = (
            jnp.where(finite, new, old)
            for new, old in zip(after, (A, G, H), strict=True)
        )
        # The next change is at most |A|^2 |H|.
        next_change = size(A) ** 2 * size(H)
        rest = jnp.minimum(size(change), next_change) / size(X0 + H)
        return A, G, H, jnp.where(finite, rest, 0), k + 1

    rest = jnp.where(wanted, jnp.asarray(jnp.inf, A.dtype), 0)
    start = (A, G, H, rest, jnp.asarray(0))
    _, _, H, _, iterations = lax.while_loop(more, body, start)
    return X0 + H, iterations


@_find.defjvp
@full_precision
def _find_jvp(primals, tangents):
    found = _find(*primals)
    E = primals[5]

    def correction(closed_loop, error):
        return outside(E, stein(closed_loop, error))

    return found, found_tangent(_equation, correction, found, primals, tangents)
