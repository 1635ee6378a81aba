"""The step of an online learner."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array


class AdaGradNormState(NamedTuple):
    """The sum of the squared norms of all gradients so far."""

    total: Array


def _init(params: Any) -> Any:
    first = jax.tree.leaves(params)[0]
    return AdaGradNormState(jnp.zeros((), first.dtype))


def _update(updates: Any, state: Any, params: Any = None) -> Any:
    del params
    total = state.total + optax.tree.norm(updates, squared=True)
    some = total > 0
    scale = jnp.where(some, 1 / jnp.sqrt(jnp.where(some, total, 1)), 0)
    updates = jax.tree.map(lambda g: -scale.astype(g.dtype) * g, updates)
    return updates, AdaGradNormState(total)


_ADAGRAD_NORM = optax.GradientTransformation(_init, _update)


def adagrad_norm() -> optax.GradientTransformation:
    r"""Gradient descent whose step does not depend on the scale of the loss,

    `theta_next = theta - learning_rate g_t / sqrt(sum_{s <= t} |g_s|^2)`,

    with `learning_rate` that of the learner. With convex losses and a set of diameter D
    its regret is at most `(D^2 / (2 learning_rate) + learning_rate) sqrt(sum |g|^2)`,
    without knowing how large gradients will be or how many there are.

    **Returns:** an `optax.GradientTransformation`, the same at each call, so that two
    learners share what was compiled.

    Source: Streeter and McMahan, 2010; Ward, Wu and Bottou, 2019.

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp
        import optax

        optimiser = dlx.controllers.adagrad_norm()
        state = optimiser.init(jnp.zeros(2))
        step, state = optimiser.update(jnp.array([3.0, 4.0]), state)
        optax.apply_updates(jnp.zeros(2), step)
        ```
    """
    return _ADAGRAD_NORM
