"""What a loss is, with a memory or without, and what it returns."""

import abc
from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, PyTree

from .._typing import PRNGKey


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


class AbstractSurrogate(eqx.Module):
    """A loss that is made of what happens on the way: it has a memory.

    [`delucax.training.fit`][] makes the calls: `init` once; then at each step `update`,
    which may run the model, and the loss `surrogate(model, memory, key)` of what is
    remembered, whose gradient any estimator takes; in the end `finished`. All are pure,
    so that the whole runs in the one loop, is `vmap`ped over seeds, and goes on from a
    checkpoint. [`delucax.training.PPO`][] and [`delucax.training.SHAC`][] are two.

    !!! example

        ```python
        import delucax as dlx
        import jax
        import jax.numpy as jnp
        import optax

        class Steadied(dlx.training.AbstractSurrogate):
            "Descend to 1, but never far from a running mean."

            def init(self, model, key):
                return model.K

            def update(self, model, memory, step, key):
                return 0.9 * memory + 0.1 * model.K

            def __call__(self, model, memory, key):
                return jnp.sum((model.K - 1) ** 2 + (model.K - memory) ** 2)

        controller = dlx.controllers.Linear(jnp.zeros((1, 2)))
        key = jax.random.key(0)
        fitted = dlx.training.fit(Steadied(), controller, optax.adam(0.1), 10, key=key)
        ```
    """

    @abc.abstractmethod
    def init(self, model: PyTree, key: PRNGKey) -> PyTree:
        """The memory before the first step.

        **Arguments:** `model`: the model. `key`: a random key.

        **Returns:** a pytree of arrays.
        """

    @abc.abstractmethod
    def update(self, model: PyTree, memory: PyTree, step: Any, key: PRNGKey) -> PyTree:
        """The memory for a step; no gradient is taken through it.

        **Arguments:**

        - `model`: the model before the step.
        - `memory`: that of the step before.
        - `step`: the number of the step, from 0.
        - `key`: a random key.

        **Returns:** a pytree of the same structure, shapes and dtypes.
        """

    @abc.abstractmethod
    def __call__(self, model: PyTree, memory: PyTree, key: PRNGKey) -> Any:
        """The loss.

        **Arguments:**

        - `model`: the model.
        - `memory`: that of the step.
        - `key`: a random key.

        **Returns:** a scalar, or a scalar and a dictionary of scalar metrics.
        """

    def finished(self, model: PyTree, memory: PyTree) -> PyTree:
        """The model with what was learned beside its weights; as it is by default.

        **Arguments:** `model`: the model. `memory`: that of the last step.

        **Returns:** the model.
        """
        del memory
        return model
