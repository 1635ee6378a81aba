"""Training without derivatives: natural evolution strategies."""

from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
import optax
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, PyTree

from .._check import check_count, check_positive
from .._module import weight
from .._typing import PRNGKey
from ._fit import fit, Fitted
from ._gradient_estimators import cost_and_metrics
from ._trainable import partition_trainable


_WHERE = "evolve"
_SPREAD = "log_std"


class _Search(eqx.Module):
    """A normal distribution of models: the mean, and the log of each deviation."""

    mean: PyTree
    log_std: Array = weight()


class _OfMean(eqx.Module):
    """The loss of the mean model of a `_Search`."""

    loss: Callable[..., Any]

    def __call__(self, search: _Search, key: PRNGKey) -> Any:
        return self.loss(search.mean, key)


class _NaturalGradient(eqx.Module):
    """An estimator for `fit`: the natural gradient of the expected utility."""

    population: int = eqx.field(static=True)

    def __call__(self, loss: Any, values: dict[str, Array], key: PRNGKey) -> Any:
        log_std = values[_SPREAD]
        means = {path: value for path, value in values.items() if path != _SPREAD}
        mean, as_tree = ravel_pytree(means)
        size, half = mean.size, self.population // 2
        draw_key, loss_key = jr.split(key)
        noise = jr.normal(draw_key, (half, size), mean.dtype)
        noise = jnp.concatenate([noise, -noise])
        std = jnp.exp(log_std)

        def cost_of(e):
            # All models of a generation get the same key, so that only their weights
            # make a difference.
            value = loss(as_tree(mean + std * e) | {_SPREAD: log_std}, loss_key)
            return cost_and_metrics(value, _WHERE)[0]

        costs = jax.vmap(cost_of)(noise)
        # A model that diverges ranks last.
        order = jnp.argsort(jnp.where(jnp.isnan(costs), jnp.inf, costs))
        utility = jnp.zeros(2 * half, mean.dtype).at[order].set(_utilities(2 * half))
        rate = (3 + np.log(size)) / (5 * np.sqrt(size))
        slope = as_tree(-std * (utility @ noise))
        slope[_SPREAD] = -rate / 2 * (utility @ (noise**2 - 1))
        return jnp.nanmin(costs), slope


def _utilities(count: int) -> Array:
    """The utilities of the ranks, from the best to the worst. They sum to zero."""
    shares = np.maximum(0, np.log(count / 2 + 1) - np.log(np.arange(count) + 1))
    return jnp.asarray(shares / shares.sum() - 1 / count)


def evolve(
    loss: Callable[..., Any],
    model: PyTree,
    steps: int,
    *,
    key: PRNGKey,
    population: int = 64,
    sigma: Any = 1.0,
    trainable: Any = None,
    block: int = 50,
    progress: bool = True,
    callbacks: Sequence[Callable[[int, dict[str, float]], Any]] = (),
    throw: bool = True,
) -> Fitted:
    r"""Train a model without derivatives, by separable natural evolution strategies.

    Each generation draws weights $\mu + \sigma \odot e_i$ from a normal distribution,
    where the $e_i \sim \mathcal{N}(0, I)$ come in pairs of opposite sign. The draws are
    ranked by their losses, and the rank of each draw gives its utility $v_i$. For $d$
    weights:

    $$\mu \leftarrow \mu + \sigma \odot \sum_i v_i e_i, \qquad
    \log \sigma \leftarrow \log \sigma + \frac{\eta}{2} \sum_i v_i (e_i^2 - 1),
    \qquad \eta = \frac{3 + \log d}{5 \sqrt{d}}$$

    `evolve` uses only the order of the losses, not their values. So `evolve` also works
    if the loss jumps or is flat almost everywhere, such as a reward at the end of an
    episode. `evolve` works best for up to a few hundred weights.

    **Arguments:**

    - `loss`: a function `loss(model, key)` that returns a scalar; for example from
        [`delucax.training.expected_cost`][]. All models of a generation get the same
        key.
    - `model`: a controller or any other pytree; the initial $\mu$.
    - `steps`: the number of generations, at least 1.
    - `key`: a random key.
    - `population`: models in a generation, an even number of at least 4; 64 by default.
    - `sigma`: the initial $\sigma$, one positive number for all weights; 1 by default.
    - `trainable`: the path of the part to train, such as `"correction"`, or several
        paths; the fields marked [`delucax.weight`][] by default.
    - `block`, `progress`, `callbacks`, `throw`: as in [`delucax.training.fit`][], with
        blocks of 50 generations by default.

    **Returns:** a [`delucax.training.Fitted`][]. The `model` of the result is the mean
    $\mu$, and the `history` holds the smallest loss of each generation.

    **Raises:** `ValueError` if an argument has the wrong type or range. `RuntimeError`
    if no model of a generation has a finite loss, unless `throw` is false.

    Source: Wierstra, Schaul, Glasmachers, Sun, Peters and Schmidhuber, 2014.

    !!! example

        ```python
        import delucax as dlx
        import jax

        env = dlx.make("mountain_car", horizon=200)
        policy = dlx.controllers.mlp_policy(env, 4, 1, key=jax.random.key(0))
        loss = dlx.training.expected_cost(env, batch=2)
        key = jax.random.key(1)
        fitted = dlx.training.evolve(loss, policy, 5, key=key, population=16)
        fitted.history.loss
        ```
    """
    population = check_count(population, "population", _WHERE, least=4)
    if population % 2:
        raise ValueError(f"{_WHERE}: population must be even, got {population}.")
    check_positive(sigma, "sigma", _WHERE)
    paths = (trainable,) if isinstance(trainable, str) else trainable
    if paths is not None and not (
        isinstance(paths, tuple | list) and all(isinstance(p, str) for p in paths)
    ):
        raise ValueError(
            f"{_WHERE}: trainable must be a path or several paths, got {trainable!r}."
        )
    _, values = partition_trainable(model, trainable, _WHERE)
    size = sum(value.size for value in values.values())
    dtype = jnp.result_type(*values.values())
    search = _Search(model, jnp.full(size, np.log(sigma), dtype))
    options: Any = dict(key=key, block=block, progress=progress, throw=throw)
    estimator = _NaturalGradient(population)
    options |= dict(callbacks=callbacks, gradient=estimator)
    if paths is not None:
        options["trainable"] = (*(f"mean.{path}" for path in paths), _SPREAD)
    # The estimator returns whole steps, so the learning rate is 1.
    fitted = fit(_OfMean(loss), search, optax.sgd(1.0), steps, **options)
    return Fitted(fitted.model.mean, fitted.history, fitted.result)
