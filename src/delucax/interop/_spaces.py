"""The spaces of actions and observations."""

import sys
from typing import Any

import jax.numpy as jnp
import jax.random as jr
import numpy as np
from jaxtyping import Array

from .._check import check_bool, FLOAT32_MAX, is_concrete
from .._typing import PRNGKey
from ..environments import Environment


def has_discrete_actions(env: Environment, discrete: bool | None, where: str) -> bool:
    """Whether actions are indices into the table `env.actions`. By default they are if
    the environment has such a table."""
    if discrete is None:
        return env.actions is not None
    if check_bool(discrete, "discrete", where) and env.actions is None:
        raise ValueError(
            f"{where}: discrete needs a table of actions, but the environment has none."
        )
    return bool(discrete)


def action_ends(env: Environment) -> tuple[Any, Any]:
    """The bounds `(low, high)` of the controls. An infinite bound becomes 1000, because
    users draw samples from the space."""
    return _finite_ends(env.control_bounds, env.control_size, 1e3)


def observation_ends(env: Environment, largest: float = FLOAT32_MAX) -> tuple[Any, Any]:
    """The bounds `(low, high)` of what `encode` returns. An infinite bound becomes
    `largest`."""
    bounds = env.observation_bounds
    bounds = (-FLOAT32_MAX, FLOAT32_MAX) if bounds is None else bounds
    return _finite_ends(bounds, env.feature_size, largest)


def _finite_ends(bounds: Any, size: int, largest: float) -> tuple[Any, Any]:
    """Finite bounds of shape `(size,)`, as NumPy arrays unless they are traced."""
    low, high = (-np.inf, np.inf) if bounds is None else bounds
    numpy = np if is_concrete(low) and is_concrete(high) else jnp
    finite = lambda end: numpy.nan_to_num(end, posinf=largest, neginf=-largest)
    low, high = (numpy.broadcast_to(finite(end), (size,)) for end in (low, high))
    return low, high


class Box:
    """The space of arrays between two bounds."""

    def __init__(self, low: Any, high: Any, shape: tuple[int, ...], dtype: Any):
        self.low, self.high = low, high
        self.shape, self.dtype = shape, dtype

    def sample(self, key: PRNGKey) -> Array:
        """A uniform draw."""
        # Not from low + share * (high - low): the width of a space without bounds is
        # beyond the largest number.
        share = jr.uniform(key, self.shape, self.dtype)
        return share * self.high + (1 - share) * self.low

    def contains(self, x: Any) -> Array:
        """Whether `x` lies between the bounds."""
        return jnp.all((x >= self.low) & (x <= self.high))

    def __repr__(self):
        return f"Box({self.low}, {self.high}, {self.shape}, {self.dtype})"


class Discrete:
    """The space of the whole numbers from 0 to `n - 1`."""

    def __init__(self, n: int):
        self.n, self.shape, self.dtype = n, (), jnp.zeros((), int).dtype

    def sample(self, key: PRNGKey) -> Array:
        """A uniform draw."""
        return jr.randint(key, (), 0, self.n, self.dtype)

    def contains(self, x: Any) -> Array:
        """Whether `x` is one of these numbers."""
        return (jnp.asarray(x) >= 0) & (jnp.asarray(x) < self.n)

    def __repr__(self):
        return f"Discrete({self.n})"


def gymnax_space(space: int | tuple[Any, Any]) -> Any:
    """A `Discrete` of a given size, or a `Box` between two bounds.

    If gymnax has been imported, these are the classes of gymnax, because code for
    gymnax checks them with `isinstance`.
    """
    classes: Any = sys.modules.get("gymnax.environments.spaces", sys.modules[__name__])
    if isinstance(space, int):
        return classes.Discrete(space)
    # Bounds are floats if all entries are equal: rejax needs a hashable space.
    is_number = lambda end: is_concrete(end) and np.all(end == end[0])
    low, high = (float(e[0]) if is_number(e) else jnp.asarray(e) for e in space)
    return classes.Box(low, high, space[0].shape, jnp.zeros(()).dtype)
