"""The score-function gradient, for controllers that draw their controls."""

from typing import Any

import equinox as eqx
import jax
import jax.lax as lax
import jax.numpy as jnp
import jax.random as jr
from jaxtyping import PyTree

from .._check import check_count, check_key
from .._typing import PRNGKey
from ._analytic import gradient_of_weights
from ._loss import cost_and_metrics


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
        import jax
        import jax.numpy as jnp

        def loss(mean, key):
            u = jax.lax.stop_gradient(mean + jax.random.normal(key))
            return (u - 1.0) ** 2, {"log_prob": -0.5 * (u - mean) ** 2}

        estimator = dlx.training.LikelihoodRatio(samples=1000)
        value, gradient = estimator(loss, jnp.asarray(0.0), jax.random.key(0))
        ```
    """

    samples: int = eqx.field(static=True)
    baseline: bool = eqx.field(static=True, default=True)

    def __check_init__(self):
        where = "LikelihoodRatio"
        check_count(self.samples, "samples", where)
        if self.baseline and self.samples < 2:
            raise ValueError(
                f"{where}: samples must be at least 2 with a baseline, the mean of the "
                f"others, got {self.samples}."
            )

    def __call__(self, loss, model, key: PRNGKey) -> tuple[Any, PyTree]:
        check_key(key, "LikelihoodRatio")

        def surrogate(model):
            def draw(key):
                return cost_and_metrics(loss(model, key), "LikelihoodRatio")

            costs, metrics = jax.vmap(draw)(jr.split(key, self.samples))
            if "log_prob" not in metrics:
                raise ValueError(
                    "LikelihoodRatio: loss must return (cost, {'log_prob': ...}), got "
                    f"the metrics {sorted(metrics)}; delucax.training.scored_cost "
                    "makes such a loss of an environment."
                )
            costs = lax.stop_gradient(costs)
            excess = costs
            if self.baseline:
                # The mean of the others differs from that of all by this factor.
                excess = (costs - jnp.mean(costs)) * (self.samples / (self.samples - 1))
            means = {name: jnp.mean(metric) for name, metric in metrics.items()}
            value = (jnp.mean(costs), lax.stop_gradient(means))
            return jnp.mean(excess * metrics["log_prob"]), value

        return gradient_of_weights(surrogate, model)
