"""Derivatives of an SQP plan, by the implicit function theorem.

They are the derivatives of the quadratic program at the solution, with exact second
derivatives even if the iteration used none.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp

from .._jax import deferred, nan_tangent
from .._results import RESULTS
from ..math._linear_solve import full_precision
from ..math._small import products_whole
from ..qp._derivatives import moved_with
from ._convex import convexified, made_convex
from ._implicit_rule import implicit
from ._sqp_iteration import gains_of, iterated, Outcome
from ._sqp_program import curved, form_of, rows_left
from ._transcription import expanded, Iterate, limits_of, slopes


def _tangents(
    out: Outcome, given: Any, varied: Any, rest: Any, change: Any
) -> dict[str, Any]:
    """The tangents of the trajectory, the multipliers and the gains."""
    problem = given[0]
    converged = out.result == RESULTS.successful
    # The derivatives of a failed plan are NaN. They are computed at the first state,
    # because NaN inside would spoil the other members of a batch.
    safe = lambda a, b: jnp.where(converged & jnp.isfinite(a), a, b)
    at = Iterate(
        safe(out.at.states, problem.x0),
        safe(out.at.controls, 0),
        safe(out.at.costates, 0),
        safe(out.at.sides, 0),
    )
    T = at.controls.shape[0]
    limits = limits_of(problem, T)
    model = expanded(problem, limits, at, True)
    held = curved(limits, at, model)
    zero = jnp.zeros((), model.h.dtype)
    _, weights = convexified(limits, model, held, zero, zero)

    # The terms of the program that change with the problem at the fixed solution. The
    # others do not matter, because they multiply a change of zero.
    def terms(varied):
        problem = eqx.combine(varied, rest)
        own = limits_of(problem, T)
        h, defects, rows = slopes(problem, own, at)
        return h, defects, *rows_left(own, rows), own.linear, own.quadratic

    (dh, *dterms) = jax.jvp(terms, (varied,), (change,))[1]

    def program(h, defects, low, high, linear, quadratic):
        values = model.values._replace(defects=defects)
        here = model._replace(values=values, h=h)
        target = jnp.where(jnp.abs(low) < jnp.abs(high), low, high)
        now = held._replace(target=jnp.where(held.rows, target, 0))
        own = limits._replace(linear=linear, quadratic=quadratic)
        convex = made_convex(own, here, now, weights)
        return form_of(own, here, convex, low, high), convex.s

    low, high = rows_left(limits, model.values.rows)
    at_solution = model.h, model.values.defects, low, high
    at_solution = *at_solution, limits.linear, limits.quadratic
    # Infinite bounds do not move.
    pairs = zip(at_solution[1:], dterms, strict=True)
    moved = [jnp.where(jnp.isfinite(a), d, 0) for a, d in pairs]
    (form, _), (dform, ds) = jax.jvp(program, at_solution, (dh, *moved))
    convex = made_convex(limits, model, held, weights)
    n = at.states.shape[1]
    costates = at.costates + convex.s
    point = jnp.zeros_like(form.q), costates, at.sides
    dz, dp, dsides, unique = moved_with(form, dform, *point)
    dx = dz[:, :n]
    dp = dp - ds - jnp.einsum("tij,tj->ti", convex.P, dx)
    ok = converged & unique & (weights.variables == 0) & (convex.shift == 0)
    parts = dx, dz[:-1, n:], dp, dsides
    moved = Iterate(*(nan_tangent(d, ok) for d in parts))

    @full_precision
    @products_whole()
    def gains(given, tangents):
        """The tangent of the gains, functions of the problem and the solution alone."""
        varied, rest, at = given

        def after(varied, at):
            problem = eqx.combine(varied, rest)
            limits = limits_of(problem, T)
            return gains_of(limits, at, expanded(problem, limits, at, True))

        return jax.jvp(after, (varied, at), tangents)[1]

    # Deferred, because it needs the third derivatives of the problem and is rarely
    # used.
    dK = deferred(gains, out.gains, (varied, rest, at), (change, moved))
    return dict(at=moved, gains=nan_tangent(dK, ok))


solution = implicit("SQP", iterated, _tangents)
"""The outcome of the iteration, differentiable with respect to the problem."""
