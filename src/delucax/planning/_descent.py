"""The iteration of iterative LQR and differential dynamic programming."""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.lax as lax
import jax.numpy as jnp
from jaxtyping import Array

from .._results import choose, Result, RESULTS
from ._lq import in_parallel, in_sequence, model, Policy, predicted_change, Stages
from ._problem import Multipliers, Problem, roll_out
from ._start import controls_of, Start


SEARCHES = ("parallel", "backtracking")
HALVINGS = 12
"""The shortest step tried is 2^-11 of the full one."""
LEAST_SHARE = 1e-4
"""The constant of sufficient decrease (Armijo): a share of the predicted decrease."""
FACTOR = 2.0
LEAST_MU = 1e-6
MOST_MU = 1e10
"""The factor by which the regularisation changes first, and its range above zero."""


class Options(eqx.Module):
    """The fields of `ILQR`, defaults filled in."""

    tolerance: Array
    constraint_tolerance: Array
    states: Array | None
    """States to start from that need not follow from the controls."""
    second_order: bool = eqx.field(static=True)
    regularise: str = eqx.field(static=True)
    line_search: str = eqx.field(static=True)
    parallel: bool = eqx.field(static=True)
    max_iterations: int = eqx.field(static=True)
    finite_difference: float | None = eqx.field(static=True)


class Outcome(NamedTuple):
    """An iterate with its status; the last one is the outcome."""

    states: Array
    controls: Array
    gains: Array
    cost: Array
    residual: Array
    trace: Array
    result: Result
    iterations: Array
    rollouts: Array
    regularisation: Array
    violation: Array | None = None
    multipliers: Multipliers | None = None


class _Progress(NamedTuple):
    """The state of the loop."""

    now: Outcome
    defects: Array | None
    """How far each step misses the next state, where the states were given."""
    delta: Array
    """The factor by which the regularisation last changed."""
    exact: Array
    """Whether second derivatives of the dynamics are taken."""
    penalty: Array
    """The weight of the defects."""
    done: Array


def optimise(
    problem: Problem, start: Start, options: Options, before: Outcome | None = None
) -> Outcome:
    """Iterate from the cheapest start, or from its controls and the states of the
    options if there are any; counting on from `before`, if that is given."""
    T, m = controls_of(start).shape
    n, dtype = problem.x0.shape[0], problem.x0.dtype
    zero, defects = jnp.zeros((), dtype), None
    iteration, rollouts = jnp.asarray(0), jnp.asarray(0)
    if before is not None:
        iteration, rollouts = before.iterations, before.rollouts
    if options.states is None:
        _, states, controls, cost = start.cheapest(problem)
        rollouts = rollouts + start.count
    else:
        controls = jax.vmap(problem.clip)(controls_of(start))
        states = options.states.at[0].set(problem.x0)
        # How far each step of the guess misses its next state, shape (T, n).
        inputs = problem.times(T)[:-1], states[:-1], controls, problem.w
        reached = jax.vmap(problem.step)(*inputs)
        defects = jax.vmap(problem.deviation)(reached, states[1:])
        cost = problem.total(states, controls)
        good = jnp.isfinite(cost) & jnp.all(jnp.isfinite(defects))
        cost = jnp.where(good, cost, jnp.inf)
    lost = ~jnp.isfinite(cost)
    counts = jnp.arange(options.max_iterations + 1)
    trace = jnp.full(counts.shape, cost)
    if before is not None:
        trace = jnp.where(counts < iteration, before.trace, trace)
    now = Outcome(
        states=states,
        controls=controls,
        gains=jnp.zeros((T, m, n), dtype),
        cost=cost,
        residual=jnp.full((), jnp.inf, dtype),
        trace=trace,
        result=choose(lost, RESULTS.diverged, RESULTS.not_converged),
        iterations=iteration,
        rollouts=rollouts,
        regularisation=zero,
    )
    first = _Progress(
        now, defects, jnp.ones((), dtype), jnp.asarray(True), penalty=zero, done=lost
    )
    body = functools.partial(_iterate, problem, options)
    now = lax.while_loop(lambda progress: ~progress.done, body, first).now
    return now._replace(
        trace=jnp.where(counts <= now.iterations, now.trace, now.cost),
        violation=zero,
        multipliers=problem.multipliers,
    )


