"""The precision of a program: casts the arrays of a function, and sets JAX to it."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np


def dtype_of(tree: Any, given: Any, where: str) -> np.dtype:
    """The type of the real numbers: `given`, or by default the type of the arrays."""
    if given is not None:
        name = getattr(given, "__name__", None) or str(given)
        if name not in ("float32", "float64"):
            raise ValueError(
                f"{where}: dtype must be 'float32' or 'float64', got {given!r}."
            )
        return np.dtype(name)
    dtypes = [leaf.dtype for leaf in _arrays(tree) if _is_real(leaf)]
    kinds = [jax.dtypes.canonicalize_dtype(kind) for kind in dtypes]
    dtype = jnp.result_type(*kinds) if kinds else jnp.result_type(float)
    if dtype not in (np.float32, np.float64):
        raise ValueError(
            f"{where}: dtype must be 'float32' or 'float64', got arrays of {dtype}; "
            "give dtype= to cast them."
        )
    return np.dtype(dtype)


def _arrays(tree: Any) -> list[Any]:
    return [leaf for leaf in jax.tree.leaves(tree) if _is_array(leaf)]


def _is_array(leaf: Any) -> bool:
    return eqx.is_array(leaf) or isinstance(leaf, np.ndarray | np.generic)


def _is_real(leaf: Any) -> bool:
    return jnp.issubdtype(leaf.dtype, jnp.floating)


def cast(tree: Any, dtype: np.dtype) -> Any:
    """The tree with its real arrays in the precision `dtype`."""

    def one(leaf):
        if _is_array(leaf) and _is_real(leaf) and leaf.dtype != dtype:
            return jnp.asarray(np.asarray(leaf), dtype)
        return leaf

    return jax.tree.map(one, tree)


def precision(dtype: np.dtype) -> Any:
    """A context in which JAX computes in the precision `dtype`, in this thread only."""
    return jax.enable_x64(dtype == np.float64)
