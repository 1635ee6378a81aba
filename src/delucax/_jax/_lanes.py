"""Batches of problems that end at different times."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.lax as lax
from jax.custom_batching import custom_vmap


def by_lanes(function: Callable[..., Any], *args: Any) -> Any:
    """`function(*args)`, arrays; a batch of it on CPU is run one after the other.

    In a batch each iteration waits for the longest line search and the last lane, and
    on CPU nothing is gained in return: one after the other takes about as long at
    worst, and a sixth at best. Accelerators run the batch as one.
    """
    # What a cost or a constraint of the user's closes over is batched with the rest.
    # Equinox looks into functions with a closure alone, such as this lambda.
    closed = eqx.filter_closure_convert(lambda *args: function(*args), *args)
    arrays, static = eqx.partition((closed, args), eqx.is_array)
    leaves, structure = jax.tree.flatten(arrays)

    def evaluate(*leaves):
        arrays = jax.tree.unflatten(structure, leaves)
        closed, args = eqx.combine(arrays, static)
        return closed(*args)

    run = custom_vmap(evaluate)

    @run.def_vmap
    def _(size, batched, *leaves):
        del size
        lanes, shared = eqx.partition(list(leaves), list(batched))
        of = lambda f: lambda lane: f(*eqx.combine(lane, shared))
        out = lax.platform_dependent(
            lanes,
            cpu=lambda lanes: lax.map(of(run), lanes),
            default=jax.vmap(of(evaluate)),
        )
        return out, jax.tree.map(lambda _: True, out)

    return run(*leaves)
