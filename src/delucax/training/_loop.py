"""The compiled part of the training loop."""

from typing import Any

import equinox as eqx
import jax
import jax.lax as lax
import jax.numpy as jnp
import jax.random as jr
import optax

from ._history import COLUMNS
from ._loss import cost_and_metrics
from ._trainable import strong


_WHERE = "fit"
# Folded into the key for the order of the data and for the first memory of a surrogate;
# no step counts as far.
_ORDER = 2**32 - 1
_MEMORY = 2**32 - 2
CAPACITY = 1000
"""The most steps in a block. It is the size of the buffers whatever the block, so that
the compiled program, and with it every last bit, is the same for all."""
FAULTS = ("nothing", "loss", "gradient", "update")
"""What is not finite, by the number that a block returns."""


def first_state(optimiser, values, lanes):
    """What an optimiser begins with; `lanes` of it, or one where that is `None`."""
    return _over_lanes(optimiser.init, lanes)(values)


@eqx.filter_jit
def first_memory(loss, model, key, lanes):
    """What a surrogate begins with."""

    def begin(model, key):
        memory = loss.init(model, jr.fold_in(key, _MEMORY))
        if not all(eqx.is_array(leaf) for leaf in jax.tree.leaves(memory)):
            raise ValueError(
                f"{_WHERE}: the memory of {type(loss).__name__} must be a pytree of "
                f"arrays, got {memory!r}."
            )
        return jax.tree.map(strong, memory)

    return _over_lanes(begin, lanes)(model, key)


@eqx.filter_jit
def finished(loss, model, memory, lanes):
    """The model with what a surrogate learned beside its weights."""
    return _over_lanes(loss.finished, lanes)(model, memory)


@eqx.filter_jit
def run_block(functions, carry, inputs, span, batch_size, lanes):
    """The steps from `span[0]` up to `span[1]`, at most `CAPACITY` of them."""
    loss, gradient, optimiser, static, assembly = functions
    key, data = inputs
    optimiser = optax.with_extra_args_support(optimiser)

    def lane(assembly, key, values, state, memory, order, before, k):
        own_key = jr.fold_in(key, k)
        if data is None:
            arguments = ()
        elif batch_size is None:
            arguments = (data,)
        else:
            rows, order = _drawn_rows(jr.fold_in(key, _ORDER), order, k, batch_size)
            arguments = (jax.tree.map(lambda leaf: leaf[rows], data),)
        known = memory
        if memory is not None:
            own_key, memory_key = jr.split(own_key)
            memory = loss.update(assembly(values), memory, k, memory_key)
            _check_memory(loss, known, memory)
            arguments = (memory,)

        def of(values, key):
            return loss(assembly(values), *arguments, key)

        value, slope = gradient(of, values, own_key)
        cost, metrics = cost_and_metrics(value, _WHERE)
        _check_like(slope, values)
        slope = jax.tree.map(lambda g, v: g.astype(v.dtype), slope, values)
        if taken := sorted(set(metrics) & set(COLUMNS)):
            raise ValueError(
                f"{_WHERE}: metrics must not be called {', '.join(COLUMNS)}; got "
                f"{taken[0]!r}."
            )
        updates, after = optimiser.update(
            slope,
            eqx.combine(state, static),
            values,
            value=cost,
            grad=slope,
            value_fn=lambda v: cost_and_metrics(of(v, own_key), _WHERE)[0],
        )
        moved = jax.tree.map(lambda v, d: (v + d).astype(v.dtype), values, updates)
        norm = _norm(slope)
        fault = jnp.where(
            ~jnp.isfinite(cost),
            1,
            jnp.where(~jnp.isfinite(norm), 2, jnp.where(_is_finite(moved), 0, 3)),
        ).astype(jnp.int32)
        # One of several that went wrong stays as it was while the others go on.
        fault = fault if lanes is None else jnp.where(before == 0, fault, before)
        # Kept in the precision that it began with, or the loop would not close.
        after = jax.tree.map(
            lambda new, old: new if new.dtype == old.dtype else new.astype(old.dtype),
            eqx.filter(after, eqx.is_array),
            state,
        )
        values, state, memory = jax.tree.map(
            lambda new, old: jnp.where(fault == 0, new, old),
            (moved, after, memory),
            (values, state, known),
        )
        row = {"loss": strong(cost), "gradient_norm": norm, **metrics}
        return values, state, memory, order, fault, row

    def step(values, state, memory, order, before, k):
        stepped = _over_lanes(lane, lanes, last=None)
        return stepped(assembly, key, values, state, memory, order, before, k)

    first, stop = span[0], span[1]
    # Traced once, here: the loop needs to know what a row is before it begins.
    step = eqx.filter_closure_convert(step, *carry, first)
    row = step.out_struct[5]  # pyright: ignore[reportFunctionMemberAccess]
    rows = {n: jnp.zeros((CAPACITY, *s.shape), s.dtype) for n, s in row.items()}

    def going(carry):
        (*_, fault), _, count = carry
        return (first + count < stop) & jnp.any(fault == 0)

    def body(carry):
        now, rows, count = carry
        *now, row = step(*now, first + count)
        rows = {
            name: lax.dynamic_update_index_in_dim(rows[name], row[name], count, 0)
            for name in rows
        }
        return tuple(now), rows, count + 1

    start = (tuple(carry), rows, jnp.zeros((), jnp.int32))
    carry, rows, count = lax.while_loop(going, body, start)
    return carry, (rows, count)


