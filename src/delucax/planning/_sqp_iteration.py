"""The iteration of sequential quadratic programming.

Each iteration solves the quadratic program about the current trajectory, and takes the
longest step that a funnel accepts: the violation stays below the width of the funnel,
and either the cost or the width falls enough.

If the program has no feasible point, the next program is elastic: the squared
violations, times a price, are part of its cost. The price rises until a program without
them is feasible, or no price makes the constraints hold.

Source: Kiessling, Leyffer and Vanaret, 2024 (the funnel).
"""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax

from .._jax import in_parts
from .._results import choose, Result, RESULTS
from .._typing import Array
from ._convex import (
    convexified,
    FIRM,
    held_rows,
    made_convex,
    Weights,
    with_squares,
)
from ._descent import first_accepted
from ._problem import Problem
from ._sqp_program import (
    curved,
    form_of,
    infeasibility,
    optimality,
    priced,
    rows_left,
    solved,
    without,
)
from ._start import controls_of, Start
from ._transcription import (
    expanded,
    Iterate,
    Limits,
    limits_of,
    measured,
    Model,
    with_multipliers,
)


HALVINGS = 12
LEAST_SHARE = 1e-4
"""The Armijo constant: the least share of the predicted decrease."""
WIDTH, TIMES = 1.0, 5.0
"""The first width of the funnel is `max(WIDTH, TIMES * first violation)`."""
SHRINK = 0.9
"""A step that does not lower the cost must lower the violation to this share of the
width."""
NARROW = 0.9
"""The share of the old width in the new width; the rest is the violation."""
SWITCH = 1e-3
"""The cost must fall if its predicted decrease is at least this share of the violation.
"""
NEAR = 0.01
"""Below this error, the Hessian of the Lagrangian replaces that of the cost, the price
rises, and an elastic program is followed by one with the constraints."""
FIRST_PRICE = 10.0
"""The first price, relative to the gradient of the cost."""
MOST_PRICE, MOST_ROUNDING = 1e7, 0.01
"""The largest price, relative to the gradient of the cost over the violation, and its
largest product with the unit of rounding: at a higher price, a step loses the cost in
the rounding of the squared violations."""
PATIENCE = 50
"""After this many iterations, elastic programs use a penalty function, not the funnel.
"""
GUESSES = 4
"""How many guesses of the active constraints are tried for a quadratic program."""


class Options(eqx.Module):
    """The fields of `SQP` with their defaults filled in."""

    tolerance: Array
    constraint_tolerance: Array
    states: Array | None
    second_order: bool = eqx.field(static=True)
    max_iterations: int = eqx.field(static=True)


class Outcome(NamedTuple):
    """The last iterate with its status."""

    at: Iterate
    gains: Array
    trace: Array
    residual: Array
    violation: Array
    result: Result
    iterations: Array
    rollouts: Array
    regularisation: Array


class _Progress(NamedTuple):
    """The state of the loop."""

    now: Outcome
    price: Array
    """The price of squared violations; zero until a program has no feasible point."""
    elastic: Array
    """Whether the next program may violate constraints at this price."""
    width: Array
    """The width of the funnel."""
    shift: Array
    """The multiple of the identity that was last added to a Hessian."""
    near: Array
    """Whether the last error was small enough for the Hessian of the Lagrangian."""
    flat: Array
    """Whether the program with the Hessian of the cost had no unique minimum."""
    stuck: Array
    """Whether the regularisation reached its limit without an accepted step."""
    done: Array


def gains_of(limits: Limits, at: Iterate, model: Model) -> Array:
    """The gains `K` of the feedback `u = u_planned - K (x - x_planned)`, which keeps
    the active rows active for small deviations."""
    zero = jnp.zeros((), model.h.dtype)
    firm = FIRM * jnp.max(jnp.abs(model.H))
    return made_convex(
        limits, model, curved(limits, at, model), Weights(firm, zero, zero)
    ).K


def started(
    problem: Problem, limits: Limits, start: Start, options: Options
) -> Iterate:
    """The trajectory to start from.

    This is the trajectory of the controls or the first state at every stage, which does
    not follow the dynamics. The one with the smaller violation is taken.
    """
    if options.states is not None:
        controls = _clipped(limits, controls_of(start))
        states = options.states
        states = states.at[0].add(problem.missed_start(states[0]))
    else:
        _, states, controls, cost = start.cheapest(problem)
        controls = _clipped(limits, controls)
        still = jnp.broadcast_to(problem.x0, states.shape)
        bad = lax.map(
            lambda x: infeasibility(limits, measured(problem, limits, x, controls)),
            jnp.stack([states, still]),
        )
        lost = ~jnp.isfinite(cost) | ~(bad[0] <= bad[1])
        states = jnp.where(lost, still, states)
    sides = jnp.zeros((2, *limits.low.shape), controls.dtype)
    at = Iterate(states, controls, jnp.zeros_like(states), sides)
    return with_multipliers(problem, limits, at, start.multipliers)


