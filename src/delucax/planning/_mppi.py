"""Model predictive path integral planning."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array

from .._check import check_number, check_positive
from .._module import parameter
from ._sampling import AbstractSampler, average, check_sampler


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
        check_sampler(self)
        check_number(self.temperature, "temperature", "MPPI")
        check_positive(self.temperature, "temperature", "MPPI")

    def update(self, drawn, costs, mean, width):
        finite, least = jnp.isfinite(costs), jnp.min(costs)
        least = jnp.where(jnp.isfinite(least), least, 0)
        above = jnp.where(finite, costs, least) - least
        temperature = self.temperature.astype(mean.dtype)
        weights = jnp.where(finite, jnp.exp(-above / temperature), 0)
        return average(weights, drawn, mean), width
