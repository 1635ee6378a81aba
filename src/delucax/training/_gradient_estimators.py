"""Estimators of the gradient of a loss, and what a loss returns."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.lax as lax
import jax.numpy as jnp
import jax.random as jr
import optax
from jaxtyping import Array, PyTree

from .._check import check_count, check_key, check_positive
from .._module import check_parameters, parameter, positive, shown
from .._typing import PRNGKey, Real
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
        import equinox as eqx
        import jax
        import jax.numpy as jnp

        env = dlx.make("pendulum")
        loss = dlx.training.expected_cost(env, batch=8, horizon=50)
        controller = dlx.controllers.Linear(jnp.array([[20.0, 5.0]]))
        estimator = eqx.filter_jit(dlx.training.analytic)
        value, gradient = estimator(loss, controller, jax.random.key(0))
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
    """The auxiliary value of `loss(model)`, and the gradient of its scalar."""
    weights, rest = weights_of(model)
    of = lambda weights: loss(eqx.combine(weights, rest))
    (_, value), gradient = eqx.filter_value_and_grad(of, has_aux=True)(weights)
    return value, gradient


class ClippedSamples(eqx.Module):
    r"""The mean of the gradients of several draws, with those that are far longer than
    the middle one shortened.

    Over the n samples whose cost and gradient `g_i` are finite,

    `g = 1 / n sum_i min(1, c / |g_i|) g_i`, `c = factor * median of |g_i|`
    (of those that are not zero, if most are).

    A plant that runs away in one episode of thirty has a gradient that is larger than
    all others together, and points nowhere; or it is not finite, which would end the
    training. Called as every estimator is, see [`delucax.training.analytic`][], with a
    loss of a single episode.

    **Arguments:**

    - `samples`: gradients in one estimate, 32 by default.
    - `factor`: 5 by default. A small one is biased towards what most episodes need.

    **Returns:** from a call, `(value, gradient)`: the mean of what the loss returned
    for these samples, and a pytree like the model with `None` in the place of what is
    not a weight. Both are NaN if there is no such sample.

    **Raises:** `ValueError` if `samples` is below 1, or `factor` is not positive.

    Source: Abadi et al., 2016 (clipping each gradient); Andrew, Thakkar, McMahan and
    Ramaswamy, 2021 (to a quantile).

    !!! example

        ```python
        import delucax as dlx
        import equinox as eqx
        import jax
        import jax.numpy as jnp

        env = dlx.make("pendulum")
        loss = dlx.training.expected_cost(env, batch=1, horizon=50)
        controller = dlx.controllers.Linear(jnp.array([[20.0, 5.0]]))
        estimator = eqx.filter_jit(dlx.training.ClippedSamples(8))
        value, gradient = estimator(loss, controller, jax.random.key(0))
        gradient.K
        ```
    """

    samples: int = eqx.field(static=True, default=32)
    factor: float = eqx.field(static=True, default=5.0)

    __repr__ = shown

    def __post_init__(self):
        self.samples = check_count(self.samples, "samples", "ClippedSamples")
        check_positive(self.factor, "factor", "ClippedSamples")

    def __call__(
        self, loss: Callable[..., Any], model: PyTree, key: PRNGKey
    ) -> tuple[Any, PyTree]:
        check_key(key, "ClippedSamples")

        sample = lambda key: analytic(loss, model, key)
        values, gradients = jax.vmap(sample)(jr.split(key, self.samples))
        costs = values[0] if isinstance(values, tuple | list) else values
        norms = jax.vmap(optax.tree.norm)(gradients)
        counts = jnp.isfinite(costs) & jnp.isfinite(norms)
        # Where most are zero, such as those of episodes that have ended, of the rest.
        middle = lambda kept: jnp.nanmedian(jnp.where(kept, norms, jnp.nan))
        usual = middle(counts)
        most = self.factor * jnp.where(usual > 0, usual, middle(counts & (norms > 0)))
        shares = jnp.where(norms > most, most / norms, 1)

        def mean(samples, shares):
            axes = (slice(None), *[None] * (samples.ndim - 1))
            kept = jnp.where(counts[axes], samples, 0)
            return jnp.sum(shares[axes] * kept, axis=0) / jnp.sum(counts)

        alike = jnp.ones_like(shares)
        value = jax.tree.map(lambda samples: mean(samples, alike), values)
        return value, jax.tree.map(lambda samples: mean(samples, shares), gradients)


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
        import equinox as eqx
        import jax
        import jax.numpy as jnp

        env = dlx.make("pendulum")
        loss = dlx.training.expected_cost(env, batch=1, horizon=50)
        controller = dlx.controllers.Linear(jnp.array([[20.0, 5.0]]))
        estimator = dlx.training.EvolutionStrategies(sigma=0.1, samples=16)
        key = jax.random.key(0)
        value, gradient = eqx.filter_jit(estimator)(loss, controller, key)
        ```
    """

    sigma: Real = parameter(constraint=positive)
    samples: int = eqx.field(static=True)
    antithetic: bool = eqx.field(static=True, default=True)

    __repr__ = shown

    def __check_init__(self):
        where = "EvolutionStrategies"
        check_parameters(self)
        check_count(self.samples, "samples", where)
        if self.antithetic and self.samples % 2:
            raise ValueError(
                f"{where}: samples must be even when antithetic, got {self.samples}."
            )

    def __call__(
        self, loss: Callable[..., Any], model: PyTree, key: PRNGKey
    ) -> tuple[Any, PyTree]:
        check_key(key, "EvolutionStrategies")
        weights, rest = weights_of(model)
        n = self.samples // 2 if self.antithetic else self.samples
        loss_key, noise_key, pair_key = jr.split(key, 3)
        draw = lambda key, shape, dtype: jr.normal(key, (n, *shape), dtype)
        noise = optax.tree.random_like(noise_key, weights, draw)
        # The unperturbed weights come first, so that the loss is traced once.
        sides = 2 if self.antithetic else 1
        # theta, theta + sigma e_1, ..., and if antithetic theta - sigma e_1, ...
        ones, every = jnp.ones(n), jnp.arange(n)
        signs = jnp.concatenate([jnp.zeros(1), ones, -ones][: 1 + sides])
        directions = jnp.concatenate([jnp.zeros(1, int), *[every] * sides])
        # One-sided, all share one key: the noise of the loss is common, and cancels in
        # the difference from the unperturbed one.
        keys = None
        if self.antithetic:
            # Both of a pair share a key, so that the noise of the loss cancels.
            pairs = jr.split(pair_key, n)
            keys = jnp.concatenate([loss_key[None], pairs, pairs])

        def value_at(sign, direction, own_key):
            scale = self.sigma * sign
            moved = lambda w, e: (w + scale * e[direction]).astype(w.dtype)
            perturbed = jax.tree.map(moved, weights, noise)
            one_key = loss_key if own_key is None else own_key
            value = loss(eqx.combine(perturbed, rest), one_key)
            return cost_and_metrics(value, "EvolutionStrategies")

        costs, metrics = jax.vmap(value_at)(signs, directions, keys)
        if self.antithetic:
            slopes = (costs[1 : n + 1] - costs[n + 1 :]) / (2 * n * self.sigma)
        else:
            slopes = (costs[1:] - costs[0]) / (n * self.sigma)
        along = lambda w, e: jnp.tensordot(slopes, e, 1).astype(w.dtype)
        gradient = jax.tree.map(along, weights, noise)
        first = {name: metric[0] for name, metric in metrics.items()}
        return (costs[0], first) if first else costs[0], gradient


