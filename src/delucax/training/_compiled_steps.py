"""The steps of [`delucax.training.fit`][], compiled in blocks."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.lax as lax
import jax.numpy as jnp
import jax.random as jr
import optax
from jaxtyping import Array, Int, PyTree

from .._typing import PRNGKey
from ._history import COLUMNS
from ._loss import cost_and_metrics
from ._surrogate import AbstractSurrogate
from ._trainable import strong


Values = dict[str, Array]
_WHERE = "fit"
# Folded into the key for the order of the data and for the first memory of a surrogate.
# They are larger than the number of any step.
_ORDER = 2**32 - 1
_MEMORY = 2**32 - 2
CAPACITY = 1000
"""The most steps in a block. It is the size of the buffers whatever the block, so that
the compiled program, and with it every last bit, is the same for all."""
FAULTS = ("nothing", "loss", "gradient", "update")
"""What is not finite, by the number that a block returns."""


def first_state(
    optimiser: optax.GradientTransformation, values: Values, seeds: int | None
) -> PyTree:
    """The state of an optimiser before the first step, of each seed if there are
    several."""
    return _over_seeds(optimiser.init, seeds)(values)


@eqx.filter_jit
def first_memory(
    loss: AbstractSurrogate, model: PyTree, key: PRNGKey, seeds: int | None
) -> PyTree:
    """The memory of a surrogate before the first step."""

    def begin(model, key):
        memory = loss.init(model, jr.fold_in(key, _MEMORY))
        if not all(eqx.is_array(leaf) for leaf in jax.tree.leaves(memory)):
            raise ValueError(
                f"{_WHERE}: the memory of {type(loss).__name__} must be a pytree of "
                f"arrays, got {memory!r}."
            )
        return jax.tree.map(strong, memory)

    return _over_seeds(begin, seeds)(model, key)


@eqx.filter_jit
def finished_model(
    loss: AbstractSurrogate, model: PyTree, memory: PyTree, seeds: int | None
) -> PyTree:
    """The model with what a surrogate learned beside its weights."""
    return _over_seeds(loss.finished, seeds)(model, memory)


@eqx.filter_jit
def run_block(
    functions: tuple[Any, ...],
    carry: tuple[PyTree, ...],
    inputs: tuple[PRNGKey, PyTree],
    span: Int[Array, "2"],
    batch_size: int | None,
    seeds: int | None,
) -> tuple[tuple[PyTree, ...], tuple[dict[str, Array], Array]]:
    """The steps from `span[0]` up to `span[1]`, at most `CAPACITY` of them.

    `(carry, (rows, count))`: a row of metrics for each step, of which `count` were
    taken.
    """
    loss, gradient, optimiser, static, assembly = functions
    key, data = inputs
    optimiser = optax.with_extra_args_support(optimiser)

    def step_of_one(assembly, key, values, state, memory, order, before, k):
        own_key = jr.fold_in(key, k)
        if data is None:
            arguments = ()
        elif batch_size is None:
            arguments = (data,)
        else:
            rows, order = _drawn_rows(jr.fold_in(key, _ORDER), order, k, batch_size)
            arguments = (jax.tree.map(lambda leaf: leaf[rows], data),)
        old_memory = memory
        if memory is not None:
            own_key, memory_key = jr.split(own_key)
            memory = loss.update(assembly(values), memory, k, memory_key)
            _check_memory(loss, old_memory, memory)
            arguments = (memory,)

        def of(values, key):
            return loss(assembly(values), *arguments, key)

        value, slope = gradient(of, values, own_key)
        cost, metrics = cost_and_metrics(value, _WHERE)
        _check_gradient(slope, values)
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
        moved = optax.apply_updates(values, updates)
        norm = _norm(slope)
        fault = jnp.where(
            ~jnp.isfinite(cost),
            1,
            jnp.where(~jnp.isfinite(norm), 2, jnp.where(_is_finite(moved), 0, 3)),
        ).astype(jnp.int32)
        # A seed that failed stays as it was while the others go on.
        fault = fault if seeds is None else jnp.where(before == 0, fault, before)
        # Kept in the precision that it began with, or the loop would not close.
        after = jax.tree.map(
            lambda new, old: new if new.dtype == old.dtype else new.astype(old.dtype),
            eqx.filter(after, eqx.is_array),
            state,
        )
        values, state, memory = jax.tree.map(
            lambda new, old: jnp.where(fault == 0, new, old),
            (moved, after, memory),
            (values, state, old_memory),
        )
        row = {"loss": strong(cost), "gradient_norm": norm, **metrics}
        return values, state, memory, order, fault, row

    def step_of_all(values, state, memory, order, before, k):
        stepped = _over_seeds(step_of_one, seeds, last=None)
        return stepped(assembly, key, values, state, memory, order, before, k)

    first, stop = span[0], span[1]
    # Traced once, here: the loop needs the shapes of a row before it begins.
    step: Any = eqx.filter_closure_convert(step_of_all, *carry, first)
    row = step.out_struct[5]
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


def _over_seeds(
    function: Callable[..., Any], seeds: int | None, last: int | None = 0
) -> Callable[..., Any]:
    """`function` over a leading axis of every argument, or as it is for one seed.

    `last` says of the last argument alone whether it has that axis.
    """
    if seeds is None:
        return function
    first = eqx.if_array(0)

    def mapped(*arguments):
        axes = [first] * (len(arguments) - 1) + [None if last is None else first]
        return eqx.filter_vmap(function, in_axes=tuple(axes))(*arguments)

    return mapped


def _check_memory(loss: AbstractSurrogate, old: PyTree, new: PyTree) -> None:
    """Raise unless an update keeps the structure, shapes and dtypes of a memory."""
    shapes = [
        jax.tree.map(lambda leaf: (jnp.shape(leaf), jnp.result_type(leaf)), memory)
        for memory in (old, new)
    ]
    if shapes[0] != shapes[1]:
        raise ValueError(
            f"{_WHERE}: {type(loss).__name__}.update must return a memory of the "
            f"shapes and dtypes that it was given, {shapes[0]}, got {shapes[1]}."
        )


def _drawn_rows(
    key: PRNGKey, order: tuple[Array, Array], k: Array, batch_size: int
) -> tuple[Array, tuple[Array, Array]]:
    """The rows of the batch of step `k`, and the order of the pass it is in."""
    rows, last_pass = order
    batches = rows.shape[0] // batch_size
    this_pass = k // batches
    rows = lax.cond(
        this_pass == last_pass,
        lambda: rows,
        lambda: jr.permutation(jr.fold_in(key, this_pass), rows.shape[0]).astype(
            jnp.int32
        ),
    )
    start = (k % batches) * batch_size
    return lax.dynamic_slice(rows, (start,), (batch_size,)), (rows, this_pass)


def _norm(tree: PyTree) -> Array:
    """The Euclidean norm, in float32 at least: squares of float16 overflow at 256."""
    widen = lambda leaf: leaf.astype(jnp.promote_types(leaf.dtype, jnp.float32))
    return optax.tree.norm(jax.tree.map(widen, tree))


def _is_finite(tree: PyTree) -> Array:
    return jnp.all(
        jnp.stack([jnp.all(jnp.isfinite(leaf)) for leaf in jax.tree.leaves(tree)])
    )


def _check_gradient(gradient: PyTree, values: Values) -> None:
    """Raise unless an estimator's gradient has the structure and shapes of `values`."""
    expected, got = (jax.tree.map(jnp.shape, tree) for tree in (values, gradient))
    if expected != got:
        raise ValueError(
            f"{_WHERE}: gradient must return (value, gradient) with a gradient like "
            f"the values {expected}, got {got}."
        )
