"""Stacks of modules that have the same structure."""

from collections.abc import Iterable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer

from .._message import shortened


def stack(trees: Iterable[Any]) -> Any:
    """Stack modules of the same structure into one. Each array gets a leading axis over
    the modules, for `jax.vmap`.

    **Arguments:**

    - `trees`: the modules, at least one.

    **Returns:** the stacked module.

    **Raises:** `ValueError` if `trees` is empty, or if the modules have different
    structures or different numbers in a field that is not an array.

    !!! example

        ```python
        from delucax.lung import SingleCompartment, stack

        stack([SingleCompartment(r) for r in (5.0, 20.0, 50.0)]).resistance
        ```
    """
    trees = list(trees)
    if not trees:
        raise ValueError("stack: trees must not be empty.")
    structures = {jax.tree.structure(eqx.filter(tree, eqx.is_array)) for tree in trees}
    if len(structures) > 1:
        raise ValueError("stack: trees must have the same structure.")

    def together(*leaves):
        if not isinstance(leaves[0], np.ndarray | jax.Array):
            known = isinstance(leaves[0], int | float | complex | str)
            if known and any(leaf != leaves[0] for leaf in leaves):
                raise ValueError(
                    "stack: trees must be the same but for their arrays, got "
                    f"{', '.join(map(shortened, leaves))}."
                )
            return leaves[0]
        if all(_is_plain(leaf) for leaf in leaves):
            return jnp.asarray(np.stack(leaves))
        return jnp.stack(leaves)

    return jax.tree.map(together, *trees)


def unstack(tree: Any) -> list[Any]:
    """Take a stack from [`delucax.lung.stack`][] apart.

    **Arguments:**

    - `tree`: the stacked module.

    **Returns:** a list of modules.

    !!! example

        ```python
        from delucax.lung import SingleCompartment, stack, unstack

        unstack(stack([SingleCompartment(r) for r in (5.0, 20.0)]))[1].resistance
        ```
    """
    as_numpy = lambda a: np.asarray(a) if eqx.is_array(a) and _is_plain(a) else a
    tree = jax.tree.map(as_numpy, tree)
    return [taken(tree, i) for i in range(count_of(tree))]


def taken(tree: Any, index: Any) -> Any:
    """The stacked modules at an index or a slice."""
    is_array = lambda a: eqx.is_array(a) or isinstance(a, np.ndarray)
    at = lambda a: jnp.asarray(a[index]) if is_array(a) else a
    return jax.tree.map(at, tree)


def count_of(tree: Any) -> int:
    """The number of stacked modules."""
    return jax.tree.leaves(eqx.filter(tree, eqx.is_array))[0].shape[0]


def _is_plain(leaf: Any) -> bool:
    """Whether NumPy can stack and slice it, without compiling a program per shape."""
    is_key = jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key)
    return not isinstance(leaf, Tracer) and not is_key
