"""Networks whose initial weights are drawn by one program, whatever their sizes."""

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
    """A fully connected network with a linear last layer. Its functions are modules, so
    that compiled functions take it as an argument."""
    functions = as_module(activation), as_module(jax.nn.identity)
    given = inputs, outputs, width, depth, *functions
    if isinstance(options["key"], Tracer):
        return _traced(*given, **options)
    return _drawn(*given, **options)


def _drawn(*given: Any, key: Any, **options: Any) -> eqx.nn.MLP:
    """The network that `eqx.nn.MLP` makes from the same key.

    A random number generator takes half a second to compile, and Equinox compiles two
    for each layer of each network. Here all keys are one batch. A number depends only
    on its key and its place, so more numbers may be drawn than needed. Networks of
    other sizes then share the program.
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
    """Two rows of numbers for each limit, uniform within plus and minus the limit."""
    pairs = jax.vmap(jr.split)(jr.split(key, len(limits)))
    row = lambda key, limit: jr.uniform(
        key, (columns,), limit.dtype, minval=-limit, maxval=limit
    )
    return jax.vmap(jax.vmap(row, (0, None)))(pairs, limits)


def _at_least(start: int, needed: int) -> int:
    """`start`, doubled until it reaches `needed`."""
    return start * 2 ** max(0, math.ceil(math.log2(needed / start)))
