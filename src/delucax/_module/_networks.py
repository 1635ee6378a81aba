"""Networks whose first weights are drawn by one program, whatever their sizes."""

import math
from collections.abc import Callable
from typing import Any, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
from jax.core import Tracer

from ._fields import as_module


def mlp(
    inputs: int | Literal["scalar"],
    outputs: int | Literal["scalar"],
    width: int,
    depth: int,
    activation: Callable = jnp.tanh,
    **options: Any,
) -> eqx.nn.MLP:
    """A fully connected network, linear at its end, that compiled functions take."""
    functions = as_module(activation), as_module(jax.nn.identity)
    given = inputs, outputs, width, depth, *functions
    if isinstance(options["key"], Tracer):
        return _traced(*given, **options)
    return _drawn(*given, **options)


def _drawn(*given: Any, key: Any, **options: Any) -> eqx.nn.MLP:
    """The network of `eqx.nn.MLP` with the same key.

    A generator of random numbers takes half a second to compile, and Equinox has two
    of them for each layer and network. Here all keys are one batch. A number depends on
    its place alone: more are drawn than needed, so that other networks share the
    program.
    """
    blank = eqx.filter_eval_shape(eqx.nn.MLP, *given, key=key, **options)
    drawn = [part for layer in blank.layers for part in (layer.weight, layer.bias)]
    layers = len(blank.layers)
    rows = _at_least(4, layers)
    columns = _at_least(4096, max(math.prod(part.shape) for part in drawn))
    limits = np.ones(rows, drawn[0].dtype)
    limits[:layers] = [1 / math.sqrt(layer.weight.shape[1]) for layer in blank.layers]
    numbers = _uniform(key, limits, columns)
    if not isinstance(numbers, Tracer):
        numbers = np.asarray(numbers)
    parts = [
        numbers[i // 2, i % 2, : math.prod(part.shape)].reshape(part.shape)
        for i, part in enumerate(drawn)
    ]
    if not isinstance(numbers, Tracer):
        parts = jax.device_put([part.copy() for part in parts])
    where = lambda net: [p for layer in net.layers for p in (layer.weight, layer.bias)]
    return eqx.tree_at(where, blank, parts)


_traced = eqx.filter_jit(_drawn)


@eqx.filter_jit
def _uniform(key: Any, limits: Any, columns: int) -> Any:
    """For each of the limits two rows of numbers within them."""
    pairs = jax.vmap(jr.split)(jr.split(key, len(limits)))
    row = lambda key, limit: jr.uniform(
        key, (columns,), limit.dtype, minval=-limit, maxval=limit
    )
    return jax.vmap(jax.vmap(row, (0, None)))(pairs, limits)


def _at_least(start: int, needed: int) -> int:
    """`start`, doubled until it is enough."""
    return start * 2 ** max(0, math.ceil(math.log2(needed / start)))
