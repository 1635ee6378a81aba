"""The compiled steps of [`delucax.training.fit`][], and losses with a memory."""

import abc
import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.lax as lax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
import optax
from jaxtyping import Array, Int, PyTree

from .._module import shown
from .._typing import PRNGKey
from ._gradient_estimators import cost_and_metrics
from ._optimiser import Optimiser
from ._record import COLUMNS
from ._trainable import Assembly, strip_weak_type


Values = dict[str, Array]
_WHERE = "fit"
# Folded into the key for the order of the data and for the first memory of a surrogate.
# They are larger than the number of any step, so no step uses the same key.
_ORDER = 2**32 - 1
_MEMORY = 2**32 - 2
CAPACITY = 1000
"""The maximum number of steps in a block. The buffers always have this size, so that
results are bitwise independent of `block`."""
FAULTS = ("nothing", "loss", "gradient", "update")
"""What is not finite, by the number `State.fault`."""


class State(NamedTuple):
    """The state of the training loop, with a leading axis over several seeds."""

    values: Values
    optimiser: PyTree
    memory: PyTree
    """The memory of a surrogate."""
    order: tuple[Array, Array] | None
    """The rows of the data in the order of a pass, and the number of the pass."""
    fault: Int[Array, "*seeds"]


class AbstractSurrogate(eqx.Module):
    """A surrogate loss: a loss with a memory, for [`delucax.training.fit`][].

    `fit` calls `init` once. At each step, `fit` calls `update`, which may run the
    model. Then `fit` takes the gradient of the loss `surrogate(model, memory, key)`
    with any gradient estimator. At the end it calls `finished`.
    [`delucax.training.PPO`][] and [`delucax.training.SHAC`][] are such losses.

    To write a surrogate loss, subclass this class and write `init`, `update` and
    `__call__`. All must be pure functions. Training then runs in the same compiled loop
    as with any other loss. It can train several seeds at once, and can resume from a
    checkpoint.

    !!! example

        ```python
        import delucax as dlx
        import jax
        import jax.numpy as jnp
        import optax

        class Steadied(dlx.training.AbstractSurrogate):
            "Move the gain to 1, but keep it close to its running mean."

            def init(self, model, key):
                return model.K

            def update(self, model, memory, step, key):
                return 0.9 * memory + 0.1 * model.K

            def __call__(self, model, memory, key):
                return jnp.sum((model.K - 1) ** 2 + (model.K - memory) ** 2)

        controller = dlx.controllers.Linear(jnp.zeros((1, 2)))
        key = jax.random.key(0)
        fitted = dlx.training.fit(Steadied(), controller, optax.adam(0.1), 10, key=key)
        fitted.model.K
        ```

        ```text
        Array([[0.786, 0.786]], dtype=float32)
        ```
    """

    __repr__ = shown

    @abc.abstractmethod
    def init(self, model: PyTree, key: PRNGKey) -> PyTree:
        """The memory before the first step.

        **Arguments:** `model`: the model. `key`: a random key.

        **Returns:** a pytree of arrays.
        """

    @abc.abstractmethod
    def update(self, model: PyTree, memory: PyTree, step: Any, key: PRNGKey) -> PyTree:
        """The memory for a step. It is not differentiated.

        **Arguments:**

        - `model`: the model before the step.
        - `memory`: the memory that the previous step returned.
        - `step`: the number of the step, from 0.
        - `key`: a random key.

        **Returns:** a pytree with the structure, shapes and dtypes of `memory`.
        """

    @abc.abstractmethod
    def __call__(self, model: PyTree, memory: PyTree, key: PRNGKey) -> Any:
        """The loss.

        **Arguments:**

        - `model`: the model.
        - `memory`: the memory of the step, from `update`.
        - `key`: a random key.

        **Returns:** a scalar, or a scalar and a dictionary of scalar metrics.
        """

    def finished(self, model: PyTree, memory: PyTree) -> PyTree:
        """The model that `fit` returns.

        Override this method to copy values from the memory into the model, such as
        statistics. By default the model is returned as it is.

        **Arguments:** `model`: the model. `memory`: the memory of the last step.

        **Returns:** the model.
        """
        return model


