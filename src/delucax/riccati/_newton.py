"""What both Riccati equations share: Newton steps, derivatives, complex data."""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.lax as lax
import jax.numpy as jnp
from jaxtyping import Array

from ..math._linear_solve import full_precision, no_tangent, solve, symmetric
from ..math._size import size
from ._arguments import complex_form, is_complex, real_form
from ._residual import Residual, riccati_residual
from ._search import Found, tolerance, verdict
from ._solution import RiccatiSolution
from ._units import in_units, units


_NEWTON_STEPS = 8
_FINE = 64
"""Units of rounding in the relative residual that need no correction."""


def polish(
    residual: Callable[[Array, Array], Residual],
    correction: Callable[[Array, Array], Array],
    X: Array,
) -> tuple[Array, Residual]:
    """Newton steps on the equation itself, if it asks for them, while they help.

    `residual(X, accurately)` is what is left of it, and `correction(closed_loop,
    error)` solves it to first order. Where rounding may hide more than there is to be
    left, the steps go on with accurate residuals. Returns the best `X`, and what is
    left there.
    """
    eps = float(jnp.finfo(X.dtype).eps)
    fine = _FINE * eps
    wide = tolerance(X.dtype)

    def more(carry):
        return carry[4]

    def body(carry):
        X, last, best, accurately, going, patient, k = carry
        first = k == 0
        X = symmetric(X + step(last, going & ~first))
        new = residual(X, going & accurately)
        better = first | (new.relative < best[1].relative)
        # Where steps stop to help much, rounding is all that is left. But far from the
        # solution the first may not help and yet be one towards it.
        helped = first | (new.relative < best[1].relative / 4)
        best = jax.tree.map(lambda a, b: jnp.where(better, a, b), (X, new), best)
        rest = best[1].relative
        again = helped | patient & (rest > wide)
        again &= (rest > fine) & (k < _NEWTON_STEPS)
        hidden = ~again & ~accurately & (jnp.max(best[1].bounds) > wide)
        X = jnp.where(hidden, best[0], X)
        k = jnp.where(hidden, 0, k + 1)
        last = new.closed_loop, new.error
        return X, last, best, accurately | hidden, again | hidden, helped, k

    def step(last, needed):
        """The correction. A loop of one round is not run for a batch in which no member
        needs it, as in the first round, which only measures."""

        def once(carry):
            # What is carried changes, so that no work on it is moved ahead of the loop.
            nothing = jax.tree.map(jnp.zeros_like, last)
            return jnp.zeros_like(needed), correction(*carry[2]), nothing

        start = needed, jnp.zeros_like(X), last
        return lax.while_loop(lambda carry: carry[0], once, start)[1]

    no, yes = jnp.asarray(False), jnp.asarray(True)
    unknown = jax.tree.map(
        lambda s: jnp.zeros(s.shape, s.dtype), jax.eval_shape(residual, X, no)
    )
    last = unknown.closed_loop, unknown.error
    start = X, last, (X, unknown), no, yes, yes, jnp.asarray(0)
    return lax.while_loop(more, body, start)[2]


def attainable(X: Array, gain: Array, terms: Array) -> Array:
    """The relative residual that rounding of `X` may leave.

    `gain` is by how much the equation magnifies a change of `X`.
    """
    eps = jnp.finfo(X.dtype).eps
    return 8 * eps * size(X) * gain / jnp.where(terms > 0, terms, jnp.inf)


