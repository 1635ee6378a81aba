"""Sampling-based planners: MPPI and the cross-entropy method."""

import abc
from typing import ClassVar

import equinox as eqx
import jax
import jax.lax as lax
import jax.numpy as jnp
import jax.random as jr
from jaxtyping import Array, Float

from .._check import (
    as_entries,
    check_at_most,
    check_count,
    check_number,
    check_positive,
    check_range,
)
from .._module import parameter
from .._typing import PRNGKey
from ._plan import Plan
from ._planner import AbstractPlanner
from ._problem import Problem
from ._start import controls_of, Start


class AbstractSampler(AbstractPlanner):
    """A sampling-based planner: sequences of controls are drawn about a mean, which
    `update` moves, in each iteration. The cheapest of the means is the plan."""

    samples: eqx.AbstractVar[int]
    iterations: eqx.AbstractVar[int]
    scale: eqx.AbstractVar[Array]
    correlation: eqx.AbstractVar[Array]
    is_stochastic: ClassVar[bool] = True

    def __check_init__(self):
        where, scale = type(self).__name__, self.scale
        check_count(self.samples, "samples", where, least=2)
        check_count(self.iterations, "iterations", where)
        as_entries(scale, None, "scale", where, "control")
        check_positive(scale, "scale", where)
        check_range(self.correlation, "correlation", where, 0, 1)

    @abc.abstractmethod
    def update(
        self,
        samples: Float[Array, "samples T m"],
        costs: Float[Array, " samples"],
        mean: Float[Array, "T m"],
        width: Float[Array, "T m"],
    ) -> tuple[Float[Array, "T m"], Float[Array, "T m"]]:
        """The next mean and standard deviation.

        **Arguments:**

        - `samples`: the sequences of controls, the first of which is the mean.
        - `costs`: of their trajectories; infinite for those that diverged.
        - `mean`, `width`: those that they were drawn with.
        """

    def solve(self, problem: Problem, start: Start, key: PRNGKey | None) -> Plan:
        where, m = type(self).__name__, start.controls.shape[-1]
        if problem.constraints is not None:
            raise ValueError(
                f"{where}: constraints must be None for a planner that samples; "
                "delucax.planning.ILQR takes them."
            )
        as_entries(self.scale, m, "scale", where)
        assert key is not None
        return _search(self, problem, start, key)


def _draw(key: PRNGKey, correlation: Array, count: int, like: Array) -> Array:
    """Standard normal sequences, shape `(count, T, m)`; the first one is zero."""
    T, m = like.shape
    fresh = jr.normal(key, (T, count - 1, m), like.dtype)
    # An autoregression of order one, v_k = rho v_{k-1} + sqrt(1 - rho^2) e_k, whose
    # variance stays 1. sqrt(1 - rho^2) is not differentiable at rho = 1.
    rest = jnp.maximum(1 - correlation**2, jnp.finfo(like.dtype).eps)

    def follow(before, now):
        after = correlation * before + jnp.sqrt(rest) * now
        return after, after

    _, later = lax.scan(follow, fresh[0], fresh[1:])
    noise = jnp.swapaxes(jnp.concatenate([fresh[:1], later]), 0, 1)
    return jnp.concatenate([jnp.zeros((1, T, m), like.dtype), noise])


