"""Keys of `jax.random` as arrays of two words each."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend.random import threefry_prng_impl as threefry


def is_key(dtype: Any) -> bool:
    """Whether arrays of this type are random keys."""
    return jnp.issubdtype(dtype, jax.dtypes.prng_key)


def is_ours(dtype: Any) -> bool:
    """Whether keys of this type belong to the generator that C has."""
    return str(dtype) == f"key<{threefry.tag}>"


def as_words(leaf: Any) -> Any:
    """The words of random keys, along a new last axis. Other arrays do not change."""
    return jax.random.key_data(leaf) if is_key(leaf.dtype) else leaf


def as_keys(leaf: Any, dtype: Any) -> Any:
    """The random keys that have these words, if `dtype` is a type of keys."""
    if not is_key(dtype):
        return leaf
    return jax.random.wrap_key_data(leaf, impl=threefry.name)


def form(aval: Any) -> tuple[tuple[int, ...], Any]:
    """The shape and the type of an array. For random keys, of their words."""
    if not is_key(aval.dtype):
        return tuple(aval.shape), aval.dtype
    return (*aval.shape, *threefry.key_shape), np.dtype(np.uint32)


def on_words(eqn: Any) -> Callable[..., Any] | None:
    """The function of words that does what an equation does to keys. `None` if the
    equation draws random numbers in a way that C cannot."""
    op, params = eqn.primitive.name, eqn.params
    (first, *_), (out, *_) = eqn.invars, eqn.outvars
    axes = len(first.aval.shape)
    if op in ("random_wrap", "random_unwrap", "random_clone"):
        return lambda words: words
    if op == "random_seed":
        return _each(threefry.seed, axes)
    if op == "random_split":
        return _each(lambda words: threefry.split(words, params["shape"]), axes)
    if op == "random_bits":
        width, shape = params["bit_width"], params["shape"]
        return _each(lambda words: threefry.random_bits(words, width, shape), axes)
    if op == "random_fold_in":
        shape = out.aval.shape

        def fold_in(words, data):
            words = jnp.broadcast_to(words, (*shape, *threefry.key_shape))
            data = jnp.broadcast_to(data, shape)
            return _each(threefry.fold_in, len(shape))(words, data)

        return fold_in
    if op.startswith("random"):
        return None
    # An operation that moves keys moves each of their words.
    along = [-1 if is_key(v.aval.dtype) else None for v in eqn.invars]
    return jax.vmap(lambda *ins: eqn.primitive.bind(*ins, **params), along, -1)


def _each(function: Callable[..., Any], axes: int) -> Callable[..., Any]:
    """The function, mapped over the axes of an array of keys."""
    for _ in range(axes):
        function = jax.vmap(function)
    return function
