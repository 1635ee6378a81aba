"""Modules that are stacked over lungs, over seeds, or over both."""

from typing import Any, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp

from ... import lung


_T = TypeVar("_T")


def repeated(tree: _T, count: int) -> _T:
    """One module, stacked as often as asked for."""
    return lung.stack([tree] * count)


def taken(tree: _T, index: Any) -> _T:
    """What an index takes of each array of stacked modules."""
    return jax.tree.map(lambda a: a[index] if eqx.is_array(a) else a, tree)


def joined(one: _T, other: _T) -> _T:
    """Stacked modules, and others of the same structure after them."""
    join = lambda a, b: jnp.concatenate([a, b]) if eqx.is_array(a) else a
    return jax.tree.map(join, one, other)
