"""The gradient by differentiating through the loss."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
from jaxtyping import Array, PyTree

from .._check import check_key
from .._typing import PRNGKey
from ._loss import cost_and_metrics
from ._trainable import weights_of


def analytic(
    loss: Callable[..., Any], model: PyTree, key: PRNGKey
) -> tuple[Any, PyTree]:
    """The gradient by automatic differentiation through the loss.

    `g = d loss(theta, key) / d theta`, exact for the key that is drawn; its mean over
    keys is the gradient of the expected loss wherever the two may be exchanged.

    Like every estimator it is called as `estimator(loss, model, key)`. The gradient is
    with respect to the leaves of the model marked `weight()`; or, where none is marked,
    to every floating-point array. [`delucax.training.fit`][] hands it the trainable
    (unconstrained) values alone.

    **Arguments:**

    - `loss`: `loss(model, key)` to a scalar, or to a scalar and a dictionary of scalar
        metrics.
    - `model`: a pytree with weights.
    - `key`: a random key, passed to the loss.

    **Returns:** `(value, gradient)`: what the loss returned, and a pytree like the
    model with `None` in the place of what is not a weight.

    **Raises:** `ValueError` if the loss is not a floating-point scalar, or `key` is no
    random key.

    !!! example

        ```python
        import delucax as dlx
        import jax
        import jax.numpy as jnp

        env = dlx.make("pendulum")
        loss = dlx.training.expected_cost(env, batch=8, horizon=50)
        controller = dlx.controllers.Linear(jnp.array([[20.0, 5.0]]))
        value, gradient = dlx.training.analytic(loss, controller, jax.random.key(0))
        gradient.K
        ```
    """
    check_key(key, "analytic")

    def of(model):
        value = loss(model, key)
        return cost_and_metrics(value, "analytic")[0], value

    return gradient_of_weights(of, model)


def gradient_of_weights(
    loss: Callable[[PyTree], tuple[Array, Any]], model: PyTree
) -> tuple[Any, PyTree]:
    """What `loss(model)` returns beside its scalar, and the gradient of that."""
    weights, rest = weights_of(model)
    of = lambda weights: loss(eqx.combine(weights, rest))
    (_, value), gradient = eqx.filter_value_and_grad(of, has_aux=True)(weights)
    return value, gradient