@eqx.filter_jit
def _search(
    planner: AbstractSampler, problem: Problem, start: Start, key: PRNGKey
) -> Plan:
    controls = controls_of(start)
    if start.gains is not None or start.count > 1:
        controls = start.cheapest(problem)[2]
    T, m = controls.shape
    cost_of = lambda controls: problem.roll_out(controls)[2]

    def better(best, *now):
        return jax.tree.map(lambda a, b: jnp.where(now[1] < best[1], a, b), now, best)

    def body(carry, key):
        mean, width, best, _ = carry
        noise = _draw(key, correlation, planner.samples, mean)
        # Clipped before they are weighed, so that the mean is of controls that act.
        samples = jax.vmap(jax.vmap(problem.clip))(mean + width * noise)
        costs = jax.vmap(cost_of)(samples)
        # The first sequence is the mean itself: its cost comes with the others.
        best = better(best, samples[0], costs[0])
        # A mean of clipped controls is within the bounds, because a box is convex.
        after, width = planner.update(samples, costs, mean, width)
        moved = jnp.max(jnp.abs(after - mean))
        return (after, width, best, moved), best[1]

    correlation = planner.correlation.astype(controls.dtype)
    width = jnp.broadcast_to(planner.scale, (m,)).astype(controls.dtype)
    mean = jax.vmap(problem.clip)(controls)
    infinite = jnp.full((), jnp.inf, mean.dtype)
    first = mean, jnp.broadcast_to(width, (T, m)), (mean, infinite), infinite
    keys = jr.split(key, planner.iterations)
    (mean, _, best, moved), trace = lax.scan(body, first, keys)
    best = better(best, mean, cost_of(mean))
    states, planned, cost = problem.roll_out(best[0])
    return problem.plan(
        states,
        planned,
        cost,
        trace=jnp.concatenate([trace, cost[None]]),
        residual=moved,
        iterations=jnp.asarray(planner.iterations),
        rollouts=jnp.asarray(planner.samples * planner.iterations + 1),
    )


def average(weights: Array, samples: Array, otherwise: Array) -> Array:
    """The weighted mean of the samples; `otherwise` if all weights are zero."""
    total = jnp.sum(weights)
    # Of a `where` both branches are differentiated: 0/0 in the one that is not taken
    # would make the gradient NaN.
    safe = jnp.where(total > 0, total, 1)
    mean = jnp.einsum("s,s...->...", weights / safe, samples)
    return jnp.where(total > 0, mean, otherwise)


class MPPI(AbstractSampler):
    r"""Controls by sampling, for costs and dynamics that need not be smooth:

    `u_k <- sum over i of v_i u_k^i`, with `v_i` proportional to
    `exp(-cost^i / temperature)`, over sequences `u^i` drawn about the present one.

    This is model predictive path integral control. The cost of a sequence is the whole
    cost of its trajectory, without a further charge for leaving the present one. A
    sequence that diverges has no weight. The plan is the best of the means, the start
    among them, so it costs no more than the start. It has no gains. It is
    differentiable in whatever the costs are, for the numbers that were drawn.

    It is called as every [`delucax.planning.AbstractPlanner`][], with a `key`, and
    without constraints. Its result is `diverged` if the start and all means diverge.

    **Arguments:**

    - `samples`: sequences drawn in an iteration, 256 by default.
    - `iterations`: 10 by default.
    - `scale`: the standard deviation of the controls drawn, a number or of shape
        `(m,)`; 1 by default.
    - `correlation`: of a control drawn with the one before it, from 0, white noise, by
        default, to 1, a constant.
    - `temperature`: in the unit of the cost, 1 by default. The lower it is, the fewer
        of the best sequences count.

    **Raises:** `ValueError` on an option out of its range.

    Source: Williams, Wagener, Goldfain, Drews, Rehg, Boots and Theodorou, 2017.

    !!! example

        ```python
        import delucax as dlx
        import jax
        import jax.numpy as jnp

        env = dlx.make("pendulum")
        planner = dlx.planning.MPPI(temperature=0.1, correlation=0.8)
        plan = planner(
            env.dynamics, env.cost, jnp.array([0.5, 0.0]), 20, key=jax.random.key(0)
        )
        plan.cost
        ```
    """

    samples: int = eqx.field(default=256, static=True)
    iterations: int = eqx.field(default=10, static=True)
    scale: Array = parameter(1.0)
    correlation: Array = parameter(0.0)
    temperature: Array = parameter(1.0)

    def __check_init__(self):
        check_number(self.temperature, "temperature", "MPPI")
        check_positive(self.temperature, "temperature", "MPPI")

    def update(
        self,
        samples: Float[Array, "samples T m"],
        costs: Float[Array, " samples"],
        mean: Float[Array, "T m"],
        width: Float[Array, "T m"],
    ) -> tuple[Float[Array, "T m"], Float[Array, "T m"]]:
        # The softmax of -cost / temperature. The least cost is taken off first, so that
        # the exponentials do not underflow all together.
        finite, least = jnp.isfinite(costs), jnp.min(costs)
        least = jnp.where(jnp.isfinite(least), least, 0)
        above = jnp.where(finite, costs, least) - least
        temperature = self.temperature.astype(mean.dtype)
        weights = jnp.where(finite, jnp.exp(-above / temperature), 0)
        return average(weights, samples, mean), width


