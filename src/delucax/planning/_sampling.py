"""What planners that sample have in common."""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.lax as lax
import jax.numpy as jnp
import jax.random as jr
from jaxtyping import Array

from .._check import check_count, check_key, check_positive, check_range
from .._message import shortened
from .._module import as_float_array
from .._results import choose, RESULTS
from ._plan import Plan
from ._problem import Problem, roll_out
from ._start import begin, controls_of, count_of, Start


class Samples(NamedTuple):
    """What is fixed when a planner is compiled."""

    count: int
    iterations: int


class Spread(NamedTuple):
    """How the controls are drawn: how far, and how slowly they change."""

    scale: Array  # (m,)
    correlation: Array


def as_samples(samples: Any, iterations: Any, where: str) -> Samples:
    """The numbers of samples and iterations, checked."""
    count = check_count(samples, "samples", where, least=2)
    return Samples(count, check_count(iterations, "iterations", where))


def as_spread(
    scale: Any, correlation: Any, controls: Array, key: Any, where: str
) -> Spread:
    """Scale and correlation, checked; the key too."""
    check_key(key, where)
    scale, m = as_float_array(scale), controls.shape[1]
    if not eqx.is_inexact_array(scale) or scale.shape not in ((), (m,)):
        got = f"shape {scale.shape}" if eqx.is_array(scale) else shortened(scale)
        raise ValueError(
            f"{where}: scale must be a number or a vector of {m} entries, one for each "
            f"control, got {got}."
        )
    check_positive(scale, "scale", where)
    check_range(correlation, "correlation", where, 0, 1)
    scale = jnp.broadcast_to(scale, (m,)).astype(controls.dtype)
    return Spread(scale, jnp.asarray(correlation, controls.dtype))


def draw(key: Array, spread: Spread, count: int, like: Array) -> Array:
    """Standard normal sequences, shape `(count, T, m)`; the first one is zero."""
    T, m = like.shape
    fresh = jr.normal(key, (T, count - 1, m), like.dtype)
    rho = spread.correlation
    # 1 - rho^2 has no slope at rho = 1 that a square root could bear.
    rest = jnp.maximum(1 - rho**2, jnp.finfo(like.dtype).eps)

    def follow(before, now):
        after = rho * before + jnp.sqrt(rest) * now
        return after, after

    _, later = lax.scan(follow, fresh[0], fresh[1:])
    noise = jnp.swapaxes(jnp.concatenate([fresh[:1], later]), 0, 1)
    return jnp.concatenate([jnp.zeros((1, T, m), like.dtype), noise])


def search(
    problem: Problem,
    start: Start,
    key: Array,
    spread: Spread,
    samples: Samples,
    width: Array,
    update: Callable[[Array, Array, Array, Array], tuple[Array, Array]],
) -> Plan:
    """Draw about a mean, move the mean, and so on; the cheapest mean is the plan.

    `update(tried, costs, mean, width)` gives the next mean and width. The costs of what
    diverged are infinite.
    """
    controls = controls_of(start)
    if start.gains is not None or count_of(start) > 1:
        controls = begin(problem, start)[2]
    T, m = controls.shape
    still = jnp.broadcast_to(problem.x0, (T + 1, *problem.x0.shape))

    def cost_of(controls):
        return roll_out(problem, still, controls, None, None, 0.0, None)[2]

    def better(best, mean, cost):
        lower = cost < best[1]
        keep = lambda new, old: jnp.where(lower, new, old)
        return keep(mean, best[0]), keep(cost, best[1])

    def body(carry, key):
        mean, width, best, _ = carry
        noise = draw(key, spread, samples.count, mean)
        tried = jax.vmap(jax.vmap(problem.clip))(mean + width * noise)
        costs = jax.vmap(cost_of)(tried)
        best = better(best, tried[0], costs[0])
        after, width = update(tried, costs, mean, width)
        moved = jnp.max(jnp.abs(after - mean))
        return (after, width, best, moved), best[1]

    mean = jax.vmap(problem.clip)(controls)
    infinite = jnp.full((), jnp.inf, mean.dtype)
    first = (mean, width, (mean, infinite), infinite)
    keys = jr.split(key, samples.iterations)
    (mean, _, best, moved), trace = lax.scan(body, first, keys)
    best = better(best, mean, cost_of(mean))
    states, planned, cost = roll_out(problem, still, best[0], None, None, 0.0, None)
    good = jnp.isfinite(cost)
    zero = jnp.zeros((), mean.dtype)
    return Plan(
        states=states,
        controls=planned,
        gains=jnp.zeros((T, m, problem.x0.shape[0]), mean.dtype),
        cost=cost,
        trace=jnp.concatenate([trace, cost[None]]),
        residual=moved,
        violation=zero,
        result=choose(good, RESULTS.successful, RESULTS.diverged),
        iterations=jnp.asarray(samples.iterations),
        rollouts=jnp.asarray(samples.count * samples.iterations + 1),
        regularisation=zero,
        t0=problem.t0,
        dt=problem.dynamics.dt,
        low=problem.low,
        high=problem.high,
        difference=problem.difference,
    )


def above_least(costs: Array) -> tuple[Array, Array]:
    """The costs over the least one, zero where they are infinite; which are finite."""
    finite = jnp.isfinite(costs)
    least = jnp.min(costs)
    least = jnp.where(jnp.isfinite(least), least, 0)
    return jnp.where(finite, costs, least) - least, finite


def average(weights: Array, tried: Array, otherwise: Array) -> Array:
    """The weighted mean of what was tried; `otherwise` if all weights are zero."""
    total = jnp.sum(weights)
    safe = jnp.where(total > 0, total, 1)
    mean = jnp.einsum("s,s...->...", weights / safe, tried)
    return jnp.where(total > 0, mean, otherwise)