class Steps(NamedTuple):
    """The constants of a run, and its compiled steps."""

    loss: Callable[..., Any]
    gradient: Callable[..., Any]
    optimiser: Optimiser
    assembly: Assembly
    key: PRNGKey
    data: PyTree
    batch_size: int | None
    seeds: int | None

    def start(self, model: PyTree, values: Values) -> State:
        """The state before the first step."""
        state = _first_state(self.optimiser, self.seeds, values)
        memory = order = None
        if isinstance(self.loss, AbstractSurrogate):
            begin = jax.tree_util.Partial(_first_memory, self.loss)
            memory = _compiled_over_seeds(begin, self.seeds, model, self.key)
        shape = () if self.seeds is None else (self.seeds,)
        if self.batch_size is not None:
            size = len(jax.tree.leaves(self.data)[0])
            order = np.zeros((*shape, size), np.int32), np.full(shape, -1, np.int32)
        # NumPy arrays move to the device without a compilation.
        order, fault = jax.device_put((order, np.zeros(shape, np.int32)))
        return State(values, state, memory, order, fault)

    def block(
        self, state: State, first: int, stop: int
    ) -> tuple[State, dict[str, np.ndarray]]:
        """Take the steps from `first` up to `stop`, at most `CAPACITY`.

        **Returns:** the next state, and the metrics by name, with an entry per step.
        """
        span = jax.device_put((np.int32(first), np.int32(stop)))
        state, outcome = self._compiled(state, *span)
        rows, count = jax.device_get(outcome)
        return state, {name: column[:count] for name, column in rows.items()}

    def finished(self, state: State) -> PyTree:
        """The trained model, as a surrogate's `finished` returns it."""
        model = self.assembly(state.values)
        if not isinstance(self.loss, AbstractSurrogate):
            return model
        finished: Any = self.loss.finished
        return _compiled_over_seeds(finished, self.seeds, model, state.memory)

    @eqx.filter_jit
    def _compiled(
        self, state: State, first: Int[Array, ""], stop: Int[Array, ""]
    ) -> tuple[State, tuple[dict[str, Array], Array]]:
        def step_of_all(state, k):
            step = lambda model, key, state: self._step(model, key, state, k)
            return _over_seeds(step, self.seeds)(self.assembly, self.key, state)

        # Jitted so that it is traced only once: the shapes of a row are needed before
        # the loop.
        step = jax.jit(step_of_all)
        empty = lambda entry: jnp.zeros((CAPACITY, *entry.shape), entry.dtype)
        rows = jax.tree.map(empty, jax.eval_shape(step, state, first)[1])

        def going(carry):
            state, _, count = carry
            return (first + count < stop) & jnp.any(state.fault == 0)

        def body(carry):
            state, rows, count = carry
            state, row = step(state, first + count)
            put = lambda rows, row: lax.dynamic_update_index_in_dim(rows, row, count, 0)
            return state, jax.tree.map(put, rows, row), count + 1

        start = (state, rows, jnp.zeros((), jnp.int32))
        state, rows, count = lax.while_loop(going, body, start)
        return state, (rows, count)

    def _step(
        self, assembly: Assembly, key: PRNGKey, before: State, k: Array
    ) -> tuple[State, dict[str, Array]]:
        """One step of one seed."""
        values, memory, order = before.values, before.memory, before.order
        # The key depends only on the number of the step, so the draws do not depend on
        # the blocks or on checkpoints.
        own_key = jr.fold_in(key, k)
        arguments = () if self.data is None else (self.data,)
        if self.batch_size is not None and order is not None:
            order_key = jr.fold_in(key, _ORDER)
            rows, order = _drawn_rows(order_key, order, k, self.batch_size)
            arguments = (jax.tree.map(lambda leaf: leaf[rows], self.data),)
        if isinstance(self.loss, AbstractSurrogate):
            own_key, memory_key = jr.split(own_key)
            memory = self.loss.update(assembly(values), memory, k, memory_key)
            kind = lambda leaf: (jnp.shape(leaf), jnp.result_type(leaf))
            rule = "a memory with the shapes and dtypes of its argument,"
            rule = f"{type(self.loss).__name__}.update must return {rule}"
            _check_kept(kind, before.memory, memory, rule)
            arguments = (memory,)

        def of(values, key):
            return self.loss(assembly(values), *arguments, key)

        value, slope = self.gradient(of, values, own_key)
        cost, metrics = cost_and_metrics(value, _WHERE)
        rule = "gradient must return (value, gradient) with a gradient like the values"
        _check_kept(jnp.shape, values, slope, rule)
        # A random key in the state of an optimiser cannot be cast.
        cast = lambda x, old: x if x.dtype == old.dtype else x.astype(old.dtype)
        slope = jax.tree.map(cast, slope, values)
        if taken := sorted(set(metrics) & set(COLUMNS)):
            raise ValueError(
                f"{_WHERE}: metrics must not be called {', '.join(COLUMNS)}; got "
                f"{taken[0]!r}."
            )
        # The line searches of Optax also need the loss.
        value_of = lambda v: cost_and_metrics(of(v, own_key), _WHERE)[0]
        given: Any = dict(value=cost, grad=slope, value_fn=value_of)
        updates, after = self.optimiser.update(slope, before.optimiser, values, **given)
        # The carry of a while loop must keep its dtypes.
        after = jax.tree.map(cast, after, before.optimiser)
        moved = optax.apply_updates(values, updates)
        norm = _norm(slope)
        # A loss that is not finite spoils the gradient, and the gradient spoils the
        # update. The first fault is reported, because it is the cause.
        fault = jnp.where(_is_finite(moved), np.int32(0), np.int32(3))
        fault = jnp.where(jnp.isfinite(norm), fault, np.int32(2))
        fault = jnp.where(jnp.isfinite(cost), fault, np.int32(1))
        # A seed that failed stops; the others go on.
        if self.seeds is not None:
            fault = jnp.where(before.fault == 0, fault, before.fault)
        # A step that failed is not made, so the state stays the last good one.
        after_step = moved, after, memory
        stepped: Any = lax.cond(fault == 0, lambda: after_step, lambda: before[:3])
        row = {"loss": strip_weak_type(cost), "gradient_norm": norm, **metrics}
        return State(*stepped, order=order, fault=fault), row


