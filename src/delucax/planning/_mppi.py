"""Model predictive path integral planning."""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array

from .._check import check_number, check_positive
from .._module import parameter
from .._typing import PRNGKey
from ..costs import AbstractCost
from ..dynamics import AbstractDynamics
from ._plan import Plan
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
    without constraints.

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


def mppi(
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
    r"""Controls by model predictive path integral planning: the short call of
    [`delucax.planning.MPPI`][], which has further options.

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
        plan = dlx.planning.mppi(
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
    planner = MPPI(samples, iterations)
    return planner(dynamics, cost, x0, controls, t0, w, bounds, key=key, throw=throw)
