"""The cross-entropy method."""

from typing import Any

import equinox as eqx
import jax.lax as lax
import jax.numpy as jnp
from jaxtyping import Array

from .._check import check_count, check_number, check_range
from .._module import parameter
from .._typing import PRNGKey
from ..costs import AbstractCost
from ..dynamics import AbstractDynamics
from ._plan import Plan
from ._sampling import AbstractSampler, average, check_sampler


class CEM(AbstractSampler):
    r"""Controls by sampling, for costs and dynamics that need not be smooth: the
    cross-entropy method.

    Sequences are drawn with a mean and a standard deviation for each control of each
    step, and both move to those of the cheapest sequences, the elites:

    `mean <- momentum mean + (1 - momentum) mean of the elites`, and likewise the
    standard deviation.

    A sequence that diverges is no elite. The plan is the best of the means, the start
    among them, so it costs no more than the start. It has no gains. Its derivatives are
    those of the elites that were drawn; which ones those are is held.

    It is called as every [`delucax.planning.AbstractPlanner`][], with a `key`, and
    without constraints.

    **Arguments:**

    - `samples`: sequences drawn in an iteration, 256 by default.
    - `iterations`: 10 by default.
    - `elites`: how many of the sequences count, 32 by default.
    - `scale`: the standard deviation to start with, a number or of shape `(m,)`; 1 by
        default.
    - `correlation`: of a control drawn with the one before it, from 0, white noise, by
        default, to 1.
    - `momentum`: how much stays of mean and standard deviation, 0.1 by default.

    **Raises:** `ValueError` on an option out of its range, or more elites than samples.

    Source: Rubinstein, 1999; Chua, Calandra, McAllister and Levine, 2018 (planning).

    !!! example

        ```python
        import delucax as dlx
        import jax
        import jax.numpy as jnp

        env = dlx.make("pendulum")
        planner = dlx.planning.CEM(samples=64, elites=8)
        plan = planner(
            env.dynamics, env.cost, jnp.array([0.5, 0.0]), 20, key=jax.random.key(0)
        )
        plan.cost
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
        check_sampler(self)
        check_count(self.elites, "elites", where)
        if self.elites > self.samples:
            raise ValueError(
                f"{where}: elites must be at most samples, {self.samples}, got "
                f"{self.elites}."
            )
        check_number(self.momentum, "momentum", where)
        check_range(self.momentum, "momentum", where, 0, 1)

    def update(self, drawn, costs, mean, width):
        # Neither infinities nor what is compared need a derivative.
        _, best = lax.top_k(-lax.stop_gradient(costs), self.elites)
        weights = jnp.isfinite(costs[best]).astype(mean.dtype)
        centre = average(weights, drawn[best], mean)
        variance = average(weights, (drawn[best] - centre) ** 2, width**2)
        # The square root has no slope at zero.
        spreads = variance > 0
        after = jnp.where(spreads, jnp.sqrt(jnp.where(spreads, variance, 1)), 0)
        momentum = self.momentum.astype(mean.dtype)
        blend = lambda old, new: momentum * old + (1 - momentum) * new
        return blend(mean, centre), blend(width, after)


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
    iterations: int = 10,
    throw: bool = True,
) -> Plan:
    r"""Controls by the cross-entropy method: the short call of
    [`delucax.planning.CEM`][], which has further options.

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
    - `samples`: sequences drawn in an iteration, of which 32 are elites; 256 by
        default.
    - `iterations`: 10 by default.
    - `throw`: raise if the start and all means diverge (default); if false, look at
        `plan.result`, which is `diverged` then.

    **Returns:** a [`delucax.planning.Plan`][].

    **Raises:** `ValueError` on an argument of the wrong kind or shape, out of its
    range, or not finite; an error at run time as `throw` says.

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
    planner = CEM(samples, iterations)
    return planner(dynamics, cost, x0, controls, t0, w, bounds, key=key, throw=throw)
