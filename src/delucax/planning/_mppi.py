"""Model predictive path integral planning."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array

from .._check import check_number, check_positive
from .._typing import PRNGKey
from ..costs import AbstractCost
from ..dynamics import AbstractDynamics
from ._arguments import as_problem
from ._plan import checked, Plan
from ._sampling import above_least, as_samples, as_spread, average, Samples, search
from ._start import controls_of, Start


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
    scale: Any = 1.0,
    correlation: Any = 0.0,
    temperature: Any = 1.0,
    difference: Callable[[Any, Any], Any] | None = None,
    throw: bool = True,
) -> Plan:
    r"""Controls by sampling, for costs and dynamics that need not be smooth:

    `u_k <- sum over i of v_i u_k^i`, with `v_i` proportional to
    `exp(-cost^i / temperature)`, over sequences `u^i` drawn about the present one.

    This is model predictive path integral control. The cost of a sequence is the whole
    cost of its trajectory, without a further charge for leaving the present one. A
    sequence that diverges has no weight. The plan is the best of the means, the start
    among them, so it costs no more than the start. It has no gains. It is
    differentiable in whatever the costs are, for the numbers that were drawn.

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
    - `scale`: the standard deviation of the controls drawn, a number or of shape
        `(m,)`; 1 by default.
    - `correlation`: of a control drawn with the one before it, from 0, white noise, by
        default, to 1, a constant.
    - `temperature`: in the unit of the cost, 1 by default. The lower it is, the fewer
        of the best sequences count.
    - `difference`: `(x, x_ref) -> deviation`, which the plan keeps; subtraction by
        default.
    - `throw`: raise if the start and all means diverge (default); if false, look at
        `plan.result`, which is `diverged` then.

    **Returns:** a [`delucax.planning.Plan`][].

    **Raises:** `ValueError` on an argument of the wrong kind or shape, out of its
    range, or not finite; an error at run time as `throw` says.

    Source: Williams, Wagener, Goldfain, Drews, Rehg, Boots and Theodorou, 2017.

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
    where = "mppi"
    problem, start = as_problem(
        dynamics, cost, x0, controls, t0, w, bounds, difference, None, where
    )
    controls = controls_of(start)
    spread = as_spread(scale, correlation, controls, key, where)
    check_number(temperature, "temperature", where)
    check_positive(temperature, "temperature", where)
    temperature = jnp.asarray(temperature, controls.dtype)
    sizes = as_samples(samples, iterations, where)
    plan = _plan(problem, start, key, spread, temperature, sizes)
    return checked(plan, where) if throw else plan


@eqx.filter_jit
def _plan(
    problem: Any,
    start: Start,
    key: Array,
    spread: Any,
    temperature: Array,
    samples: Samples,
) -> Plan:
    def update(tried, costs, mean, width):
        above, finite = above_least(costs)
        weights = jnp.where(finite, jnp.exp(-above / temperature), 0)
        return average(weights, tried, mean), width

    return search(problem, start, key, spread, samples, spread.scale, update)