def _over_lanes(function, lanes, last: int | None = 0):
    """`function` over a leading axis of every argument, or as it is for one lane.

    `last` says of the last argument alone whether it has that axis.
    """
    if lanes is None:
        return function

    def mapped(*arguments):
        axes: list[Any] = [eqx.if_array(0)] * len(arguments)
        if last is None:
            axes[-1] = None
        return eqx.filter_vmap(function, in_axes=tuple(axes))(*arguments)

    return mapped


def _check_memory(loss, old, new) -> None:
    """Raise unless an update leaves a memory of the same make."""
    shapes = [
        jax.tree.map(lambda leaf: (jnp.shape(leaf), jnp.result_type(leaf)), memory)
        for memory in (old, new)
    ]
    if shapes[0] != shapes[1]:
        raise ValueError(
            f"{_WHERE}: {type(loss).__name__}.update must return a memory of the "
            f"shapes and dtypes that it was given, {shapes[0]}, got {shapes[1]}."
        )


def _drawn_rows(key, order, k, batch_size):
    """The rows of the batch of step `k`, and the order of the pass it is in."""
    order, known = order
    size = order.shape[0]
    batches = size // batch_size
    now = k // batches
    order = lax.cond(
        now == known,
        lambda: order,
        lambda: jr.permutation(jr.fold_in(key, now), size).astype(jnp.int32),
    )
    start = (k % batches) * batch_size
    return lax.dynamic_slice(order, (start,), (batch_size,)), (order, now)


def _norm(tree):
    """The Euclidean norm, in float32 at least: squares of float16 overflow at 256."""
    wide = [
        leaf.astype(jnp.promote_types(leaf.dtype, jnp.float32))
        for leaf in jax.tree.leaves(tree)
    ]
    return jnp.sqrt(sum(jnp.sum(jnp.square(leaf)) for leaf in wide))


def _is_finite(tree):
    return jnp.all(
        jnp.stack([jnp.all(jnp.isfinite(leaf)) for leaf in jax.tree.leaves(tree)])
    )


def _check_like(gradient, values) -> None:
    same = jax.tree.structure(gradient) == jax.tree.structure(values)
    if not same or not all(
        jnp.shape(g) == v.shape
        for g, v in zip(jax.tree.leaves(gradient), jax.tree.leaves(values), strict=True)
    ):
        raise ValueError(
            f"{_WHERE}: gradient must return (value, gradient) with a gradient like "
            f"the values {jax.tree.map(jnp.shape, values)}, got "
            f"{jax.tree.map(jnp.shape, gradient)}."
        )
