"""The compiled part of the training loop."""

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
# Folded into the key for the order of the data; no step counts as far.
_ORDER = 2**32 - 1
CAPACITY = 1000
"""The most steps in a block. It is the size of the buffers whatever the block, so that
the compiled program, and with it every last bit, is the same for all."""
FAULTS = ("nothing", "loss", "gradient", "update")
"""What is not finite, by the number that a block returns."""


@eqx.filter_jit
def run_block(functions, carry, inputs, span, batch_size):
    """The steps from `span[0]` up to `span[1]`, at most `CAPACITY` of them."""
    loss, gradient, optimiser, static, assembly = functions
    key, data = inputs
    optimiser = optax.with_extra_args_support(optimiser)

    def step(values, state, order, k):
        own_key = jr.fold_in(key, k)
        if data is None:
            arguments = ()
        elif batch_size is None:
            arguments = (data,)
        else:
            rows, order = _drawn_rows(jr.fold_in(key, _ORDER), order, k, batch_size)
            arguments = (jax.tree.map(lambda leaf: leaf[rows], data),)

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
        # Kept in the precision that it began with, or the loop would not close.
        after = jax.tree.map(
            lambda new, old: new if new.dtype == old.dtype else new.astype(old.dtype),
            eqx.filter(after, eqx.is_array),
            state,
        )
        values, state = jax.tree.map(
            lambda new, old: jnp.where(fault == 0, new, old),
            (moved, after),
            (values, state),
        )
        row = {"loss": strong(cost), "gradient_norm": norm, **metrics}
        return values, state, order, row, fault

    values, state, order = carry
    first, stop = span[0], span[1]
    # Traced once, here: the loop needs to know what a row is before it begins.
    step = eqx.filter_closure_convert(step, values, state, order, first)
    row = step.out_struct[3]  # pyright: ignore[reportFunctionMemberAccess]
    rows = {n: jnp.zeros((CAPACITY, *s.shape), s.dtype) for n, s in row.items()}

    def going(carry):
        _, _, _, _, count, fault = carry
        return (first + count < stop) & (fault == 0)

    def body(carry):
        values, state, order, rows, count, _ = carry
        values, state, order, row, fault = step(values, state, order, first + count)
        rows = {
            name: lax.dynamic_update_index_in_dim(rows[name], row[name], count, 0)
            for name in rows
        }
        return values, state, order, rows, count + 1, fault

    zero = jnp.zeros((), jnp.int32)
    start = (values, state, order, rows, zero, zero)
    values, state, order, *outcome = lax.while_loop(going, body, start)
    return (values, state, order), outcome


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
