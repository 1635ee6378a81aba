"""A network of the past disturbances, learned online."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array

from ..._check import check_count, check_key, check_positive
from ..._controller import AbstractController
from ..._module import as_module
from ..._typing import PRNGKey
from ...dynamics import AbstractDynamics
from ._base import base_for
from ._closed_loop import ClosedLoop
from ._learner import OnlineLearner
from ._optimisers import adagrad_norm
from ._policy import NetworkPolicy


def neural_gpc(
    dynamics: AbstractDynamics,
    cost: Callable[..., Array],
    *,
    base: AbstractController | None = None,
    memory: int | None = None,
    width: int = 32,
    depth: int = 1,
    horizon: int | None = None,
    learning_rate: Any = 1e-3,
    optimiser: optax.GradientTransformation | None = None,
    key: PRNGKey,
) -> OnlineLearner:
    """A network in place of the matrices of [`delucax.controllers.gpc`][],

    `u_t = base(y_t) + network(s_t, ..., s_{t-memory+1})`,

    where the signal s is the last disturbance if the state is observed, nature's output
    otherwise. The network starts by adding nothing. There is no bound on its regret;
    it is for costs and plants that a linear map of the past does not suit.

    **Arguments:**

    - `dynamics`, `cost`, `base`, `memory`, `horizon`: as for
        [`delucax.controllers.gpc`][] and [`delucax.controllers.drc`][].
    - `width`, `depth`: of the hidden layers, 32 units in 1 layer by default.
    - `learning_rate`: scales the optimiser's step, 1e-3 by default.
    - `optimiser`: an Optax transformation; [`delucax.controllers.adagrad_norm`][] by
        default.
    - `key`: a random key, for the first weights.

    **Returns:** a [`delucax.controllers.OnlineLearner`][], whose `theta` are the
    network's weights.

    **Raises:** `ValueError` as [`delucax.controllers.gpc`][].

    Source: Chen, Minasyan, Lee and Hazan, 2022.

    !!! example

        ```python
        import delucax as dlx
        import jax

        env = dlx.make("lds", key=jax.random.key(0))
        key, run_key = jax.random.split(jax.random.key(0))
        learner = dlx.controllers.neural_gpc(env.dynamics, env.cost, key=key)
        dlx.rollout(env, learner, key=run_key).total_cost
        ```
    """
    where = "neural_gpc"
    base = base_for(dynamics, cost, base, where)
    loop = ClosedLoop(dynamics, base, horizon, where, memory=memory)
    check_key(key, where)
    check_positive(learning_rate, "learning_rate", where)
    network = eqx.nn.MLP(
        loop.feature_size,
        dynamics.control_size,
        check_count(width, "width", where),
        check_count(depth, "depth", where),
        as_module(jnp.tanh),
        as_module(jax.nn.identity),
        dtype=loop.dtype,
        key=key,
    )
    last = lambda net: [net.layers[-1].weight, net.layers[-1].bias]
    network = eqx.tree_at(last, network, [0 * leaf for leaf in last(network)])
    optimiser = adagrad_norm() if optimiser is None else optimiser
    return OnlineLearner(loop, cost, NetworkPolicy(network), learning_rate, optimiser)
