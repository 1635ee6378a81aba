"""The iteration of iterative LQR and of differential dynamic programming."""

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
from ._problem import Augmentation, Problem, roll_out
from ._start import Start


SEARCHES = ("parallel", "backtracking")
HALVINGS = 12
"""The line search tries 12 steps; the shortest is 2^-11 of the full step."""
LEAST_SHARE = 1e-4
"""The Armijo constant: the least share of the predicted decrease."""
FACTOR = 2.0
"""The first factor by which the regularisation changes."""
LEAST_MU = 1e-6
"""A smaller regularisation is set to zero."""
MOST_MU = 1e10
"""The iteration gives up at a larger regularisation."""


class Options(eqx.Module):
    """The fields of `ILQR` with their defaults filled in."""

    tolerance: Array
    constraint_tolerance: Array
    states: Array | None
    """States to start from, which need not follow from the controls."""
    penalty: Array
    """The first weight of squared violations."""
    second_order: bool = eqx.field(static=True)
    regularise: str = eqx.field(static=True)
    line_search: str = eqx.field(static=True)
    parallel: bool = eqx.field(static=True)
    max_iterations: int = eqx.field(static=True)
    finite_difference: float | None = eqx.field(static=True)


class Outcome(NamedTuple):
    """An iterate with its status. The last one is the outcome."""

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
    multipliers: Augmentation | None = None


class _Progress(NamedTuple):
    """The state of the loop."""

    now: Outcome
    policy: Policy
    """The policy of the model about `now`."""
    defects: Array | None
    """By how much each step misses the next state; `None` without `options.states`."""
    delta: Array
    """The factor by which the regularisation last changed."""
    exact: Array
    """Whether the model has second derivatives of the dynamics."""
    penalty: Array
    """The weight of the defects in the merit function."""
    rounding: Array
    """By how much rounding may change the cost."""
    negligible: Array
    """Whether the decrease that `policy` predicts is below `rounding`."""
    events: "Events"
    started: Array
    """Whether the starts have been compared."""
    done: Array


class Events(NamedTuple):
    """The events of a hybrid plant that the line searches saw; `None` for other plants.

    - `counts`: the number of events in each step of `now`, shape `(T,)`; -1 if it is
        not known.
    - `changed`: whether a candidate had other numbers of events. It is reset by an
        accepted step without regularisation whose search saw no such candidate.
    """

    counts: Array | None
    changed: Array | None

    def differ(self, counts: Array | None) -> Array | None:
        """Whether a candidate with these `counts` has other events."""
        if self.counts is None or counts is None:
            return None
        return jnp.any((counts != self.counts) & (self.counts >= 0))


def optimise(
    problem: Problem,
    starts: Start,
    count: Array | int,
    options: Options,
    before: Outcome | None = None,
) -> Outcome:
    """Iterate from the cheapest of the first `count` stacked starts.

    If the options have states, iterate from them and the controls of the first start.
    If `before` is given, continue its trace and its counts.
    """
    _, T, m = starts.controls.shape
    n, dtype = problem.x0.shape[0], problem.x0.dtype
    zero, infinite = jnp.zeros((), dtype), jnp.full((), jnp.inf, dtype)
    states, defects = jnp.broadcast_to(problem.x0, (T + 1, n)), None
    controls, cost = jax.vmap(problem.clip)(starts.controls[0]), infinite
    if options.states is not None:
        count = 0
        states = options.states.at[0].set(problem.x0)
        inputs = problem.times(T)[:-1], states[:-1], controls, problem.w
        reached = jax.vmap(problem.step)(*inputs)
        defects = jax.vmap(problem.deviation)(reached, states[1:])
        cost = problem.total(states, controls)
        good = jnp.isfinite(cost) & jnp.all(jnp.isfinite(defects))
        cost = jnp.where(good, cost, jnp.inf)
    now = Outcome(
        states=states,
        controls=controls,
        gains=jnp.zeros((T, m, n), dtype),
        cost=cost,
        residual=infinite,
        trace=jnp.zeros(options.max_iterations + 1, dtype),
        result=RESULTS.not_converged,
        iterations=jnp.zeros((), int),
        rollouts=jnp.zeros((), int),
        regularisation=zero,
    )
    if before is not None:
        now = now._replace(
            trace=before.trace, iterations=before.iterations, rollouts=before.rollouts
        )
    no, nothing = jnp.asarray(False), jnp.zeros_like(controls)
    policy = Policy(now.gains, nothing, nothing, zero, zero, zero, no)
    events = Events(None, None)
    if problem.dynamics.event_names:
        events = Events(jnp.full(T, -1), no)
    first = _Progress(
        now, policy, defects, zero + 1, ~no, zero, zero, no, events, no, no
    )
    body = functools.partial(_iterate, problem, options, starts, count)
    now = lax.while_loop(lambda progress: ~progress.done, body, first).now
    counts = jnp.arange(options.max_iterations + 1)
    return now._replace(
        trace=jnp.where(counts <= now.iterations, now.trace, now.cost),
        violation=zero,
        multipliers=problem.multipliers,
    )


