"""Estimators of the gradient of a loss."""

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
    r"""The gradient of a loss by automatic differentiation.

    $$g = \frac{\partial \ell(\theta, \text{key})}{\partial \theta}$$

    The gradient is exact for the given key. The mean of the gradient over keys is the
    gradient of the expected loss, if derivative and expectation can be exchanged.

    You call every gradient estimator as `estimator(loss, model, key)`. The gradient is
    with respect to the leaves of the model marked [`delucax.weight`][]. If no leaf is
    marked, the gradient is with respect to all floating-point arrays.
    [`delucax.training.fit`][] passes the trainable, unconstrained values as `model`.

    **Arguments:**

    - `loss`: a function `loss(model, key)` that returns a scalar, or a scalar and a
        dictionary of scalar metrics.
    - `model`: a pytree with weights.
    - `key`: a random key, for the loss.

    **Returns:** `(value, gradient)`: the output of the loss, and a pytree like the
    model, with `None` for each leaf that is not a weight.

    **Raises:** `ValueError` if the loss does not return a floating-point scalar, or
    `key` is not a random key.

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
    """The second output of `loss(model)`, and the gradient of the first."""
    weights, rest = weights_of(model)
    of = lambda weights: loss(eqx.combine(weights, rest))
    (_, value), gradient = eqx.filter_value_and_grad(of, has_aux=True)(weights)
    return value, gradient


class ClippedSamples(eqx.Module):
    r"""The mean gradient of several samples, after clipping the norm of each gradient.

    Over the $n$ samples whose cost and gradient $g_i$ are finite:

    $$g = \frac{1}{n} \sum_{i=1}^{n} \min\left(1, \frac{c}{\lVert g_i \rVert}\right)
    g_i, \qquad c = a\, \operatorname{median}_i \lVert g_i \rVert$$

    If the median of the norms is zero, the median over the nonzero gradients is used
    instead.

    Use `ClippedSamples` if the plant diverges in a few episodes. The gradient of a
    diverging episode can be larger than all other gradients together, while its
    direction is useless. A gradient that is not finite would even end the training.
    Call this estimator in the same way as [`delucax.training.analytic`][], with the
    loss of a single episode.

    **Arguments:**

    - `samples`: the number of gradients in one estimate, 32 by default.
    - `factor`: $a$, 5 by default. A small factor biases the estimate towards the
        gradient of a typical episode.

    **Returns:** a call returns `(value, gradient)`: the mean output of the loss over
    the finite samples, and a pytree like the model, with `None` for each leaf that is
    not a weight. Value and gradient are NaN if no sample is finite.

    **Raises:** `ValueError` if `samples` is below 1, or `factor` is not positive.

    Source: Abadi et al., 2016 (clipping each gradient); Andrew, Thakkar, McMahan and
    Ramaswamy, 2021 (clipping to a quantile).

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
        # Most gradients can be zero, if most episodes end at once. Then the median is
        # that of the others.
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
    r"""The gradient of a loss, estimated from differences of the loss along random
    directions.

    Antithetic, with $n$ = `samples / 2` directions $e_i \sim \mathcal{N}(0, I)$ and a
    key for each:

    $$g = \frac{1}{2 n \sigma} \sum_{i=1}^{n}
    \bigl(\ell(\theta + \sigma e_i) - \ell(\theta - \sigma e_i)\bigr)\, e_i$$

    One-sided, with $n$ = `samples` directions and one key for all:

    $$g = \frac{1}{n \sigma} \sum_{i=1}^{n}
    \bigl(\ell(\theta + \sigma e_i) - \ell(\theta)\bigr)\, e_i$$

    The mean of both estimates is the gradient of the smoothed loss
    $\mathbb{E}[\ell(\theta + \sigma e)]$. If the loss is quadratic, the smoothed loss
    has the same gradient as the loss itself. For other losses, the two gradients differ
    by a term of the order of $\sigma^2$. The loss need not be differentiable. All
    values of the loss are computed at once by `jax.vmap`. Call this estimator in the
    same way as [`delucax.training.analytic`][].

    **Arguments:**

    - `sigma`: $\sigma$, the standard deviation of the noise on the weights, positive.
        [`delucax.training.fit`][] adds the noise to the unconstrained values.
    - `samples`: the number of perturbed losses in one estimate; an even number if
        `antithetic` is true.
    - `antithetic`: whether to perturb the weights along both $e_i$ and $-e_i$; true by
        default. With opposite directions, the loss itself and all even powers of
        $\sigma$ in its Taylor series cancel.

    **Returns:** a call returns `(value, gradient)`: the output of the loss for the
    unperturbed weights, and a pytree like the model, with `None` for each leaf that is
    not a weight.

    **Raises:** `ValueError` if `sigma` is not positive, `samples` is below 1, or
    `samples` is odd while `antithetic` is true.

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
        gradient.K
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
                f"{where}: samples must be even when antithetic is true, got "
                f"{self.samples}."
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
        # The batch is theta, theta + sigma e_1, ... and, if antithetic, then
        # theta - sigma e_1, ... It has theta too, so that the loss is traced only once.
        sides = 2 if self.antithetic else 1
        ones, every = jnp.ones(n), jnp.arange(n)
        signs = jnp.concatenate([jnp.zeros(1), ones, -ones][: 1 + sides])
        directions = jnp.concatenate([jnp.zeros(1, int), *[every] * sides])
        # The two losses of a difference share a key, so that their noise cancels. If
        # one-sided, all losses are compared with the same one, so all share its key.
        keys = None
        if self.antithetic:
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
    r"""The likelihood-ratio gradient of an expected cost, as in REINFORCE.

    $$g = \frac{1}{n} \sum_{i=1}^{n} (c_i - b_i)\,
    \frac{\partial \log p_\theta(u_i)}{\partial \theta}$$

    The baseline $b_i$ is the mean cost of the other samples, or 0 if `baseline` is
    false. The mean of the estimate is the gradient of $\mathbb{E}[c]$, because the
    gradient of the log-probability has mean zero and $b_i$ does not depend on $u_i$.
    Only the log-probability is differentiated, never the cost or the plant.

    The loss must return `(cost, {"log_prob": ...})` for one draw.
    [`delucax.training.scored_cost`][] makes a loss of this kind from an environment. If
    you write such a loss yourself, follow two rules. First, compute the log-probability
    of `jax.lax.stop_gradient(u)`. For a draw such as `u = mean + std * e`, the
    log-probability of `u` itself has no gradient with respect to `mean`. Second, let
    the cost depend on the weights only through the draw `u`.

    The other gradient estimators accept this kind of loss too. Call this estimator in
    the same way as [`delucax.training.analytic`][].

    **Arguments:**

    - `samples`: $n$, the number of draws in one estimate.
    - `baseline`: whether to subtract the mean cost of the other draws; true by default.
        The baseline lowers the variance of the estimate without a bias.

    **Returns:** a call returns `(value, gradient)`: the mean cost and the mean metrics
    over the draws, and a pytree like the model, with `None` for each leaf that is not a
    weight.

    **Raises:** `ValueError` if `samples` is below 1, or below 2 with a baseline; when
    the estimator is called, if the loss returns no `"log_prob"`.

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
        gradient
        ```

        ```text
        Array(-1.781, dtype=float32, weak_type=True)
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
                f"{where}: samples must be at least 2 with a baseline, which is the "
                f"mean of the other samples, got {self.samples}."
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
                    f"the metrics {sorted(metrics)}. delucax.training.scored_cost "
                    "makes such a loss from an environment."
                )
            # The gradient of the cost through the draw would count the dependence on
            # the weights twice, so only the score keeps a gradient.
            excess = costs = lax.stop_gradient(costs)
            if self.baseline:
                # This factor turns the mean of all samples into that of the others.
                excess = (costs - jnp.mean(costs)) * (self.samples / (self.samples - 1))
            means = {name: jnp.mean(metric) for name, metric in metrics.items()}
            value = (jnp.mean(costs), lax.stop_gradient(means))
            # The gradient of this is the estimate. Its value has no meaning.
            return jnp.mean(excess * metrics["log_prob"]), value

        return gradient_of_weights(surrogate, model)


def cost_and_metrics(value: Any, where: str) -> tuple[Array, dict[str, Array]]:
    """The scalar and the metrics in the output of a loss, checked."""
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