class LikelihoodRatio(eqx.Module):
    r"""The gradient of an expected cost from the probability of what was drawn.

    `g = 1/n sum_i (c_i - b_i) d log p(u_i; theta) / d theta`,

    with `b_i` the mean of the other samples' costs, or 0. It is unbiased for the
    gradient of `E[c]`, since `E[d log p] = 0` and `b_i` does not depend on `u_i`. Only
    the log-probability is differentiated, never the cost or the plant.

    The loss returns `(cost, {"log_prob": ...})` for one draw, and the same loss serves
    the other estimators, which leave the log-probability alone. Two things are asked of
    it: the log-probability is that of what was drawn with the draw itself held fixed
    (`jax.lax.stop_gradient(u)`; a reparametrised draw `mean + std * e` left in cancels
    the score), and the cost depends on the weights through the draw alone.
    [`delucax.training.scored_cost`][] makes such a loss of an environment. Called as
    every estimator is, see [`delucax.training.analytic`][].

    **Arguments:**

    - `samples`: the number n of draws in one estimate.
    - `baseline`: whether to subtract the mean cost of the other draws (default), which
        lowers the variance and leaves the mean as it is.

    **Returns:** from a call, `(value, gradient)`: the mean cost and mean metrics over
    the draws, and a pytree like the model with `None` in the place of what is not a
    weight.

    **Raises:** `ValueError` if `samples` is below 1, or below 2 with a baseline; when
    it is called, if the loss returns no `"log_prob"`.

    Source: Williams, 1992; Kool, van Hoof and Welling, 2019 (the baseline).

    !!! example

        ```python
        import delucax as dlx
        import equinox as eqx
        import jax
        import jax.numpy as jnp

        def loss(mean, key):
            u = jax.lax.stop_gradient(mean + jax.random.normal(key))
            return (u - 1.0) ** 2, {"log_prob": -0.5 * (u - mean) ** 2}

        estimator = dlx.training.LikelihoodRatio(samples=1000)
        key = jax.random.key(0)
        value, gradient = eqx.filter_jit(estimator)(loss, jnp.asarray(0.0), key)
        ```
    """

    samples: int = eqx.field(static=True)
    baseline: bool = eqx.field(static=True, default=True)

    __repr__ = shown

    def __check_init__(self):
        where = "LikelihoodRatio"
        check_count(self.samples, "samples", where)
        if self.baseline and self.samples < 2:
            raise ValueError(
                f"{where}: samples must be at least 2 with a baseline, the mean of the "
                f"others, got {self.samples}."
            )

    def __call__(
        self, loss: Callable[..., Any], model: PyTree, key: PRNGKey
    ) -> tuple[Any, PyTree]:
        check_key(key, "LikelihoodRatio")

        def surrogate(model):
            draw = lambda key: cost_and_metrics(loss(model, key), "LikelihoodRatio")
            costs, metrics = jax.vmap(draw)(jr.split(key, self.samples))
            if "log_prob" not in metrics:
                raise ValueError(
                    "LikelihoodRatio: loss must return (cost, {'log_prob': ...}), got "
                    f"the metrics {sorted(metrics)}; delucax.training.scored_cost "
                    "makes such a loss of an environment."
                )
            # Only the score carries a gradient: that of the cost by the draw would
            # count its dependence on the weights twice.
            excess = costs = lax.stop_gradient(costs)
            if self.baseline:
                # The mean of the others differs from that of all by this factor.
                excess = (costs - jnp.mean(costs)) * (self.samples / (self.samples - 1))
            means = {name: jnp.mean(metric) for name, metric in metrics.items()}
            value = (jnp.mean(costs), lax.stop_gradient(means))
            # Its gradient is the estimate; its own value means nothing.
            return jnp.mean(excess * metrics["log_prob"]), value

        return gradient_of_weights(surrogate, model)


