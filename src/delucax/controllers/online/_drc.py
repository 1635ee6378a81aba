"""The disturbance response controller."""

from collections.abc import Callable
from typing import Any

import optax
from jaxtyping import Array

from ..._check import check_count
from ..._controller import AbstractController
from ...dynamics import AbstractDynamics
from ._base import base_for
from ._closed_loop import ClosedLoop
from ._learner import linear_learner, OnlineLearner


def drc(
    dynamics: AbstractDynamics,
    cost: Callable[..., Array],
    *,
    base: AbstractController | None = None,
    memory: int = 10,
    horizon: int | None = None,
    learning_rate: Any = None,
    optimiser: optax.GradientTransformation | None = None,
    radius: Any = None,
) -> OnlineLearner:
    """The disturbance response controller, for a state that is not observed,

    `u_t = base(y_t) + sum_{j=0..memory-1} M_j nature_{t-j}`,

    where nature's output, `nature_t = y_t - G(v)_t`, is what the closed loop would have
    shown had nothing been added to the base's control; `G(v)` is the loop's response to
    all that was added, saturation included. M follows the gradient of what each step
    would have cost under it, in the past too: see
    [`delucax.controllers.OnlineLearner`][]. Its regret against the best fixed M in
    hindsight grows as `sqrt(T)`.

    With `base` zero it is the gradient response controller; a base such as
    [`delucax.controllers.LQG`][] makes it as good as that from the start, and right for
    plants that are not stable by themselves.

    **Arguments:**

    - `dynamics`: the model; linear and time-invariant where the state is not observed.
    - `cost`: the stage cost, a differentiable function of `(t, y, u)`: of the
        observation, which is all that is seen.
    - `base`: a controller that stabilises the dynamics; by default the
        [`delucax.controllers.LQG`][] for the curvature of the cost and for disturbances
        and sensor noise of unit covariance ([`delucax.controllers.LQR`][] where the
        state is observed).
    - `memory`: the number of outputs, 10 by default.
    - `horizon`: the length of the roll-out; by default the least h, of 10 at least and
        1000 at most, with `rho^h <= 0.03`, rho being the spectral radius of the closed
        loop.
    - `learning_rate`: scales the optimiser's step, of Newton's the longest; by default
        0.15 over the size of the first response of the output to a unit of control.
    - `optimiser`: an Optax transformation; [`delucax.controllers.online_newton`][] with
        a prior of 4 steps by default.
    - `radius`: M is kept inside this ball in the Frobenius norm; by default 50 over the
        same size.

    **Returns:** a [`delucax.controllers.OnlineLearner`][]. In its state `loop.signal`
    has nature's outputs and `theta`, shape `(m, memory p)`, the matrices M side by
    side.

    **Raises:** `ValueError` if the base does not stabilise the dynamics, does not fit
    them or cannot be designed, the cost is not a scalar, or a number is out of its
    range.

    Source: Simchowitz, Singh and Hazan, 2020.

    !!! example

        ```python
        import delucax as dlx
        import jax
        import jax.numpy as jnp

        A, B = jnp.array([[0.9, 0.5], [0.0, 0.9]]), jnp.array([[0.0], [1.0]])
        C = jnp.array([[1.0, 0.0]])
        push = dlx.disturbances.Constant(0.3 * jnp.ones(2))
        cost = dlx.costs.Quadratic(C.T @ C, jnp.eye(1))
        env = dlx.make("lds", A=A, B=B, C=C, cost=cost, disturbance=push)
        cost = dlx.costs.Quadratic(jnp.eye(1), jnp.eye(1))  # of what is seen
        learner = dlx.controllers.drc(env.dynamics, cost)
        dlx.rollout(env, learner, key=jax.random.key(0), horizon=1000).total_cost
        ```
    """
    memory = check_count(memory, "memory", "drc")
    base = base_for(dynamics, cost, base, "drc")
    loop = ClosedLoop(dynamics, base, horizon, "drc", memory=memory, nature=True)
    return linear_learner(loop, cost, learning_rate, optimiser, radius, "drc")