def _iterate(problem: Problem, options: Options, before: _Progress) -> _Progress:
    now, defects, tolerance = before.now, before.defects, options.tolerance
    mu = now.regularisation
    about = problem, now.states, now.controls, defects, options.second_order
    stages = model(*about, before.exact, options.finite_difference)
    # One linear-quadratic problem about the present trajectory.
    policy, residual, settled = directions(problem, stages, now.controls, mu, options)
    penalty = _penalty(before.penalty, defects, policy)
    missed = 0.0 if defects is None else jnp.max(jnp.abs(defects))
    closed = missed <= tolerance * (1 + jnp.max(jnp.abs(now.states)))
    # By how much rounding may change the cost: its own, and that of the states and
    # controls that it is computed from, which weighs more where targets are far from
    # zero.
    z = jnp.concatenate([now.states[:-1], now.controls], axis=1)
    terms = jnp.sum(jnp.abs(stages.h * z))
    terms = terms + jnp.sum(jnp.abs(stages.v * now.states[-1]))
    rounding = jnp.finfo(z.dtype).eps * (jnp.abs(now.cost) + terms)
    # The predicted decrease may be below the rounding of the cost. Full steps still
    # lower the gradient then; once they no longer do, the iteration has converged.
    predicted = -policy.slope - policy.curvature / 2
    spent = (jnp.abs(predicted) <= rounding) & (mu == 0) & (tolerance > 0)
    spent = spent & (residual >= now.residual)
    converged = policy.ok & closed & (settled | spent)
    out_of_time = now.iterations >= options.max_iterations
    rest = (now.states, now.controls, now.cost, defects), jnp.asarray(False)
    given = problem, before, policy, penalty, rounding
    (states, controls, cost, defects), accepted, tried = lax.cond(
        converged | out_of_time | ~policy.ok,
        lambda: (*rest, jnp.asarray(0)),
        lambda: _searched(options.line_search, *given),
    )
    # Fall back to Gauss-Newton if the exact Hessian is indefinite or the search failed.
    flatten = ~accepted & before.exact & options.second_order
    changed = _schedule(accepted, mu, before.delta)
    keep = lambda old, new: jnp.where(flatten, old, new)
    mu, delta = jax.tree.map(keep, (mu, before.delta), changed)
    exact = jnp.where(flatten, False, before.exact | accepted)
    ended = converged | out_of_time
    stuck = (mu > MOST_MU) & ~ended
    result = choose(stuck, RESULTS.no_descent, RESULTS.not_converged)
    result = choose(converged, RESULTS.successful, result)
    iteration = now.iterations + jnp.where(ended, 0, 1)
    after = now._replace(
        states=states,
        controls=controls,
        gains=jnp.where(policy.ok, policy.K, now.gains),
        cost=cost,
        residual=residual,
        trace=now.trace.at[iteration].set(cost),
        result=result,
        iterations=iteration,
        rollouts=now.rollouts + tried,
        # At the end what the last policy was computed with, not what would come next.
        regularisation=jnp.where(ended, now.regularisation, mu),
    )
    return _Progress(after, defects, delta, exact, penalty, ended | stuck)


def _searched(kind, problem, before: _Progress, policy: Policy, penalty, rounding):
    """Backtracking line search: the states, controls, cost and defects after the
    longest step of sufficient decrease, or as before; whether one was accepted; and how
    many were tried.

    The merit function is the cost plus `penalty` times the sum of the defects. The cost
    is known to within `rounding`.
    """
    now, defects = before.now, before.defects
    missed = 0.0 if defects is None else jnp.sum(jnp.abs(defects))
    # A step that only rounding makes worse is taken, or the search would end short of
    # the minimum.
    slack = rounding + 10 * jnp.finfo(now.cost.dtype).eps * jnp.abs(now.cost)
    lengths = 0.5 ** jnp.arange(HALVINGS, dtype=now.cost.dtype)

    def trial(length):
        states, controls, cost = roll_out(
            problem, now.states, now.controls, policy.K, policy.k, length, defects
        )
        # The model's decrease along the step, -(a slope + a^2 curvature / 2), and a
        # times the defects, of which a step of length a closes that share.
        curvature = length * policy.curvature / 2
        predicted = length * (penalty * missed - policy.slope - curvature)
        decrease = now.cost - cost + length * penalty * missed
        enough = decrease >= LEAST_SHARE * predicted - slack
        return (states, controls, cost), enough & jnp.isfinite(cost)

    last = now.states, now.controls, now.cost
    if kind == "parallel":
        candidates, enough = jax.vmap(trial)(lengths)
        best = jnp.argmax(enough)  # the first of the largest: the longest step
        accepted, length, tried = enough[best], lengths[best], jnp.asarray(HALVINGS)
        candidate = jax.tree.map(lambda a: a[best], candidates)
    else:
        step = lambda i: trial(lengths[i])
        tried, candidate, accepted = first_accepted(step, HALVINGS, last)
        length = lengths[tried - 1]
    # A step of length a removes that share of the defects.
    keep = lambda new, old: jnp.where(accepted, new, old)
    left = None if defects is None else keep((1 - length) * defects, defects)
    return (*jax.tree.map(keep, candidate, last), left), accepted, tried


