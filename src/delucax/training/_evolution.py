"""The gradient of a smoothed loss, from its values alone."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.random as jr
import optax
from jaxtyping import PyTree

from .._check import check_count, check_key
from .._module import check_parameters, parameter, positive
from .._typing import PRNGKey, Real
from ._loss import cost_and_metrics
from ._trainable import weights_of


class EvolutionStrategies(eqx.Module):
    r"""The gradient of the loss smoothed by Gaussian noise on the weights.

    Antithetic, over `n = samples / 2` directions `e_i ~ N(0, I)`, a key for each:

    `g = 1 / (2 n sigma) sum_i (loss(theta + sigma e_i) - loss(theta - sigma e_i)) e_i`,

    or one-sided, over `n = samples` directions and one key:

    `g = 1 / (n sigma) sum_i (loss(theta + sigma e_i) - loss(theta)) e_i`.

    Both are unbiased for the gradient of `E[loss(theta + sigma e)]`, which is that of
    the expected loss itself where the loss is quadratic, and differs by order
    `sigma^2` elsewhere. Only values are taken, all at once under `jax.vmap`: the loss
    need not be differentiable. Called as every estimator is, see
    [`delucax.training.analytic`][].

    **Arguments:**

    - `sigma`: the standard deviation of the noise, positive; in the unconstrained
        values of what has a constraint when used by [`delucax.training.fit`][].
    - `samples`: the number of perturbed losses in one estimate; even if antithetic.
    - `antithetic`: whether each direction is tried both ways (default), which cancels
        the loss itself and every even term.

    **Returns:** from a call, `(value, gradient)`: what the loss returned for the
    unperturbed weights, and a pytree like the model with `None` in the place of what is
    not a weight.

    **Raises:** `ValueError` if `sigma` is not positive, or if `samples` is below 1, or
    odd and antithetic.

    Source: Salimans, Ho, Chen, Sidor and Sutskever, 2017; Nesterov and Spokoiny, 2017
    (one-sided).

    !!! example

        ```python
        import delucax as dlx
        import jax
        import jax.numpy as jnp

        env = dlx.make("pendulum")
        loss = dlx.training.expected_cost(env, batch=1, horizon=50)
        controller = dlx.controllers.Linear(jnp.array([[20.0, 5.0]]))
        estimator = dlx.training.EvolutionStrategies(sigma=0.1, samples=16)
        value, gradient = estimator(loss, controller, jax.random.key(0))
        ```
    """

    sigma: Real = parameter(constraint=positive)
    samples: int = eqx.field(static=True)
    antithetic: bool = eqx.field(static=True, default=True)

    def __check_init__(self):
        where = "EvolutionStrategies"
        check_parameters(self)
        check_count(self.samples, "samples", where)
        if self.antithetic and self.samples % 2:
            raise ValueError(
                f"{where}: samples must be even when antithetic, got {self.samples}."
            )

    def __call__(self, loss, model, key: PRNGKey) -> tuple[Any, PyTree]:
        check_key(key, "EvolutionStrategies")
        weights, rest = weights_of(model)
        n = self.samples // 2 if self.antithetic else self.samples
        loss_key, noise_key, pair_key = jr.split(key, 3)
        draw = lambda key, shape, dtype: jr.normal(key, (n, *shape), dtype)
        noise = optax.tree.random_like(noise_key, weights, draw)
        # The unperturbed weights come first, so that the loss is traced once.
        sides = 2 if self.antithetic else 1
        ones, every = jnp.ones(n), jnp.arange(n)
        signs = jnp.concatenate([jnp.zeros(1), ones, -ones][: 1 + sides])
        directions = jnp.concatenate([jnp.zeros(1, int), *[every] * sides])
        keys = None
        if self.antithetic:
            pairs = jr.split(pair_key, n)
            keys = jnp.concatenate([loss_key[None], pairs, pairs])

        def value_at(sign, direction, own_key):
            scale = self.sigma * sign
            perturbed = jax.tree.map(
                lambda w, e: (w + scale * e[direction]).astype(w.dtype), weights, noise
            )
            one_key = loss_key if own_key is None else own_key
            value = loss(eqx.combine(perturbed, rest), one_key)
            return cost_and_metrics(value, "EvolutionStrategies")

        costs, metrics = jax.vmap(value_at)(signs, directions, keys)
        if self.antithetic:
            slopes = (costs[1 : n + 1] - costs[n + 1 :]) / (2 * n * self.sigma)
        else:
            slopes = (costs[1:] - costs[0]) / (n * self.sigma)
        gradient = jax.tree.map(
            lambda w, e: jnp.tensordot(slopes, e, 1).astype(w.dtype), weights, noise
        )
        first = {name: metric[0] for name, metric in metrics.items()}
        return (costs[0], first) if first else costs[0], gradient
