"""Loops that XLA compiles in parts, and loops that end early and have derivatives."""

import math
from collections.abc import Callable
from typing import Any

import equinox.internal as eqxi
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array


def in_parts(body: Callable[[Any], Any]) -> Callable[[Any], Any]:
    """The body of a long loop, changed so that XLA compiles it in parts. Its carry must
    hold an integer.

    On CPU, XLA compiles a loop over small arrays into one function of machine code. For
    a solver that takes two or three times as long to compile, on one core, and runs up
    to 15% faster. XLA leaves a loop in parts if its body calls a library. Here a call
    without effect is added.
    """

    def called(carry):
        leaves, structure = jax.tree.flatten(body(carry))
        is_count = lambda a: jnp.ndim(a) == 0 and jnp.issubdtype(a.dtype, jnp.integer)
        index = next(i for i, leaf in enumerate(leaves) if is_count(leaf))
        count = leaves[index]
        leaves[index] = count + lax.platform_dependent(
            count, cpu=_zero_by_call, default=jnp.zeros_like
        )
        return jax.tree.unflatten(structure, leaves)

    return called


def _zero_by_call(count: Array) -> Array:
    """Zero, in a way that XLA does not simplify: the square root of one, minus one."""
    one = (1 + 0 * count.astype(jnp.float32)).reshape(1, 1)
    root = lax.linalg.cholesky(one, symmetrize_input=False)[0, 0]
    return (root - 1).astype(count.dtype)


def bounded_while(
    needed: Callable[[Any], Array], turn: Callable[[Any], Any], state: Any, most: int
) -> Any:
    """Apply `turn` to `state` while `needed(state)` holds, `most` times if need be.

    The turns are taken in blocks, so there may be a few more. If these would be wrong,
    `needed` must count the turns.

    It has derivatives in both modes, which store the state at each turn and compute the
    rest again. Turns that are not needed are skipped: all by one test, or in blocks. In
    a batch, a turn runs if one member needs it, so `turn` must leave the other members
    as they are.
    """
    turn = jax.checkpoint(turn)

    def repeated(inner, times):
        def body(state, _):
            run = eqxi.unvmap_any(needed(state))
            return lax.cond(run, inner, lambda state: state, state), None

        return lambda state: lax.scan(body, state, length=times)[0]

    block = max(1, math.isqrt(most))
    return repeated(repeated(repeated(turn, block), -(-most // block)), 1)(state)
