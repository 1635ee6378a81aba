"""What both Riccati equations share: Newton steps, and derivatives."""

from collections.abc import Callable
from typing import Any

import jax
import jax.lax as lax
import jax.numpy as jnp
from jaxtyping import Array

from ..math._linear_solve import no_tangent, solve, symmetric
from ._search import Found


_NEWTON_STEPS = 8
_FINE = 64
"""Units of rounding in the relative residual that need no correction."""


def polish(
    equation: Callable[[Array], tuple[Array, tuple[Array, Array]]],
    correction: Callable[[Array, Array], Array],
    X: Array,
) -> tuple[Array, Array, Array]:
    """Newton steps on the equation itself, if it asks for them, while they help.

    `equation(X)` is what is left of it, `(error, (relative, closed_loop))`;
    `correction(closed_loop, error)` solves it to first order. Returns `X`, the relative
    residual and the closed loop.
    """
    fine = _FINE * jnp.finfo(X.dtype).eps

    def more(carry):
        *_, going, k = carry
        return (k < _NEWTON_STEPS) & going

    def body(carry):
        *before, _, k = carry
        X, error, residual, closed_loop = before
        candidate = symmetric(X + correction(closed_loop, error))
        error, (found, closed_loop) = equation(candidate)
        better = found < residual
        # Where steps stop to help much, rounding is all that is left.
        going = (found < residual / 4) & (found > fine)
        now = candidate, error, found, closed_loop
        kept = (jnp.where(better, a, b) for a, b in zip(now, before, strict=True))
        return *kept, going, k + 1

    error, (residual, closed_loop) = equation(X)
    start = (X, error, residual, closed_loop, residual > fine, jnp.asarray(0))
    X, _, residual, closed_loop, *_ = lax.while_loop(more, body, start)
    return X, residual, closed_loop


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
    # Guarded at both ends: what is not finite in a failed member stays in it.
    tangents = jax.tree.map(lambda t: jnp.where(ok, t, 0), tangents)

    def left(*data):
        return equation(*data, found.X)

    _, error, (_, loop) = jax.jvp(left, primals, tangents, has_aux=True)
    stand_in = -jnp.eye(loop.shape[0], dtype=loop.dtype) / 2
    X = correction(jnp.where(ok, loop, stand_in), jnp.where(ok, error, 0))
    return no_tangent(found)._replace(X=jnp.where(ok, X, 0))


def detached(tree: Any, ok: Array) -> Any:
    """The same values, without derivatives in members that are not `ok`."""
    return jax.tree.map(lambda x: jnp.where(ok, x, lax.stop_gradient(x)), tree)


def outside(E: Array | None, Y: Array) -> Array:
    """The `X` of `Y = E'XE`."""
    return Y if E is None else symmetric(solve(E.T, solve(E.T, Y).T))
