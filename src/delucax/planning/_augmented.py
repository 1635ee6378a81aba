"""Plans under constraints, by the method of multipliers (augmented Lagrangian)."""

import dataclasses

import jax
import jax.lax as lax
import jax.numpy as jnp

from .._results import choose, RESULTS
from ._descent import optimise, Options, Outcome
from ._multipliers import in_order
from ._problem import Augmentation, Problem, updated, violated
from ._start import controls_of, Start


_RHO_GROWTH = 10.0
"""The factor by which the penalty weight grows."""
ENOUGH = 0.25
"""The weight does not grow if the violation falls to this share or less."""


def with_constraints(problem: Problem, start: Start, options: Options) -> Outcome:
    """Minimise the augmented Lagrangian and update the multipliers, in a loop that ends
    if the constraints hold, the iterations are spent, or no weight makes them hold.

    Source: Bertsekas, 1982; Howell, Jackson and Manchester, 2019 (in this setting).
    """
    n, dtype = problem.x0.shape[0], problem.x0.dtype
    starts = start.stacked(n).trajectories
    count, T, m = starts.controls.shape
    if problem.constraints is None:
        return optimise(problem, starts, count, options)
    # At a larger weight, the rounding of the penalty exceeds the tolerances.
    most_rho = 1 / jnp.finfo(dtype).eps ** 0.6

    def body(carry):
        before, starts, count, tolerance, _ = carry
        now = dataclasses.replace(
            options,
            tolerance=jnp.maximum(tolerance, options.tolerance),
            states=None if options.states is None else before.states,
        )
        with_these = problem.with_multipliers(before.multipliers)
        after = optimise(with_these, starts, count, now, before)
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
        # The multipliers converge at a rate that grows with the weight. The weight only
        # grows if they are too slow (Bertsekas, 1982).
        enough = holds | (violation <= ENOUGH * before.violation)
        raised = jnp.where(enough, rho, _RHO_GROWTH * rho)
        hopeless = (raised > most_rho) & ~settled & ~spent
        lost = after.result == RESULTS.diverged
        result = RESULTS.not_converged
        if problem.dynamics.event_names:
            changed = after.result == RESULTS.events_changed
            result = choose(changed, RESULTS.events_changed, result)
        result = choose(settled, RESULTS.successful, result)
        result = choose(hopeless, RESULTS.no_feasible_point, result)
        after = after._replace(
            violation=violation,
            # The multipliers are updated with the old weight, then the weight grows.
            multipliers=Augmentation(stage, final, raised),
            result=choose(lost, RESULTS.diverged, result),
        )
        # Once the constraints hold, minimise to full precision.
        tolerance = tolerance * jnp.where(holds, 0, 0.1)
        # With the gains, an unstable plant stays on the last trajectory.
        on = Start(after.controls, after.states, after.gains)
        starts = jax.tree.map(lambda all, one: all.at[0].set(one), starts, on)
        ended = settled | spent | hopeless | lost
        return after, starts, jnp.ones_like(count), tolerance, ended

    states = jnp.zeros((T + 1, n), dtype) if options.states is None else options.states
    sizes = jax.eval_shape(problem.constraints_along, states, starts.controls[0])
    stage, final = (jnp.zeros(c.shape, dtype) for c, _ in sizes)
    rho, zero = jnp.asarray(options.penalty, dtype), jnp.zeros((), dtype)
    given = start.multipliers
    if given is not None:
        args = problem.t0, problem.x0, controls_of(start)[0]
        stage = in_order(problem.constraints, False, args, given.stage, stage)
        final = in_order(problem.constraints, True, args[:2], given.final, final)
        if given.penalty is not None:
            # Start one step lower. Otherwise the weight could only grow from one plan
            # to the next.
            rho = jnp.maximum(rho, given.penalty / _RHO_GROWTH)
    first = Outcome(
        states=states,
        controls=starts.controls[0],
        gains=jnp.zeros((T, m, n), dtype),
        cost=zero,
        residual=zero,
        trace=jnp.zeros(options.max_iterations + 1, dtype),
        result=RESULTS.not_converged,
        iterations=jnp.zeros((), int),
        rollouts=jnp.zeros((), int),
        regularisation=zero,
        violation=jnp.full((), jnp.inf, dtype),
        multipliers=Augmentation(stage, final, rho),
    )
    # The first minimisations are coarse, because their multipliers are still wrong.
    coarse = jnp.full((), 1e-2, dtype)
    carry = first, starts, jnp.asarray(count, int), coarse, jnp.asarray(False)
    out, *_ = lax.while_loop(lambda carry: ~carry[-1], body, carry)
    # The cost of the plan does not include the terms of the constraints.
    return out._replace(cost=problem.total(out.states, out.controls))
