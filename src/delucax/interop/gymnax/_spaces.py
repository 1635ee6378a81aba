"""The spaces of the gymnax protocol."""

import sys
from typing import Any

import jax.numpy as jnp
import jax.random as jr
import numpy as np
from jaxtyping import Array

from ..._check import is_concrete
from ..._typing import PRNGKey
from .._adapter import finite_ends


class Box:
    """The arrays between two ends."""

    def __init__(self, low: Any, high: Any, shape: tuple[int, ...], dtype: Any):
        self.low, self.high = low, high
        self.shape, self.dtype = shape, dtype

    def sample(self, key: PRNGKey) -> Array:
        """A uniform draw."""
        return jr.uniform(key, self.shape, self.dtype, self.low, self.high)

    def contains(self, x: Any) -> Array:
        """Whether `x` lies between the ends."""
        return jnp.all((x >= self.low) & (x <= self.high))

    def __repr__(self):
        return f"Box({self.low}, {self.high}, {self.shape}, {self.dtype})"


class Discrete:
    """The whole numbers from 0 to `n - 1`."""

    def __init__(self, n: int):
        self.n, self.shape, self.dtype = n, (), jnp.zeros((), int).dtype

    def sample(self, key: PRNGKey) -> Array:
        """A uniform draw."""
        return jr.randint(key, (), 0, self.n, self.dtype)

    def contains(self, x: Any) -> Array:
        """Whether `x` is one of them."""
        return (jnp.asarray(x) >= 0) & (jnp.asarray(x) < self.n)

    def __repr__(self):
        return f"Discrete({self.n})"


def separates_ends() -> bool:
    """Whether `step` should return `terminated` and `truncated`: gymnax expects both
    since 1.0, and rejax, which imports any gymnax, expects `done`.
    """
    theirs = sys.modules.get("gymnax.environments.environment")
    two = hasattr(getattr(theirs, "Environment", None), "is_truncated")
    return two and "rejax" not in sys.modules


def _spaces() -> Any:
    """The module of `Box` and `Discrete`: gymnax's own where gymnax is in use, for its
    clients ask for the class."""
    return sys.modules.get("gymnax.environments.spaces", sys.modules[__name__])


def discrete_space(n: int) -> Any:
    """The whole numbers from 0 to `n - 1`."""
    return _spaces().Discrete(n)


def box_space(bounds: Any, size: int, largest: float) -> Any:
    """The vectors within bounds; a side without a bound ends at the largest number."""
    low, high = map(_number_if_one, finite_ends(bounds, size, largest))
    return _spaces().Box(low, high, (size,), jnp.zeros(()).dtype)


def _number_if_one(end: Any) -> Any:
    """A float if all entries are one, for networks want what has a hash."""
    if is_concrete(end) and np.all(end == end[0]):
        return float(end[0])
    return jnp.asarray(end)
