"""A first state from a box."""

from typing import Any

import equinox as eqx
import jax.random as jr
import numpy as np
from jaxtyping import Array

from .._check import as_bounds, check_key
from .._module import parameter
from .._typing import PRNGKey


class UniformState(eqx.Module):
    """A first state drawn uniformly from a box.

    **Arguments:** `low`, `high`: vectors, the corners of the box.

    **Raises:** `ValueError` if the corners differ in size or `low` is above `high`.

    !!! example

        ```python
        import delucax as dlx
        import jax
        import jax.numpy as jnp

        start = dlx.environments.UniformState(-jnp.ones(2), jnp.ones(2))
        start(jax.random.key(0))
        ```
    """

    low: Array = parameter()
    high: Array = parameter()

    def __init__(self, low: Any, high: Any):
        self.low = low
        self.high = high

    def __check_init__(self):
        size = np.size(self.low)
        as_bounds((self.low, self.high), "UniformState", "low and high", size)

    def __call__(self, key: PRNGKey) -> Array:
        """A state drawn with `key`."""
        check_key(key, "UniformState")
        unit = jr.uniform(key, self.low.shape, self.low.dtype)
        return self.low + (self.high - self.low) * unit