def found_tangent(
    equation: Callable,
    correction: Callable[[Array, Array], Array],
    found: Found,
    primals: tuple,
    tangents: tuple,
) -> Found:
    """The tangent of the solution, by the implicit function theorem.

    `equation` takes the data and `X`. It is zero in members that are not solved.
    """
    ok = found.differentiable
    primals, tangents = primals[:-1], tangents[:-1]
    # Guarded at both ends: what is not finite in a failed member stays in it.
    tangents = jax.tree.map(lambda t: jnp.where(ok, t, 0), tangents)

    A, B, Q, R, S, E = primals
    *safe, X = harmless(ok, A, B, Q, R, S, E, found.X)

    def left(*data):
        return equation(*data, X)

    _, error, loop = jax.jvp(left, tuple(safe), tangents, has_aux=True)
    stand_in = -jnp.eye(loop.shape[0], dtype=loop.dtype) / 2
    change = correction(jnp.where(ok, loop, stand_in), jnp.where(ok, error, 0))
    return no_tangent(found)._replace(X=jnp.where(ok, change, 0))


def harmless(ok: Array, A, B, Q, R, S, E, X) -> tuple:
    """The data and `X`, and in members that are not `ok` others that are finite.

    So that no derivative of them meets a matrix that cannot be solved with.
    """

    def eye(M):
        return jnp.eye(M.shape[0], dtype=M.dtype)

    given = (A, 0), (B, 0), (Q, 0), (R, eye(R)), (S, 0), (X, 0)
    A, B, Q, R, S, X = (jnp.where(ok, M, other) for M, other in given)
    return A, B, Q, R, S, None if E is None else jnp.where(ok, E, eye(E)), X


def settled(ok: Array, terms: Callable, *data) -> tuple[Array, Array]:
    """`K` and the closed loop, with derivatives in members that are `ok` alone."""
    A, B, _, R, S, E, X = lax.stop_gradient(data)
    *_, K, closed_loop = terms(A, B, R, S, E, X)
    A, B, _, R, S, E, X = harmless(ok, *data)
    *_, live_K, live_loop = terms(A, B, R, S, E, X)
    return jnp.where(ok, live_K, K), jnp.where(ok, live_loop, closed_loop)


def solution_in_units(
    find: Callable, terms: Callable, name: str, A, B, Q, R, S, E
) -> RiccatiSolution:
    """The solution, found with states in units that fit.

    `find` takes the data and the units, and `name` is that of the bound that it tells.
    """
    by = d, f = units(A, B, Q, R, E)
    data = in_units(by, A, B, Q, R, S, E)
    found = find(*data, by)
    K, closed_loop = settled(found.differentiable, terms, *data, found.X)
    bounds = dict.fromkeys(("spectral_radius", "spectral_abscissa"))
    return RiccatiSolution(
        X=found.X * (f[:, None] * f),
        K=K * d,
        residual=lax.stop_gradient(found.given),
        closed_loop=closed_loop / (d[:, None] / d),
        iterations=found.iterations,
        result=verdict(found),
        **(bounds | {name: lax.stop_gradient(found.bound)}),
    )


def outside(E: Array | None, Y: Array) -> Array:
    """The `X` of `Y = E'XE`."""
    return Y if E is None else symmetric(solve(E.T, solve(E.T, Y).T))


def solution_of(
    solve: Callable, discrete: bool, *data: Array | None
) -> RiccatiSolution:
    """The solution of an equation with checked data, complex ones in real form."""
    if not is_complex(*data):
        return solve(*data)
    data = jax.tree.map(real_form, data)
    return _as_complex(solve(*data), discrete, data)


@eqx.filter_jit
@full_precision
def _as_complex(solution: RiccatiSolution, discrete: bool, data: tuple):
    """A solution in complex form, for which the residual is bounded once more: rounding
    may have left an X that is no real form."""
    solution = eqx.tree_at(
        lambda s: (s.X, s.K, s.closed_loop), solution, replace_fn=complex_form
    )
    A, B, Q, R, S, E, X = lax.stop_gradient((*data, real_form(solution.X)))
    bound = riccati_residual(discrete, A, B, Q, R, S, E, X, True).bounds[0]
    bound = jnp.where(jnp.isfinite(bound), bound, solution.residual)
    return eqx.tree_at(lambda s: s.residual, solution, bound)