def first_accepted(
    trial: Callable[[Array], tuple[Any, Array]], count: int, otherwise: Any
) -> tuple[Array, Any, Array]:
    """Try the candidates `0, ..., count - 1` in turn until `trial` accepts one.

    Returns how many were tried, the last of them, and whether it was accepted.
    `otherwise` has the structure of a candidate.
    """

    def body(carry):
        tried, *_ = carry
        return tried + 1, *trial(tried)

    def going(carry):
        tried, _, accepted = carry
        return ~accepted & (tried < count)

    return lax.while_loop(going, body, (jnp.asarray(0), otherwise, jnp.asarray(False)))


def directions(
    problem: Problem, stages: Stages, controls: Array, mu: Array, options: Options
) -> tuple[Policy, Array, Array]:
    """The policy of the model, the residual, and whether that is small enough."""
    box, tolerance = problem.room(controls), options.tolerance
    if options.parallel:
        policy = in_parallel(stages, mu)
    else:
        policy = in_sequence(stages, mu, options.regularise == "state", box)
    if stages.d is not None:
        # The backward pass reads both off its terms, which holds only without defects.
        slope, curvature = predicted_change(stages, policy.K, policy.k)
        policy = policy._replace(slope=slope, curvature=curvature)
    slope, enough = policy.gradient, tolerance * (1 + policy.scale)
    if box is None:
        residual = jnp.max(jnp.abs(slope))
        return policy, residual, residual <= enough
    # Where a bound is met the gradient may be of any size, and how near the bound is
    # has nothing to do with that size.
    room = jnp.where(slope > 0, -box[0], box[1])
    small = jnp.abs(slope) <= enough
    met = room <= tolerance * (1 + jnp.abs(controls))
    # The step to the projection of a gradient step, zero just at a stationary point.
    step = jnp.minimum(jnp.maximum(-slope, box[0]), box[1])
    return policy, jnp.max(jnp.abs(step)), jnp.all(small | met)


def _penalty(before: Array, defects: Array | None, policy: Policy) -> Array:
    """A weight of the defects with which the step goes downhill.

    Source: Nocedal and Wright, 2006, equation 18.36.
    """
    if defects is None:
        return before
    # The merit function is cost + penalty |defects|_1. It falls along the step if
    # penalty (1 - rho) |defects|_1 covers what the model says that the cost rises, with
    # rho 0.1.
    missed = jnp.sum(jnp.abs(defects))
    rise = policy.slope + jnp.maximum(policy.curvature, 0) / 2
    least = rise / (0.9 * jnp.where(missed > 0, missed, 1))
    return jnp.where(missed > 0, jnp.maximum(before, least), before)


def _schedule(accepted: Array, mu: Array, delta: Array) -> tuple[Array, Array]:
    """The regularisation of the next iteration, and the factor it changed by.

    Source: Tassa, Erez and Todorov, 2012.
    """
    # The factor itself grows while the direction stays the same, so that many orders of
    # magnitude are crossed in a few iterations.
    down = jnp.minimum(1 / FACTOR, delta / FACTOR)
    lower = jnp.where(mu * down > LEAST_MU, mu * down, 0)
    up = jnp.maximum(FACTOR, delta * FACTOR)
    higher = jnp.maximum(LEAST_MU, mu * up)
    return jnp.where(accepted, lower, higher), jnp.where(accepted, down, up)