def _clipped(limits: Limits, controls: Array) -> Array:
    """The controls, clipped to their hard bounds."""
    ends = limits.ends()
    return controls if ends is None else jnp.clip(controls, *ends)


def iterated(problem: Problem, start: Start, options: Options) -> Outcome:
    """Iterate from a trajectory to a solution."""
    limits = limits_of(problem, start.horizon)
    at = started(problem, limits, start, options)
    (T, m), n, dtype = at.controls.shape, at.states.shape[1], at.states.dtype
    eps = float(jnp.finfo(dtype).eps)
    zero, infinite = jnp.zeros((), dtype), jnp.full((), jnp.inf, dtype)
    now = Outcome(
        at=at,
        gains=jnp.zeros((T, m, n), dtype),
        trace=jnp.zeros(options.max_iterations + 1, dtype),
        residual=infinite,
        violation=infinite,
        result=RESULTS.not_converged,
        iterations=jnp.zeros((), int),
        rollouts=jnp.zeros((), int),
        regularisation=zero,
    )
    no = jnp.asarray(False)
    first = _Progress(now, zero, no, infinite, zero, no, no, no, no)

    def body(before: _Progress) -> _Progress:
        now = before.now
        # Far from a solution the multipliers are wrong. The curvature of the
        # constraints, which they weight, is then worse than none.
        share = jnp.where(before.near | before.flat, 1, 0).astype(dtype)
        model = expanded(problem, limits, now.at, options.second_order, share)
        gradient, slope, error, violation = optimality(limits, now.at, model)
        feasible = violation <= options.constraint_tolerance
        settled = error <= options.tolerance
        # Near a stationary point that is not feasible, the price is too low.
        most = min(MOST_PRICE, MOST_ROUNDING / eps)
        most = most * (1 + jnp.max(jnp.abs(model.h))) / violation
        low = (error <= NEAR) & ~feasible & before.elastic
        # The violation still changes a little, and with it the largest price.
        hopeless = settled & low & (before.price >= 0.9 * most)
        price = jnp.where(low, jnp.minimum(10 * before.price, most), before.price)
        cost = model.values.cost + limits.penalty(model.values.rows)
        lost = ~jnp.isfinite(cost + slope + error + violation)
        result = choose(settled & feasible, RESULTS.successful, now.result)
        result = choose(hopeless, RESULTS.no_feasible_point, result)
        result = choose(lost, RESULTS.diverged, result)
        ended = (settled & feasible) | hopeless | lost | before.stuck
        ended = ended | (now.iterations >= options.max_iterations)
        # The costates of the program are changes, which have smaller rounding errors.
        h, model = model.h, model._replace(h=gradient)
        # At the end, the convex cost gives the gains, which must keep the hard rows.
        low, high = rows_left(limits, model.values.rows)
        payable = priced(limits, price, before.elastic & ~ended)
        held = held_rows(payable, now.at.sides, low, high)
        held, low, high = without(limits.hard & ~payable.hard, price, held, low, high)
        added = jnp.where(ended, 0, now.regularisation)
        convex, weights = convexified(limits, model, held, before.shift, added, ended)
        now = now._replace(
            gains=convex.K,
            trace=now.trace.at[now.iterations].set(cost),
            residual=slope,
            violation=violation,
            result=result,
        )
        near = error <= NEAR
        flat = before.flat | ((share == 0) & (weights.variables > 0))
        after = before._replace(now=now, price=price, near=near, flat=flat, done=ended)
        program = model, h, payable, low, high, held, convex, weights
        going = lambda after: step(after, program)
        return lax.cond(ended, lambda after: after, going, after)

    def step(before: _Progress, program: Any) -> _Progress:
        now, price = before.now, before.price
        model, h, payable, low, high, held, convex, weights = program
        at, values = now.at, model.values
        form = form_of(limits, model, convex, low, high)
        # Fewer guesses at first, because the first multipliers may be zero.
        guesses = jnp.where(now.iterations > 0, GUESSES, 2)
        qp = solved(form, at, guesses, jnp.asarray(eps**0.5 / 10, dtype))
        dz = qp.x
        dx, du = dz[:, :n], dz[:-1, n:]
        dp = qp.p - jnp.sum(convex.P * dx[:, None], axis=2) - convex.s
        usable = jnp.all(jnp.isfinite(dz)) & (qp.errors[0] <= 1e3)
        impossible = ~usable & ~before.elastic
        missed = infeasibility(limits, values)
        first = jnp.maximum(WIDTH, TIMES * missed)
        width = jnp.where(jnp.isfinite(before.width), before.width, first)
        change = jnp.concatenate(
            [
                dz[:, limits.bounded[0] : limits.bounded[1]],
                jnp.sum(model.G * dz[:, None], axis=2),
            ],
            axis=1,
        )
        sides = with_squares(limits, model, held, weights, qp.z, change)
        # Elastic programs may cycle in the funnel. Later a penalty function must fall.
        elastic = before.elastic & (now.iterations >= PATIENCE)
        firm = jnp.where(elastic, 1.5 * jnp.max(jnp.abs(at.costates + dp)), 0)

        def merit(values):
            paid = payable.penalty(values.rows)
            return values.cost + paid + firm * jnp.sum(jnp.abs(values.defects))

        falling = payable.penalty(values.rows) - payable.penalty(values.rows + change)
        decrease = falling - jnp.sum(h * dz)
        decrease = decrease + firm * jnp.sum(jnp.abs(values.defects))
        now_at = merit(values)
        slack = 10 * eps * jnp.abs(now_at)

        def trial(i):
            length = 0.5 ** i.astype(dtype)
            states = at.states + length * dx
            controls = _clipped(limits, at.controls + length * du)
            there = measured(problem, limits, states, controls)
            far = infeasibility(limits, there)
            by_cost = elastic | (length * decrease >= SWITCH * missed)
            enough = now_at - LEAST_SHARE * length * jnp.maximum(decrease, 0) + slack
            closer = jnp.maximum(SHRINK * width, 100 * eps)
            good = jnp.where(by_cost, merit(there) <= enough, far <= closer)
            good = good & (elastic | (far <= width)) & jnp.isfinite(there.cost)
            narrow = (1 - NARROW) * far + NARROW * width
            narrowed = jnp.where(by_cost, width, narrow)
            return (states, controls, length, narrowed), good

        otherwise = at.states, at.controls, zero, width
        count = jnp.where(usable, HALVINGS, 0)
        tried, candidate, accepted = first_accepted(trial, count, otherwise)
        states, controls, length, narrowed = candidate
        moved = Iterate(
            states,
            controls,
            at.costates + length * dp,
            at.sides + length * (sides - at.sides),
        )
        pick = lambda new, old: jnp.where(accepted, new, old)
        scale = jnp.max(jnp.abs(model.H))
        # After elastic programs, a program that is feasible again may still fail.
        lost = ~accepted & ~before.elastic & (price > 0)
        failed = ~accepted & ~impossible & ~lost
        mu = now.regularisation
        mu = jnp.where(failed, jnp.maximum(10 * mu, 1e-4 * scale), mu / 10)
        mu = jnp.where(mu < 1e-8 * scale, 0, mu)
        stuck = mu > 1e10 * scale
        failure = choose(elastic, RESULTS.no_feasible_point, RESULTS.no_descent)
        after = now._replace(
            at=jax.tree.map(pick, moved, at),
            iterations=now.iterations + 1,
            rollouts=now.rollouts + tried,
            regularisation=mu,
            result=choose(stuck, failure, now.result),
        )
        start = FIRST_PRICE * (1 + jnp.max(jnp.abs(h)))
        # In units of the constraints. It starts low, because it only rises.
        start = start / jnp.maximum(now.violation, 1)
        return before._replace(
            now=after,
            price=jnp.where(impossible & (price == 0), start, price),
            # Stay elastic until the iterate is near a solution at this price. Before
            # that, the hard program is mostly infeasible and takes more iterations.
            elastic=impossible | lost | (before.elastic & ~(accepted & before.near)),
            width=pick(narrowed, width),
            shift=jnp.where(weights.variables > 0, weights.variables, before.shift),
            stuck=stuck,
        )

    # XLA fails on the added call next to empty arrays, such as those of no controls.
    loop = in_parts(body) if m else body
    out = lax.while_loop(lambda progress: ~progress.done, loop, first)
    now = out.now
    counts = jnp.arange(options.max_iterations + 1)
    last = now.trace[jnp.minimum(now.iterations, options.max_iterations)]
    trace = jnp.where(counts <= now.iterations, now.trace, last)
    return now._replace(trace=trace)