def _iterate(
    problem: Problem,
    options: Options,
    starts: Start,
    count: Array | int,
    before: _Progress,
) -> _Progress:
    """One line search, and the model about the trajectory that it found.

    The first iteration compares the starts instead, in the same code, so that only one
    roll-out is compiled.
    """
    now, started, tolerance = before.now, before.started, options.tolerance
    searched = _searched(problem, options, starts, count, before)
    (states, controls, cost, defects), accepted, tried, events = searched
    lost = ~started & ~jnp.isfinite(cost)
    # Fall back to Gauss-Newton if the exact Hessian is indefinite or its search failed.
    flatten = ~accepted & before.exact & options.second_order
    mu, delta = now.regularisation, before.delta
    changed = _schedule(accepted, mu, delta)
    keep = lambda old, new: jnp.where(flatten | ~started, old, new)
    mu, delta = jax.tree.map(keep, (mu, delta), changed)
    exact = jnp.where(flatten & started, False, before.exact | accepted)
    stuck = mu > MOST_MU
    failed = lost | stuck
    iteration = now.iterations + started
    about = problem, states, controls, defects, options.second_order
    stages = model(*about, exact, options.finite_difference)
    policy, residual, settled = directions(problem, stages, controls, mu, options)
    missed = 0.0 if defects is None else jnp.max(jnp.abs(defects))
    closed = missed <= tolerance * (1 + jnp.max(jnp.abs(states)))
    # Rounding may change the cost itself, and the states and controls that it depends
    # on. The second part is larger if the targets are far from zero.
    z = jnp.concatenate([states[:-1], controls], axis=1)
    terms = jnp.sum(jnp.abs(stages.h * z))
    terms = terms + jnp.sum(jnp.abs(stages.v * states[-1]))
    rounding = jnp.finfo(z.dtype).eps * (jnp.abs(cost) + terms)
    # If the predicted decrease is below rounding, full steps may still lower the
    # gradient. When they no longer do, the iteration has converged. `before.negligible`
    # counts too, because a larger gradient may lift the prediction above rounding.
    predicted = -policy.slope - policy.curvature / 2
    negligible = (jnp.abs(predicted) <= rounding) & (mu == 0) & (tolerance > 0)
    spent = negligible | (before.negligible & accepted)
    spent = spent & (residual >= now.residual)
    converged = policy.ok & closed & (settled | spent) & ~failed
    result = choose(converged, RESULTS.successful, RESULTS.not_converged)
    result = choose(stuck, RESULTS.no_descent, result)
    if events.changed is not None:
        result = choose(events.changed & ~converged, RESULTS.events_changed, result)
    after = now._replace(
        states=states,
        controls=controls,
        gains=jnp.where(policy.ok & ~failed, policy.K, now.gains),
        cost=cost,
        residual=jnp.where(failed, now.residual, residual),
        trace=now.trace.at[iteration].set(cost),
        result=choose(lost, RESULTS.diverged, result),
        iterations=iteration,
        rollouts=now.rollouts + tried,
        regularisation=mu,
    )
    penalty = _penalty(before.penalty, defects, policy)
    done = failed | converged | (iteration >= options.max_iterations)
    changing = delta, exact, penalty, rounding, negligible, events
    return _Progress(after, policy, defects, *changing, jnp.ones_like(started), done)


