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
    """Base class of planners that sample. Each iteration draws sequences of controls
    about a mean, and `update` moves the mean. The plan is the cheapest mean."""

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
        """The mean and the standard deviation of the next iteration.

        **Arguments:**

        - `samples`: the sequences of controls; the first one is the mean.
        - `costs`: the costs of their trajectories; infinite if a trajectory diverged.
        - `mean`: the mean of the samples.
        - `width`: the standard deviation of the samples.
        """

    def solve(self, problem: Problem, start: Start, key: PRNGKey | None) -> Plan:
        where, m = type(self).__name__, start.controls.shape[-1]
        if problem.constraints is not None:
            raise ValueError(
                f"{where}: constraints must be None, because a planner that samples "
                "takes none. Use `delucax.planning.ILQR` or `delucax.planning.SQP`."
            )
        as_entries(self.scale, m, "scale", where)
        assert key is not None
        return _search(self, problem, start, key)


def _draw(key: PRNGKey, correlation: Array, count: int, like: Array) -> Array:
    """Standard normal sequences, shape `(count, T, m)`. The first sequence is zero."""
    T, m = like.shape
    fresh = jr.normal(key, (T, count - 1, m), like.dtype)
    # An autoregression of order one, v_k = rho v_{k-1} + sqrt(1 - rho^2) e_k, keeps the
    # variance at 1. The root is not differentiable at rho = 1, hence the least value.
    rest = jnp.maximum(1 - correlation**2, jnp.finfo(like.dtype).eps)

    def follow(before, now):
        after = correlation * before + jnp.sqrt(rest) * now
        return after, after

    _, later = lax.scan(follow, fresh[0], fresh[1:])
    noise = jnp.swapaxes(jnp.concatenate([fresh[:1], later]), 0, 1)
    return jnp.concatenate([jnp.zeros((1, T, m), like.dtype), noise])


@eqx.filter_custom_jvp
def _cost_of(problem: Problem, controls: Float[Array, "T m"]) -> Float[Array, ""]:
    """The cost of a sequence of controls. Where it is infinite, its derivative is zero,
    because the sequence has no weight."""
    return problem.roll_out(controls)[2]


@_cost_of.def_jvp
def _slope_of(primals, tangents):
    (problem, controls), whole = primals, lambda p, u: p.roll_out(u)[2]
    good = jnp.isfinite(whole(problem, controls))
    # The tangents are masked, not only their result: in reverse mode the states of a
    # sequence that diverged would make NaN of a zero.
    masked = jax.tree.map(lambda t: jnp.where(good, t, 0), tangents)
    cost, slope = eqx.filter_jvp(whole, primals, masked)
    slope = jnp.zeros_like(cost) if slope is None else slope
    return cost, jnp.where(good, slope, 0)


@eqx.filter_jit
def _search(
    planner: AbstractSampler, problem: Problem, start: Start, key: PRNGKey
) -> Plan:
    controls = controls_of(start)
    if start.gains is not None or start.count > 1:
        controls = start.cheapest(problem)[2]
    T, m = controls.shape
    cost_of = lambda controls: _cost_of(problem, controls)

    def better(best, *now):
        return jax.tree.map(lambda a, b: jnp.where(now[1] < best[1], a, b), now, best)

    def body(carry, key):
        mean, width, best, _ = carry
        noise = _draw(key, correlation, planner.samples, mean)
        # Clip first, so that the mean is one of the controls that were applied. It is
        # then within the bounds, because a box is convex.
        samples = jax.vmap(jax.vmap(problem.clip))(mean + width * noise)
        costs = jax.vmap(cost_of)(samples)
        # The first sequence is the mean.
        best = better(best, samples[0], costs[0])
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
    # `where` differentiates both branches, so that 0/0 would make the gradient NaN.
    safe = jnp.where(total > 0, total, 1)
    mean = jnp.einsum("s,s...->...", weights / safe, samples)
    return jnp.where(total > 0, mean, otherwise)