def cost_and_metrics(value: Any, where: str) -> tuple[Array, dict[str, Array]]:
    """The scalar and the metrics of what a loss returned, checked."""
    is_pair = isinstance(value, tuple | list) and len(value) == 2
    cost, metrics = value if is_pair else (value, {})
    if not isinstance(metrics, dict):
        got = "an array" if eqx.is_array(metrics) else type(metrics).__name__
        raise ValueError(
            f"{where}: loss must return a scalar, or a scalar and a dictionary of "
            f"metrics, got {got} for the metrics."
        )
    metrics = {name: _scalar(metric, where, name) for name, metric in metrics.items()}
    cost = _scalar(cost, where, None)
    if not jnp.issubdtype(cost.dtype, jnp.floating):
        raise ValueError(
            f"{where}: loss must return a floating-point scalar, got dtype "
            f"{cost.dtype}."
        )
    return cost, metrics


def _scalar(value: Any, where: str, name: str | None) -> Array:
    what = "loss must return" if name is None else f"metric {name!r} must be"
    try:
        array = jnp.asarray(value)
    except (TypeError, ValueError):
        raise ValueError(
            f"{where}: {what} a scalar, got {type(value).__name__}."
        ) from None
    if array.shape != ():
        raise ValueError(f"{where}: {what} a scalar, got shape {array.shape}.")
    return array