def _searched(problem, options, starts, count, before: _Progress):
    """Backtracking line search. Before the first iteration it compares the starts.

    Returns the states, controls, cost and defects after the longest step of sufficient
    decrease (or of the cheapest start), unchanged if no step is accepted; whether one
    is accepted; the number of trials; and the events.

    The merit function is the cost plus `penalty` times the sum of the defects.
    """
    now, policy, defects = before.now, before.policy, before.defects
    events = before.events
    missed = 0.0 if defects is None else jnp.sum(jnp.abs(defects))
    # A step that is worse only by rounding is accepted. Otherwise the search would fail
    # near the minimum.
    slack = before.rounding + 10 * jnp.finfo(now.cost.dtype).eps * jnp.abs(now.cost)
    # Without a policy there is nothing to search along.
    halvings = jnp.where(policy.ok, HALVINGS, 0)
    number = jnp.where(before.started, halvings, count)
    length_of = lambda i: 0.5 ** i.astype(now.cost.dtype)

    def trial(i):
        """The rank of a trajectory (the lowest is taken), the trajectory, and whether
        it has other events."""
        # Before the first iteration `policy.k` is zero: a start is followed unchanged.
        own = now.states, now.controls, policy.K
        given = starts.states, starts.controls, starts.gains
        pick = lambda own, given: jnp.where(before.started, own, given[i])
        length = length_of(i)
        xs, us, K = jax.tree.map(pick, own, given)
        along = xs, us, K, policy.k, length, defects
        path = roll_out(problem, *along, count_events=True)
        *_, cost, counts = path
        # The model predicts a decrease of -(a slope + a^2 curvature / 2) for a step of
        # length a. This step also closes the share a of the defects.
        curvature = length * policy.curvature / 2
        predicted = length * (before.penalty * missed - policy.slope - curvature)
        decrease = now.cost - cost + length * before.penalty * missed
        enough = decrease >= LEAST_SHARE * predicted - slack
        enough = enough & jnp.isfinite(cost)
        rank = jnp.where(enough, i.astype(cost.dtype), jnp.inf)
        return jnp.where(before.started, rank, cost), path, events.differ(counts)

    if options.line_search == "parallel":
        most = jnp.arange(max(HALVINGS, starts.count))
        ranks, candidates, others = jax.vmap(trial)(most)
        best = jnp.argmin(jnp.where(most < number, ranks, jnp.inf))
        rank, candidate = jax.tree.map(lambda a: a[best], (ranks, candidates))
        rank, tried = jnp.where(best < number, rank, jnp.inf), number
        other = others if others is None else jnp.any(others & (most < number))
    else:

        def body(carry):
            i, best, rank, candidate, other = carry
            new, path, differs = trial(i)
            lower = (new < rank) | (i == 0)
            keep = lambda new, old: jnp.where(lower, new, old)
            other = None if differs is None else other | differs
            kept = (i, new, path), (best, rank, candidate)
            return i + 1, *jax.tree.map(keep, *kept), other

        # Steps are tried until one is accepted, but all starts are compared.
        going = lambda carry: (
            (carry[0] < number) & ~(before.started & jnp.isfinite(carry[2]))
        )
        index = jnp.zeros((), int)
        last = now.states, now.controls, now.cost, events.counts
        none = None if events.changed is None else jnp.zeros_like(events.changed)
        nothing = index, index, jnp.full_like(now.cost, jnp.inf), last, none
        tried, best, rank, candidate, other = lax.while_loop(going, body, nothing)
    accepted = jnp.isfinite(rank)
    # If all starts diverge, keep the first one, because the error describes it.
    keep = lambda new, old: jnp.where(
        accepted | (~before.started & (number > 0)), new, old
    )
    last = now.states, now.controls, now.cost, events.counts
    states, controls, cost, counts = jax.tree.map(keep, candidate, last)
    # The controls along a diverged start may be NaN; the given ones are finite.
    controls = jnp.where(accepted, controls, now.controls)
    if defects is not None:
        left = (1 - length_of(best)) * defects
        defects = jnp.where(accepted, left, defects)
    if events.changed is not None and other is not None:
        full = accepted & (now.regularisation == 0)
        other = before.started & (other | events.changed & ~full)
    return (states, controls, cost, defects), accepted, tried, Events(counts, other)