@eqx.filter_jit
def _first_state(optimiser: Optimiser, seeds: int | None, values: Values) -> PyTree:
    """The state of an optimiser before the first step."""
    return jax.tree.map(strip_weak_type, _over_seeds(optimiser.init, seeds)(values))


def _first_memory(loss: AbstractSurrogate, model: PyTree, key: PRNGKey) -> PyTree:
    """The memory of a surrogate before the first step."""
    memory = loss.init(model, jr.fold_in(key, _MEMORY))
    for path, leaf in jax.tree_util.tree_leaves_with_path(memory):
        if not eqx.is_array(leaf):
            raise ValueError(
                f"{_WHERE}: the memory that {type(loss).__name__}.init returns must be "
                f"a pytree of arrays, got {leaf!r} at memory"
                f"{jax.tree_util.keystr(path)}. Use jnp.asarray for a number."
            )
    return jax.tree.map(strip_weak_type, memory)


@eqx.filter_jit
def _compiled_over_seeds(function: Any, seeds: int | None, *arguments: PyTree) -> Any:
    """`function(*arguments)` over seeds, compiled. The function may be a pytree."""
    return _over_seeds(function, seeds)(*arguments)


def _over_seeds(function: Callable[..., Any], seeds: int | None) -> Callable[..., Any]:
    """`function`, mapped over the leading axis of its arguments if there are seeds."""
    return function if seeds is None else eqx.filter_vmap(function)


def _check_kept(kind: Callable[[Any], Any], old: Any, new: Any, rule: str) -> None:
    """Raise unless `new` has the structure of `old`, and leaves of the same `kind`."""
    expected, got = (jax.tree.map(kind, tree) for tree in (old, new))
    if expected != got:
        raise ValueError(f"{_WHERE}: {rule} {expected}, got {got}.")


def _drawn_rows(
    key: PRNGKey, order: tuple[Array, Array], k: Array, batch_size: int
) -> tuple[Array, tuple[Array, Array]]:
    """The rows of the batch of step `k`, and the order of the rows in its pass."""
    rows, last_pass = order
    batches = rows.shape[0] // batch_size
    this_pass = k // batches

    def redrawn():
        # The order depends only on the number of the pass, so it is the same after a
        # checkpoint.
        own_key = jr.fold_in(key, this_pass)
        return jr.permutation(own_key, rows.size).astype(rows.dtype)

    rows = lax.cond(this_pass == last_pass, lambda: rows, redrawn)
    start = (k % batches) * batch_size
    return lax.dynamic_slice(rows, (start,), (batch_size,)), (rows, this_pass)


def _norm(tree: PyTree) -> Array:
    """The Euclidean norm, at least in float32, because squares overflow in float16."""
    widen = lambda leaf: leaf.astype(jnp.promote_types(leaf.dtype, jnp.float32))
    return optax.tree.norm(jax.tree.map(widen, tree))


def _is_finite(tree: PyTree) -> Array:
    leaves = jax.tree.leaves(tree)
    finite = (jnp.all(jnp.isfinite(leaf)) for leaf in leaves)
    return functools.reduce(jnp.logical_and, finite)
