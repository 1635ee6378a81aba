"""The real-time iteration: one quadratic program in each sampling period.

It is split in two: the preparation runs before the state is known, the feedback after.

Source: Diehl, Bock, Schloeder, Findeisen, Nagy and Allgoewer, 2002.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax

from .._results import choose, first_failure, RESULTS
from ..qp._derivatives import optimum, Options
from ..qp._embedding import Tolerances
from ._convex import Convex, convexified, held_rows, made_convex
from ._plan import Plan
from ._problem import Problem
from ._sqp_program import form_of, rows_left
from ._start import Start
from ._transcription import (
    expanded,
    Iterate,
    limits_of,
    Model,
    multipliers_of,
    with_multipliers,
)


_USABLE = 1e3
"""The solution is used if its errors are at most this multiple of the tolerance."""
_REFINEMENTS = 2


class Prepared(NamedTuple):
    """The prepared step: the problem about the last trajectory."""

    at: Iterate
    model: Model
    convex: Convex


def prepared(problem: Problem, start: Start, second_order: bool) -> Prepared:
    """Expand the problem about the states and controls of `start`."""
    assert start.states is not None
    limits = limits_of(problem, start.horizon)
    sides = jnp.zeros((2, *limits.low.shape), start.controls.dtype)
    at = Iterate(start.states, start.controls, jnp.zeros_like(start.states), sides)
    at = with_multipliers(problem, limits, at, start.multipliers)
    model = expanded(problem, limits, at, second_order)
    held = held_rows(limits, at.sides, *rows_left(limits, model.values.rows))
    zero = jnp.zeros((), model.h.dtype)
    # No derivative, because the added terms do not change the solution to first order.
    fixed = lax.stop_gradient((model, held))
    _, weights = convexified(limits, *fixed, zero, zero)
    return Prepared(at, model, made_convex(limits, model, held, weights))


def fed_back(problem: Problem, ready: Prepared, max_steps: int) -> Plan:
    """The plan from `problem.x0`, by one full step."""
    at, model, convex = ready
    (T, n, _), dtype = model.F.shape, model.h.dtype
    limits = limits_of(problem, T)
    off = problem.missed_start(at.states[0])
    defects = model.values.defects.at[0].set(off)
    model = model._replace(values=model.values._replace(defects=defects))
    low, high = rows_left(limits, model.values.rows)
    form = form_of(limits, model, convex, low, high)
    tolerance = jnp.asarray(float(jnp.finfo(dtype).eps) ** 0.5 / 10, dtype)
    tolerances = Tolerances(tolerance, tolerance, jnp.asarray(1e-6, dtype))
    warm = jnp.zeros_like(form.q), jnp.zeros_like(at.costates), at.sides
    qp = optimum(form, Options(warm, tolerances, max_steps, _REFINEMENTS))
    states, controls = at.states + qp.x[:, :n], at.controls + qp.x[:-1, n:]
    ends = limits.ends()
    controls = controls if ends is None else jnp.clip(controls, *ends)
    p = qp.p - jnp.einsum("tij,tj->ti", convex.P, qp.x[:, :n]) - convex.s
    solved, bad, _ = qp.errors
    # The solver would take a row with NaN as a row without bounds.
    data = jnp.concatenate([jnp.ravel(a) for a in jax.tree.leaves(model)])
    posed = jnp.all(jnp.isfinite(data))
    usable = posed & jnp.all(jnp.isfinite(qp.x)) & (solved <= _USABLE)
    result = choose(bad <= 1, RESULTS.no_feasible_point, RESULTS.diverged)
    result = choose(usable, RESULTS.not_converged, result)
    result = choose(posed & (solved <= 1), RESULTS.successful, result)
    result = first_failure(problem.failure(states, controls), result)
    return problem.plan(
        states,
        controls,
        problem.total(states, controls),
        gains=convex.K,
        multipliers=multipliers_of(problem, limits, Iterate(states, controls, p, qp.z)),
        result=result,
        residual=qp.measured[1],
        violation=qp.measured[0],
        iterations=qp.iterations,
    )
