"""The cross-entropy method."""

import equinox as eqx
import jax.lax as lax
import jax.numpy as jnp
from jaxtyping import Array

from .._check import check_count, check_number, check_range
from .._module import parameter
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
    without constraints. Its result is `diverged` if the start and all means diverge.

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