def first_accepted(
    trial: Callable[[Array], tuple[Any, Array]], count: Array | int, otherwise: Any
) -> tuple[Array, Any, Array]:
    """Try the candidates `0, ..., count - 1` in turn until `trial` accepts one.

    Returns the number of trials, the last candidate, and whether it was accepted. If
    `count` is zero, the candidate is `otherwise`, which has the same structure.
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
    """The policy of the model, the residual, and whether it is small enough."""
    box, tolerance = problem.room(controls), options.tolerance
    if options.parallel:
        policy = in_parallel(stages, mu)
    else:
        policy = in_sequence(stages, mu, options.regularise == "state", box)
    if stages.d is not None:
        # The slope and curvature of the backward pass are only valid without defects.
        slope, curvature = predicted_change(stages, policy.K, policy.k)
        policy = policy._replace(slope=slope, curvature=curvature)
    slope, enough = policy.gradient, tolerance * (1 + policy.scale)
    if box is None:
        residual = jnp.max(jnp.abs(slope))
        return policy, residual, residual <= enough
    # At a bound the gradient may have any size. The distance to the bound is therefore
    # compared with the control, not with the gradient.
    room = jnp.where(slope > 0, -box[0], box[1])
    small = jnp.abs(slope) <= enough
    met = room <= tolerance * (1 + jnp.abs(controls))
    # The projected gradient step is zero exactly at a stationary point.
    step = jnp.minimum(jnp.maximum(-slope, box[0]), box[1])
    return policy, jnp.max(jnp.abs(step)), jnp.all(small | met)


def _penalty(before: Array, defects: Array | None, policy: Policy) -> Array:
    """A weight of the defects for which the merit function falls along the step.

    Source: Nocedal and Wright, 2006, equation 18.36.
    """
    if defects is None:
        return before
    # The merit function is cost + penalty |defects|_1. It falls along the step if
    # penalty (1 - rho) |defects|_1, with rho = 0.1, exceeds the predicted rise of the
    # cost.
    missed = jnp.sum(jnp.abs(defects))
    rise = policy.slope + jnp.maximum(policy.curvature, 0) / 2
    least = rise / (0.9 * jnp.where(missed > 0, missed, 1))
    return jnp.where(missed > 0, jnp.maximum(before, least), before)


def _schedule(accepted: Array, mu: Array, delta: Array) -> tuple[Array, Array]:
    """The regularisation of the next iteration, and the factor by which it changed.

    Source: Tassa, Erez and Todorov, 2012.
    """
    # The factor grows while the direction stays the same, so that the regularisation
    # crosses many orders of magnitude in a few iterations.
    down = jnp.minimum(1 / FACTOR, delta / FACTOR)
    lower = jnp.where(mu * down > LEAST_MU, mu * down, 0)
    up = jnp.maximum(FACTOR, delta * FACTOR)
    higher = jnp.maximum(LEAST_MU, mu * up)
    return jnp.where(accepted, lower, higher), jnp.where(accepted, down, up)
