"""The gradient perturbation controller."""

from collections.abc import Callable
from typing import Any

import optax
from jaxtyping import Array

from ..._controller import AbstractController
from ...dynamics import AbstractDynamics
from ._base import base_for
from ._closed_loop import ClosedLoop
from ._learner import linear_learner, OnlineLearner


def gpc(
    dynamics: AbstractDynamics,
    cost: Callable[..., Array],
    *,
    base: AbstractController | None = None,
    memory: int | None = None,
    horizon: int | None = None,
    learning_rate: Any = None,
    optimiser: optax.GradientTransformation | None = None,
    radius: Any = None,
) -> OnlineLearner:
    """The gradient perturbation controller,

    `u_t = base(x_t) + sum_{i=1..memory} E_i w_{t-i}`,

    with `w_{t-1} = x_t - F(t-1, x_{t-1}, u_{t-1})`, the disturbances so far, recovered
    with the control that was applied. E follows the gradient of what each step would
    have cost under it: see [`delucax.controllers.OnlineLearner`][]. Against the best
    fixed E in hindsight its regret over T steps grows as `sqrt(T)`, whatever the
    disturbances are.

    The dynamics are linear, time-varying or not, or any others that observe their
    state; those are linearised along the way, and the disturbance is what the true map
    leaves over.

    **Arguments:**

    - `dynamics`: the model, an [`delucax.AbstractDynamics`][] that observes its state.
    - `cost`: the stage cost, a differentiable function of `(t, x, u)` such as
        `env.cost`.
    - `base`: a controller that stabilises the dynamics; by default the
        [`delucax.controllers.LQR`][] for the curvature of the cost at the operating
        point.
    - `memory`: the number of past disturbances; by default the least h, of 10 at least
        and 50 at most, with `rho^h <= 0.1`, rho being the spectral radius of the closed
        loop. It is 10 where dynamics are not linear and time-invariant, and inside a
        transformation of JAX, where the loop cannot be seen.
    - `horizon`: the length of the roll-out; by default the least h, of 10 at least and
        1000 at most, with `rho^h <= 0.03`, rho being the spectral radius of the closed
        loop.
    - `learning_rate`: scales the optimiser's step, of Newton's the longest; by default
        `0.15 / |B|_F`, with `|B|` the size of what a unit of control does to the state
        in a step.
    - `optimiser`: an Optax transformation; by default
        [`delucax.controllers.adagrad_norm`][] where dynamics are linear and
        time-invariant, and otherwise [`delucax.controllers.online_newton`][]. Neither
        needs a scale of the cost; the second learns faster, and a step of it takes ten
        times as long.
    - `radius`: E is kept inside this ball in the Frobenius norm, `50 / |B|_F` by
        default.

    **Returns:** a [`delucax.controllers.OnlineLearner`][]. In its state `loop.signal`
    has the disturbances and `theta`, shape `(m, memory n)`, the matrices E side by
    side.

    **Raises:** `ValueError` if the base does not stabilise the dynamics, does not fit
    them or cannot be designed, the cost is not a scalar, the state is not observed, or
    a number is out of its range.

    Source: Agarwal, Bullins, Hazan, Kakade and Singh, 2019.

    !!! example

        ```python
        import delucax as dlx
        import jax
        import jax.numpy as jnp

        A, B = jnp.array([[1.0, 1.0], [0.0, 1.0]]), jnp.array([[0.0], [1.0]])
        dynamics = dlx.LinearDynamics(A, B)
        cost = dlx.costs.Quadratic(jnp.eye(2), jnp.eye(1))
        push = dlx.disturbances.Constant(jnp.ones(2))
        env = dlx.Environment(dynamics, cost, disturbance=push)

        run = lambda c: dlx.rollout(env, c, key=jax.random.key(0), horizon=1000)
        learner = dlx.controllers.gpc(dynamics, cost)
        regulator = dlx.controllers.LQR(dynamics, jnp.eye(2), jnp.eye(1))
        run(learner).total_cost / run(regulator).total_cost
        ```
    """
    base = base_for(dynamics, cost, base, "gpc")
    loop = ClosedLoop(dynamics, base, horizon, "gpc", memory=memory, nature=False)
    if not loop.observed:
        raise ValueError(
            "gpc: dynamics must observe their state (drc learns from outputs), got "
            f"{dynamics.observation_size} outputs of {dynamics.state_size} states."
        )
    return linear_learner(loop, cost, learning_rate, optimiser, radius, "gpc")