class MPPI(AbstractSampler):
    r"""Model predictive path integral control (MPPI): plan by sampling.

    The cost and the dynamics need not be smooth.

    Each iteration draws sequences $u^i$ of controls about the current mean $u$, and
    moves the mean to their weighted average:

    $$u_k \leftarrow \frac{\sum_i v_i\, u_k^i}{\sum_i v_i}, \qquad
    v_i = e^{-J^i / \lambda}$$

    where $J^i$ is the cost of the trajectory of sequence $i$, and $\lambda$ the
    temperature. The cost $J^i$ contains no penalty on the distance of $u^i$ from the
    mean $u$. If the trajectory of a sequence diverges, the weight of the sequence is
    zero.

    The plan is the cheapest among the initial controls and the means of all iterations.
    So the plan costs at most as much as the initial controls. Its gains are zero. You
    can differentiate the plan with respect to everything that the costs depend on. When
    you differentiate the plan, the random numbers stay fixed.

    Call the planner like every [`delucax.planning.AbstractPlanner`][], and pass a
    random `key`. MPPI takes no constraints. The result is `diverged` if the
    trajectories under the initial controls and under all means diverge.

    **Arguments:**

    - `samples`: the number of sequences in each iteration; 256 by default.
    - `iterations`: the number of iterations; 10 by default.
    - `scale`: the standard deviation of the samples, a number or an array of shape
        `(m,)`, in the unit of the control; 1 by default.
    - `correlation`: the correlation between the sampled controls of two successive
        steps, from 0 (white noise, the default) to 1 (constant).
    - `temperature`: the temperature $\lambda$, in the unit of the cost; 1 by default.
        With a lower temperature, the average depends on fewer sequences, the cheapest
        ones.

    **Raises:** `ValueError` if an option is out of its range.

    Source: Williams, Wagener, Goldfain, Drews, Rehg, Boots and Theodorou, 2017.

    !!! example

        ```python
        import delucax as dlx
        import jax
        import jax.numpy as jnp

        env = dlx.make("pendulum")
        planner = dlx.planning.MPPI(temperature=0.1, correlation=0.8)
        x0, start = jnp.array([0.5, 0.0]), jnp.zeros((20, 1))
        plan = planner(env.dynamics, env.cost, x0, start, key=jax.random.key(0))
        plan.trace[0], plan.cost
        ```

        ```text
        (Array(111.5, dtype=float32), Array(1.96, dtype=float32))
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
        # A softmax of -cost / temperature. Without subtracting the least cost, all
        # exponentials may underflow.
        finite, least = jnp.isfinite(costs), jnp.min(costs)
        least = jnp.where(jnp.isfinite(least), least, 0)
        above = jnp.where(finite, costs, least) - least
        temperature = self.temperature.astype(mean.dtype)
        weights = jnp.where(finite, jnp.exp(-above / temperature), 0)
        return average(weights, samples, mean), width


class CEM(AbstractSampler):
    r"""The cross-entropy method (CEM): plan by sampling.

    The cost and the dynamics need not be smooth.

    Each iteration draws sequences of controls with a mean $\mu_k$ and a standard
    deviation $\sigma_k$ at each step. Both move towards the mean
    $\mu_k^\mathrm{elite}$ and the standard deviation $\sigma_k^\mathrm{elite}$ of the
    cheapest sequences, the elites:

    $$\mu_k \leftarrow \beta \mu_k + (1 - \beta)\, \mu_k^\mathrm{elite}, \qquad
    \sigma_k \leftarrow \beta \sigma_k + (1 - \beta)\, \sigma_k^\mathrm{elite}$$

    where $\beta$ is the momentum. If the trajectory of a sequence diverges, the
    sequence has no weight in the mean and the standard deviation of the elites.

    Call it like [`delucax.planning.MPPI`][]. The plan and its `result` are defined as
    for [`delucax.planning.MPPI`][]. When you differentiate the plan, the random numbers
    and the choice of the elites stay fixed.

    **Arguments:**

    - `samples`: the number of sequences in each iteration; 256 by default.
    - `iterations`: the number of iterations; 10 by default.
    - `elites`: the number of elites; 32 by default.
    - `scale`: the standard deviation in the first iteration, a number or an array of
        shape `(m,)`, in the unit of the control; 1 by default.
    - `correlation`: the correlation between the sampled controls of two successive
        steps, from 0 (white noise, the default) to 1 (constant).
    - `momentum`: the momentum $\beta$, from 0 to 1; 0.1 by default.

    **Raises:** `ValueError` if an option is out of its range, or there are more elites
    than samples.

    Source: Rubinstein, 1999; Chua, Calandra, McAllister and Levine, 2018 (planning).

    !!! example

        ```python
        import delucax as dlx
        import jax
        import jax.numpy as jnp

        env = dlx.make("pendulum")
        planner = dlx.planning.CEM(samples=64, elites=8)
        x0, start = jnp.array([0.5, 0.0]), jnp.zeros((20, 1))
        plan = planner(env.dynamics, env.cost, x0, start, key=jax.random.key(0))
        plan.trace[0], plan.cost
        ```

        ```text
        (Array(111.5, dtype=float32), Array(3.41, dtype=float32))
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
        # No derivative through the costs, because the choice of the elites is piecewise
        # constant. A derivative through infinite costs would be NaN.
        _, best = lax.top_k(-lax.stop_gradient(costs), self.elites)
        weights = jnp.isfinite(costs[best]).astype(mean.dtype)
        centre = average(weights, samples[best], mean)
        variance = average(weights, (samples[best] - centre) ** 2, width**2)
        # If all elites agree, the variance is zero, where the root has no derivative.
        spreads = variance > 0
        after = jnp.where(spreads, jnp.sqrt(jnp.where(spreads, variance, 1)), 0)
        momentum = self.momentum.astype(mean.dtype)
        blend = lambda old, new: momentum * old + (1 - momentum) * new
        return blend(mean, centre), blend(width, after)
