"""Constrained plans, by the method of multipliers (augmented Lagrangian)."""

import dataclasses

import jax
import jax.lax as lax
import jax.numpy as jnp

from .._results import choose, RESULTS
from ._descent import optimise, Options, Outcome
from ._problem import Multipliers, Problem, updated, violated
from ._start import controls_of, Start


FIRST_RHO = 10.0
_RHO_GROWTH = 10.0
ENOUGH = 0.25
"""The weight stays if the violation falls to this share."""


def with_constraints(problem: Problem, start: Start, options: Options) -> Outcome:
    """Minimise the augmented Lagrangian, update the multipliers, and so on, until the
    constraints hold, the iterations are spent, or no weight makes them hold.

    Source: Bertsekas, 1982; Howell, Jackson and Manchester, 2019 (in this setting).
    """
    if problem.constraints is None:
        return optimise(problem, start, options)
    T, m = controls_of(start).shape
    n, dtype = problem.x0.shape[0], problem.x0.dtype
    # At a larger weight rounding of the squares exceeds the tolerances.
    most_rho = 1 / jnp.finfo(dtype).eps ** 0.6

    def body(carry):
        before, tolerance, _ = carry
        # The gains keep an unstable plant on the trajectory that it goes on from.
        start = Start(before.controls, before.states, before.gains)
        now = dataclasses.replace(
            options,
            tolerance=jnp.maximum(tolerance, options.tolerance),
            states=None if options.states is None else before.states,
        )
        with_these = problem.with_multipliers(before.multipliers)
        after = optimise(with_these, start, now, before)
        values = problem.constraints_along(after.states, after.controls)
        *y, rho = before.multipliers
        each = [(c, y, rho, equal) for (c, equal), y in zip(values, y, strict=True)]
        missed = [jnp.max(violated(*given), initial=0.0) for given in each]
        violation = jnp.maximum(*missed)
        precise = tolerance <= options.tolerance
        holds = violation <= options.constraint_tolerance
        settled = (after.result == RESULTS.successful) & precise & holds
        spent = after.iterations >= options.max_iterations
        stage, final = (updated(*given) for given in each)
        # The multipliers converge by themselves, at a rate that grows with the weight:
        # it rises only where they are too slow (Bertsekas, 1982).
        enough = holds | (violation <= ENOUGH * before.violation)
        raised = jnp.where(enough, rho, _RHO_GROWTH * rho)
        hopeless = (raised > most_rho) & ~settled & ~spent
        lost = after.result == RESULTS.diverged
        result = choose(settled, RESULTS.successful, RESULTS.not_converged)
        result = choose(hopeless, RESULTS.infeasible, result)
        after = after._replace(
            violation=violation,
            # The new multipliers are those of the weight that was minimised with.
            multipliers=Multipliers(stage, final, raised),
            result=choose(lost, RESULTS.diverged, result),
        )
        # Once the constraints hold, the last minimisations are to full precision.
        tolerance = tolerance * jnp.where(holds, 0, 0.1)
        return after, tolerance, settled | spent | hopeless | lost

    like = jnp.zeros((T + 1, n), dtype)
    sizes = jax.eval_shape(problem.constraints_along, like, controls_of(start))
    stage, final = (jnp.zeros(c.shape, dtype) for c, _ in sizes)
    multipliers = Multipliers(stage, final, jnp.full((), FIRST_RHO, dtype))
    rollouts = 0
    if start.controls.ndim == 3:
        rollouts = start.count
        start = start.cheapest(problem.with_multipliers(multipliers))[0]
    states = start.states if options.states is None else options.states
    if states is None:
        states = jnp.broadcast_to(problem.x0, (T + 1, n))
    zero = jnp.zeros((), dtype)
    first = Outcome(
        states=states,
        controls=start.controls,
        gains=jnp.zeros((T, m, n), dtype) if start.gains is None else start.gains,
        cost=zero,
        residual=zero,
        trace=jnp.zeros(options.max_iterations + 1, dtype),
        result=RESULTS.not_converged,
        iterations=jnp.asarray(0),
        rollouts=jnp.asarray(rollouts),
        regularisation=zero,
        violation=jnp.full((), jnp.inf, dtype),
        multipliers=multipliers,
    )
    # The first minimisations are coarse, because their multipliers are wrong anyway.
    carry = first, jnp.full((), 1e-2, dtype), jnp.asarray(False)
    out, *_ = lax.while_loop(lambda carry: ~carry[2], body, carry)
    # The cost alone, without what the constraints add to it.
    return out._replace(cost=problem.total(out.states, out.controls))
