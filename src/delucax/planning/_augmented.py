"""Constraints, by the method of multipliers."""

from typing import NamedTuple

import jax
import jax.lax as lax
import jax.numpy as jnp
from jaxtyping import Array

from ._constraints import Multipliers, updated, violated
from ._descent import (
    CONVERGED,
    DIVERGED,
    INFEASIBLE,
    NOT_CONVERGED,
    optimise,
    Options,
    Outcome,
    Tolerances,
)
from ._problem import Problem
from ._start import begin, controls_of, Start


FIRST_RHO = 10.0
GROWTH = 10.0
ENOUGH = 0.25
"""The weight stays if the violation falls to this share."""


class _Progress(NamedTuple):
    out: Outcome
    rho: Array
    tolerance: Array
    done: Array


def with_constraints(
    problem: Problem,
    start: Start,
    guess: Array | None,
    tolerances: Tolerances,
    options: Options,
) -> Outcome:
    """Minimise the augmented Lagrangian, update the multipliers, and so on.

    Source: Bertsekas, 1982; Howell, Jackson and Manchester, 2019 (in this setting).
    """
    if problem.constraints is None:
        return optimise(problem, start, guess, tolerances.gradient, options)
    controls = controls_of(start)
    T = controls.shape[0]
    dtype = problem.x0.dtype
    most_rho = 1 / jnp.finfo(dtype).eps ** 0.6

    def inner(before, multipliers, tolerance):
        # The gains keep an unstable plant on the trajectory that it goes on from.
        start = Start(before.controls, before.states, before.gains)
        states = None if guess is None else before.states
        tolerance = jnp.maximum(tolerance, tolerances.gradient)
        given = problem.with_multipliers(multipliers), start, states, tolerance
        out = optimise(*given, options, before)
        values = problem.constraints_along(out.states, out.controls)
        *known, rho = multipliers
        each = [(c, y, rho, e) for (c, e), y in zip(values, known, strict=True)]
        y = [updated(*given) for given in each]
        missed = [jnp.max(violated(*given), initial=0.0) for given in each]
        violation = jnp.maximum(*missed)
        return out._replace(
            violation=violation, multipliers=Multipliers(y[0], y[1], rho)
        )

    def body(before):
        out, rho = before.out, before.rho
        assert out.multipliers is not None
        multipliers = out.multipliers._replace(rho=rho)
        after = inner(out, multipliers, before.tolerance)
        precise = before.tolerance <= tolerances.gradient
        holds = after.violation <= tolerances.constraints
        settled = (after.status == CONVERGED) & precise & holds
        spent = after.iterations >= options.max_iterations
        enough = holds | (after.violation <= ENOUGH * out.violation)
        rho = jnp.where(enough, rho, GROWTH * rho)
        hopeless = (rho > most_rho) & ~settled & ~spent
        status = jnp.where(settled, CONVERGED, NOT_CONVERGED)
        status = jnp.where(hopeless, INFEASIBLE, status)
        lost = after.status == DIVERGED
        status = jnp.where(lost, DIVERGED, status)
        # Once the constraints hold, the last minimisations are to full precision.
        tolerance = before.tolerance * jnp.where(holds, 0, 0.1)
        done = settled | spent | hopeless | lost
        return _Progress(after._replace(status=status), rho, tolerance, done)

    zero = jnp.zeros((), dtype)
    like = jnp.zeros((T + 1, *problem.x0.shape), dtype)
    sizes = jax.eval_shape(problem.constraints_along, like, controls)
    y = tuple(jnp.zeros(c.shape, dtype) for c, _ in sizes)
    rho, loose = jnp.full((), FIRST_RHO, dtype), jnp.full((), 1e-2, dtype)
    rollouts = 0
    if start.count > 1:
        rollouts = start.count
        start = begin(problem.with_multipliers(Multipliers(y[0], y[1], rho)), start)[0]
    n = problem.x0.shape[0]
    states, gains = start.states if guess is None else guess, start.gains
    if states is None:
        states = jnp.broadcast_to(problem.x0, (T + 1, n))
    if gains is None:
        gains = jnp.zeros((T, controls.shape[1], n), dtype)
    first = Outcome(
        states=states,
        controls=start.controls,
        gains=gains,
        cost=zero,
        residual=zero,
        trace=jnp.zeros(options.max_iterations + 1, dtype),
        status=jnp.asarray(NOT_CONVERGED),
        iterations=jnp.asarray(0),
        rollouts=jnp.asarray(rollouts),
        regularisation=zero,
        violation=jnp.full((), jnp.inf, dtype),
        multipliers=Multipliers(y[0], y[1], zero),
    )
    progress = _Progress(first, rho, loose, jnp.asarray(False))
    out = lax.while_loop(lambda progress: ~progress.done, body, progress).out
    return out._replace(cost=problem.total(out.states, out.controls))
