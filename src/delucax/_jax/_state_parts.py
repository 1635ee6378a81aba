"""The state of a loop as its components.

Each component of a batch is then a vector of its own that stays in registers.
"""

import jax.numpy as jnp
from jaxtyping import Array

from ._components import LARGEST as COMPONENTS_UP_TO


_STACKED_FIRST_UP_TO = 6
"""Trajectories of more components are extended before they are stacked."""


def split_state(x: Array) -> tuple[Array, ...]:
    """A small state as its components, which is how loops carry it."""
    return tuple(x) if x.shape[0] <= COMPONENTS_UP_TO else (x,)


def join_state(parts: tuple[Array, ...], size: int) -> Array:
    """The inverse of `split_state`."""
    return jnp.stack(parts) if size <= COMPONENTS_UP_TO else parts[0]


def stack_steps(
    parts: tuple[Array, ...], size: int, last: tuple[Array, ...] = ()
) -> Array:
    """Vectors over time, shape `(T, size)`, from the components of each step.

    `last` is put behind them: of a few components when they are one array, of more
    one by one, which is what a batch on CPU transposes fastest. (And a loop that keeps
    the state before each step, not the one after it, does not tempt XLA to compute the
    step twice, once to carry it and once to keep it.)
    """
    if size <= _STACKED_FIRST_UP_TO:
        # A reshape of one component is free, where a stack would copy it.
        steps = parts[0][:, None] if size == 1 else jnp.stack(parts, axis=1)
        if last:
            steps = jnp.concatenate([steps, jnp.stack(last)[None].astype(steps.dtype)])
        return steps
    if last:
        parts = tuple(
            jnp.concatenate([a, b[None].astype(a.dtype)])
            for a, b in zip(parts, last, strict=True)
        )
    return jnp.stack(parts, axis=1) if size <= COMPONENTS_UP_TO else parts[0]