class CEM(AbstractSampler):
    r"""Controls by sampling, for costs and dynamics that need not be smooth: the
    cross-entropy method.

    Sequences are drawn with a mean and a standard deviation for each control of each
    step, and both move to those of the cheapest sequences, the elites:

    `mean <- momentum mean + (1 - momentum) mean of the elites`, and likewise the
    standard deviation.

    A sequence that diverges is no elite. The plan, its result and the call are as with
    [`delucax.planning.MPPI`][]. The derivatives are those of the elites that were
    drawn; which ones those are is held.

    **Arguments:**

    - `samples`, `iterations`, `correlation`: as in [`delucax.planning.MPPI`][].
    - `elites`: how many of the sequences count, 32 by default.
    - `scale`: the standard deviation to start with, a number or of shape `(m,)`; 1 by
        default.
    - `momentum`: how much stays of mean and standard deviation, 0.1 by default.

    **Raises:** `ValueError` on an option out of its range, or more elites than samples.

    Source: Rubinstein, 1999; Chua, Calandra, McAllister and Levine, 2018 (planning).

    !!! example

        ```python
        import delucax as dlx
        import jax
        import jax.numpy as jnp

        env, key = dlx.make("pendulum"), jax.random.key(0)
        planner = dlx.planning.CEM(samples=64, elites=8)
        planner(env.dynamics, env.cost, jnp.array([0.5, 0.0]), 20, key=key).cost
        ```
    """

    samples: int = eqx.field(default=256, static=True)
    iterations: int = eqx.field(default=10, static=True)
    elites: int = eqx.field(default=32, static=True)
    scale: Array = parameter(1.0)
    correlation: Array = parameter(0.0)
    momentum: Array = parameter(0.1)

    def __check_init__(self):
        where = "CEM"
        check_count(self.elites, "elites", where)
        check_at_most(self.elites, self.samples, "elites", where, "samples")
        check_number(self.momentum, "momentum", where)
        check_range(self.momentum, "momentum", where, 0, 1)

    def update(
        self,
        samples: Float[Array, "samples T m"],
        costs: Float[Array, " samples"],
        mean: Float[Array, "T m"],
        width: Float[Array, "T m"],
    ) -> tuple[Float[Array, "T m"], Float[Array, "T m"]]:
        # Which sequences are the elites is piecewise constant in the costs, and a
        # derivative through infinite ones would be NaN.
        _, best = lax.top_k(-lax.stop_gradient(costs), self.elites)
        weights = jnp.isfinite(costs[best]).astype(mean.dtype)
        centre = average(weights, samples[best], mean)
        variance = average(weights, (samples[best] - centre) ** 2, width**2)
        # The square root has an infinite slope at zero, where all elites agree.
        spreads = variance > 0
        after = jnp.where(spreads, jnp.sqrt(jnp.where(spreads, variance, 1)), 0)
        momentum = self.momentum.astype(mean.dtype)
        blend = lambda old, new: momentum * old + (1 - momentum) * new
        return blend(mean, centre), blend(width, after)
