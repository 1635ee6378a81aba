"""The cross-entropy method."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax.lax as lax
import jax.numpy as jnp
from jaxtyping import Array

from .._check import check_count, check_number, check_range
from .._typing import PRNGKey
from ..costs import AbstractCost
from ..dynamics import AbstractDynamics
from ._arguments import as_problem
from ._plan import checked, Plan
from ._sampling import as_samples, as_spread, average, Samples, search
from ._start import controls_of, Start


def cem(
    dynamics: AbstractDynamics,
    cost: AbstractCost,
    x0: Any,
    controls: Any,
    t0: Any = 0.0,
    w: Any = None,
    bounds: Any = None,
    *,
    key: PRNGKey,
    samples: int = 256,
    elites: int = 32,
    iterations: int = 10,
    scale: Any = 1.0,
    correlation: Any = 0.0,
    momentum: Any = 0.1,
    difference: Callable[[Any, Any], Any] | None = None,
    throw: bool = True,
) -> Plan:
    r"""Controls by sampling, for costs and dynamics that need not be smooth: the
    cross-entropy method.

    Sequences are drawn with a mean and a standard deviation for each control of each
    step, and both move to those of the cheapest sequences, the elites:

    `mean <- momentum mean + (1 - momentum) mean of the elites`, and likewise the
    standard deviation.

    A sequence that diverges is no elite. The plan is the best of the means, the start
    among them, so it costs no more than the start. It has no gains. Its derivatives are
    those of the elites that were drawn; which ones those are is held.

    **Arguments:**

    - `dynamics`: the discrete-time dynamics.
    - `cost`: the stage and final cost.
    - `x0`: the first state, shape `(n,)`.
    - `controls`: what to start from, as for [`delucax.planning.ilqr`][].
    - `t0`: the time of the first state, 0 by default.
    - `w`: disturbances known in advance, shape `(T, k)`; zero by default.
    - `bounds`: `(low, high)`, each a number or of shape `(m,)`, between which every
        control is drawn; none by default.
    - `key`: a random key.
    - `samples`: sequences drawn in an iteration, 256 by default.
    - `elites`: how many of them count, 32 by default.
    - `iterations`: 10 by default.
    - `scale`: the standard deviation to start with, a number or of shape `(m,)`; 1 by
        default.
    - `correlation`: of a control drawn with the one before it, from 0, white noise, by
        default, to 1.
    - `momentum`: how much stays of mean and standard deviation, 0.1 by default.
    - `difference`: `(x, x_ref) -> deviation`, which the plan keeps; subtraction by
        default.
    - `throw`: raise if the start and all means diverge (default); if false, look at
        `plan.result`, which is `diverged` then.

    **Returns:** a [`delucax.planning.Plan`][].

    **Raises:** `ValueError` on an argument of the wrong kind or shape, out of its
    range, or not finite, or more elites than samples; an error at run time as `throw`
    says.

    Source: Rubinstein, 1999; Chua, Calandra, McAllister and Levine, 2018 (planning).

    !!! example

        ```python
        import delucax as dlx
        import jax
        import jax.numpy as jnp

        env = dlx.make("pendulum")
        plan = dlx.planning.cem(
            env.dynamics,
            env.cost,
            jnp.array([0.5, 0.0]),
            jnp.zeros((20, 1)),
            bounds=(-2.0, 2.0),
            key=jax.random.key(0),
        )
        plan.cost
        ```
    """
    where = "cem"
    problem, start = as_problem(
        dynamics, cost, x0, controls, t0, w, bounds, difference, None, where
    )
    controls = controls_of(start)
    spread = as_spread(scale, correlation, controls, key, where)
    sizes = as_samples(samples, iterations, where)
    elites = check_count(elites, "elites", where)
    if elites > sizes.count:
        raise ValueError(
            f"{where}: elites must be at most samples, {sizes.count}, got {elites}."
        )
    check_number(momentum, "momentum", where)
    check_range(momentum, "momentum", where, 0, 1)
    momentum = jnp.asarray(momentum, controls.dtype)
    plan = _plan(problem, start, key, spread, momentum, sizes, elites)
    return checked(plan, where) if throw else plan


@eqx.filter_jit
def _plan(
    problem: Any,
    start: Start,
    key: Array,
    spread: Any,
    momentum: Array,
    samples: Samples,
    elites: int,
) -> Plan:
    def update(tried, costs, mean, width):
        # Neither infinities nor what is compared need a derivative.
        _, best = lax.top_k(-lax.stop_gradient(costs), elites)
        weights = jnp.isfinite(costs[best]).astype(mean.dtype)
        centre = average(weights, tried[best], mean)
        variance = average(weights, (tried[best] - centre) ** 2, width**2)
        spreads = variance > 0
        after = jnp.where(spreads, jnp.sqrt(jnp.where(spreads, variance, 1)), 0)
        blend = lambda old, new: momentum * old + (1 - momentum) * new
        return blend(mean, centre), blend(width, after)

    width = jnp.broadcast_to(spread.scale, controls_of(start).shape)
    return search(problem, start, key, spread, samples, width, update)
