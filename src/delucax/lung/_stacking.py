"""Several modules as one, to be mapped over."""

from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from .._check import is_concrete


def stack(trees: Sequence[Any]) -> Any:
    """Modules of one structure as one, each array with a leading axis over them.

    **Arguments:** `trees`: the modules.

    **Returns:** the stacked module.

    **Raises:** `ValueError` if `trees` is empty, or their structures differ.

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
        raise ValueError("stack: trees must be of one structure.")

    def together(*leaves):
        if not eqx.is_array(leaves[0]):
            return leaves[0]
        if all(_is_plain(leaf) for leaf in leaves):
            return jnp.asarray(np.stack(leaves))
        return jnp.stack(leaves)

    return jax.tree.map(together, *trees)


def unstack(tree: Any) -> list[Any]:
    """The modules that [`delucax.lung.stack`][] made one of.

    **Arguments:** `tree`: the stacked module.

    **Returns:** a list of modules.

    !!! example

        ```python
        from delucax.lung import SingleCompartment, stack, unstack

        unstack(stack([SingleCompartment(r) for r in (5.0, 20.0)]))[1].resistance
        ```
    """
    arrays, rest = eqx.partition(tree, eqx.is_array)
    arrays = jax.tree.map(lambda a: np.asarray(a) if _is_plain(a) else a, arrays)
    return [
        eqx.combine(jax.tree.map(lambda a, i=i: jnp.asarray(a[i]), arrays), rest)
        for i in range(count_of(tree))
    ]


def _is_plain(leaf: Any) -> bool:
    """Whether NumPy can stack and slice it, which compiles nothing for each shape."""
    is_key = jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key)
    return is_concrete(leaf) and not is_key


def count_of(tree: Any) -> int:
    """How many modules are stacked."""
    return jax.tree.leaves(eqx.filter(tree, eqx.is_array))[0].shape[0]
