"""The training loop."""

import os
import time
from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
import optax
from jaxtyping import Array, PyTree

from .._check import check_at_most, check_count, check_function, check_key, is_concrete
from .._module import shown
from .._progress import tqdm
from .._results import choose, Result, RESULTS
from .._typing import PRNGKey
from ._gradient_estimators import analytic
from ._optimiser import Optimiser
from ._record import Checkpoint, checkpoint_path, COLUMNS, describe_run, History
from ._steps import AbstractSurrogate, CAPACITY, FAULTS, State, Steps
from ._trainable import partition_trainable


_WHERE = "fit"


class Fitted(eqx.Module):
    """The result of [`delucax.training.fit`][].

    **Attributes:**

    - `model`: the trained model. If training diverged, `model` is the model before the
        step that failed.
    - `history`: the losses and other numbers of each step, a
        [`delucax.training.History`][].
    - `result`: the status, `RESULTS.successful` or `RESULTS.diverged` of
        `delucax.RESULTS`.

    !!! example

        ```python
        import delucax as dlx
        import jax
        import jax.numpy as jnp
        import optax

        fitted = dlx.training.fit(
            lambda model, key: jnp.sum((model.K - 2.0) ** 2),
            dlx.controllers.Linear(jnp.zeros((1, 2))),
            optax.adam(0.1),
            steps=100,
            key=jax.random.key(0),
        )
        fitted.model.K.round(1), fitted.result
        ```

        ```text
        (Array([[2., 2.]], dtype=float32), <RESULTS.successful>)
        ```
    """

    model: PyTree
    history: History
    result: Result

    __repr__ = shown


def fit(
    loss: Callable[..., Any],
    model: PyTree,
    optimiser: optax.GradientTransformation,
    steps: int,
    *,
    key: PRNGKey,
    data: PyTree = None,
    batch_size: int | None = None,
    trainable: Any = None,
    gradient: Callable[..., Any] = analytic,
    block: int = 100,
    progress: bool = True,
    callbacks: Sequence[Callable[[int, dict[str, float]], Any]] = (),
    checkpoint: str | os.PathLike | None = None,
    checkpoint_every: int | None = None,
    throw: bool = True,
) -> Fitted:
    r"""Train a model with a loss and an Optax optimiser.

    Use `fit` to train policies or any other model, such as a learned simulator. Each
    step $k$ computes the loss with the key `jax.random.fold_in(key, k)`, the gradient
    of the loss with respect to the trainable values, and the update of the optimiser. A
    parameter with a constraint is optimised as $z = \mathrm{unconstrain}(v)$, and the
    model gets $v = \mathrm{constrain}(z)$, so the parameter satisfies its constraint at
    every step.

    The steps run in compiled blocks. The result does not depend on `block`. A run that
    resumes from its checkpoint, on the same kind of machine, gives the same numbers,
    bit for bit, as a run without interruption. A second call of `fit` does not compile
    again if three things are the same as in the first call: the loss function, the way
    in which the optimiser is made, such as `optax.adam(1e-3)`, and the structure and
    shapes of the model.

    You cannot call `fit` under `jax.jit` or `jax.vmap`. To train an ensemble, pass a
    batch of keys and a batch of models: `fit` trains all models at once, independently
    of each other.

    **Arguments:**

    - `loss`: a function `loss(model, key)`, or `loss(model, batch, key)` with `data`.
        The loss returns a scalar, or a scalar and a dictionary of scalar metrics. If
        the loss is a module, for example from [`delucax.training.expected_cost`][], its
        arrays can change without a new compilation. A loss with a memory, such as
        [`delucax.training.PPO`][], is a [`delucax.training.AbstractSurrogate`][].
    - `model`: any pytree, for example a controller, an environment, a network, or a
        tuple of these. If `key` is a batch of keys, every array of the model must have
        a leading axis over the seeds. `eqx.filter_vmap(make)(keys)` returns such a
        model.
    - `optimiser`: an Optax optimiser, such as `optax.adam(1e-3)`. The optimiser gets
        the parameters as a dictionary, which maps the path of each trainable leaf to
        the unconstrained value of the leaf.
    - `steps`: the number of steps, at least 1.
    - `key`: a random key, or a batch of keys, shape `(seeds,)`.
    - `data`: a pytree of arrays with a common leading axis; none by default.
    - `batch_size`: the number of rows of `data` in a batch, all rows by default. Rows
        are drawn without replacement. Each pass over the data is in a new random order,
        and skips the last rows if they do not fill a batch.
    - `trainable`: which leaves to train; the fields marked [`delucax.weight`][] by
        default. It may also be one of these:
        - a path such as `"dynamics.system.length"`, or several paths;
        - a dictionary from paths to constraints: [`delucax.positive`][],
            [`delucax.bounded`][], or `None` for the constraint of the field;
        - a function of a leaf, such as `equinox.is_inexact_array`;
        - a pytree of booleans with the structure of the model.
    - `gradient`: the gradient estimator, [`delucax.training.analytic`][] by default.
        Other estimators are [`delucax.training.ClippedSamples`][],
        [`delucax.training.EvolutionStrategies`][],
        [`delucax.training.LikelihoodRatio`][], or any function
        `gradient(loss, values, key)` that returns `(value, gradient)`.
    - `block`: the number of steps in one compiled call to the device, at most 1000; 100
        by default. The progress bar, the callbacks and the checkpoints are updated
        after each block.
    - `progress`: whether to show a progress bar with the loss; true by default.
    - `callbacks`: functions `callback(step, metrics)`, called after each block; none by
        default. `step` is the number of finished steps, and `metrics` is a dictionary
        of the numbers of the last step, averaged over the seeds. You can use callbacks
        to log to TensorBoard, for example. If a callback returns `True`, training stops
        after this block, for example because the loss is low enough or the time is up.
    - `checkpoint`: the path of a file for checkpoints; none by default. If this file
        exists, the run resumes from the checkpoint in it. You cannot change `steps`
        when you resume a run: a call with another number of steps raises an error. If a
        callback stopped the run, repeat the same call to resume the run. If you do not
        know how long to train, choose a large number of steps and stop the run with a
        callback.
    - `checkpoint_every`: steps between checkpoints, rounded up to whole blocks; 10
        blocks by default. A checkpoint is also written at the end of the run, unless
        the run or one of its seeds diverged.
    - `throw`: whether to raise an error if the loss, its gradient or an update is NaN
        or infinite; true by default. If `throw` is false, training stops before the
        step that failed, and `fitted.result` is `RESULTS.diverged`. In a batch of
        seeds, only the training of the seed that failed stops.

    **Returns:** a [`delucax.training.Fitted`][]. If `key` is a batch of keys, the
    arrays of the model and the result have an axis over the seeds. The columns of the
    history have this axis too, except `step` and `seconds`.

    **Raises:** `ValueError` if an argument has the wrong type or shape, nothing is
    trainable, or the checkpoint comes from another run. `RuntimeError` if training
    diverges, unless `throw` is false.

    !!! example

        ```python
        import delucax as dlx
        import jax
        import jax.numpy as jnp
        import optax

        def loss(system, batch, key):
            states, slopes = batch
            zero = jnp.zeros(1)
            field = lambda x: system.vector_field(0.0, x, zero, None)
            return jnp.mean((jax.vmap(field)(states) - slopes) ** 2)

        true = dlx.systems.Pendulum(length=1.5)
        states = jax.random.normal(jax.random.key(0), (256, 2))
        field = lambda x: true.vector_field(0.0, x, jnp.zeros(1), None)
        fitted = dlx.training.fit(
            loss,
            dlx.systems.Pendulum(),
            optax.adam(0.05),
            steps=200,
            key=jax.random.key(1),
            data=(states, jax.jit(jax.vmap(field))(states)),
            batch_size=32,
            trainable={"length": dlx.positive},
        )
        fitted.model.length.round(2)
        ```

        ```text
        Array(1.5, dtype=float32, weak_type=True)
        ```
    """
    is_surrogate = isinstance(loss, AbstractSurrogate)
    if is_surrogate and data is not None:
        raise ValueError(
            f"{_WHERE}: data must be None if the loss is a surrogate, because it makes "
            "its own data."
        )
    given = "memory, " if is_surrogate else "" if data is None else "batch, "
    check_function(loss, "loss", _WHERE, f"model, {given}key")
    if not isinstance(optimiser, optax.GradientTransformation):
        raise ValueError(
            f"{_WHERE}: optimiser must be an Optax optimiser such as optax.adam(1e-3), "
            f"got {optimiser!r}."
        )
    steps = check_count(steps, "steps", _WHERE)
    block = check_count(block, "block", _WHERE)
    check_at_most(block, CAPACITY, "block", _WHERE)
    model, data = _as_jax(model), _as_jax(data)
    seeds = _checked_seeds(key, model)
    size, batch_size = _checked_data(data, batch_size)
    if not isinstance(callbacks, tuple | list) or not all(map(callable, callbacks)):
        raise ValueError(
            f"{_WHERE}: callbacks must be a sequence of functions of (step, metrics), "
            f"got {callbacks!r}."
        )
    if not callable(gradient) or isinstance(gradient, type):
        raise ValueError(
            f"{_WHERE}: gradient must be an estimator such as "
            f"delucax.training.analytic, got {gradient!r}."
        )
    if not all(is_concrete(leaf) for leaf in jax.tree.leaves((model, key, data))):
        raise ValueError(
            f"{_WHERE}: model, key and data must hold values; fit cannot be called "
            "under jax.jit, jax.vmap or jax.grad. To train an ensemble, pass a batch "
            "of keys."
        )
    assembly, values = partition_trainable(model, trainable, _WHERE)
    own = Optimiser(optimiser)
    run = Steps(loss, gradient, own, assembly, key, data, batch_size, seeds)
    state = run.start(model, values)

    saved, blocks, seconds = None, [], 0.0
    if checkpoint is not None:
        options: Any = dict(steps=steps, batch_size=batch_size, data_size=size)
        options["key"] = np.asarray(jr.key_data(key)).tolist()
        described = describe_run(model, assembly.constraints, *state[:3], **options)
        saved = Checkpoint(checkpoint_path(checkpoint), described)
        if resumed := saved.resume(state[:3]):
            arrays, history, seconds = resumed
            _, rows = run.block(state, 0, min(2, len(history["step"])))
            saved.check_replay(history, rows)
            state = State(*arrays, order=state.order, fault=state.fault)
            blocks = [history]
    elif checkpoint_every is not None:
        raise ValueError(
            f"{_WHERE}: checkpoint_every needs checkpoint, the path of a file."
        )
    every = 10 * block if checkpoint_every is None else checkpoint_every
    every = check_count(every, "checkpoint_every", _WHERE)

    done = written = len(blocks[0]["step"]) if blocks else 0
    faults = np.asarray(state.fault)
    began = time.perf_counter() - seconds
    with tqdm(total=steps, initial=done, disable=not progress, desc="fit") as bar:
        while done < steps and not np.all(faults):
            state, rows = run.block(state, done, min(done + block, steps))
            faults = np.asarray(state.fault)
            seconds = time.perf_counter() - began
            count = len(rows["loss"])
            times = dict(step=np.arange(count) + done, seconds=np.full(count, seconds))
            blocks.append(rows | times)
            done += count
            last = {name: _mean(c[-1], faults) for name, c in blocks[-1].items()}
            bar.update(count)
            bar.set_postfix(loss=f"{last['loss']:.4g}", refresh=False)
            is_due = done == steps or done - written >= every
            if saved is not None and is_due and not np.any(faults):
                blocks = [_joined(blocks)]
                saved.write(state[:3], blocks[0], seconds)
                written = done
            stops = [callback(done, last) for callback in callbacks]
            if any(map(_is_true, stops)):
                if saved is not None and written < done and not np.any(faults):
                    saved.write(state[:3], _joined(blocks), seconds)
                break

    if np.any(faults) and throw:
        raise RuntimeError(_failure(faults, blocks[-1], done))
    metrics = _joined(blocks)
    columns = {name: metrics.pop(name) for name in COLUMNS}
    history = History(**columns, metrics=metrics)
    if seeds is None:
        outcome = RESULTS.diverged if faults else RESULTS.successful
    else:
        outcome = _outcomes(state.fault)
    return Fitted(run.finished(state), history, outcome)


def _is_true(answer: Any) -> bool:
    """Whether a callback returned true, as a boolean of Python, NumPy or JAX."""
    if isinstance(answer, bool):
        return answer
    return getattr(answer, "dtype", None) == np.dtype(bool) and bool(answer)


def _mean(values: Any, faults: Any) -> float:
    """The mean over the seeds, without those that diverged if others go on."""
    goes_on = faults == 0
    of_seeds = np.shape(values) == np.shape(goes_on) and goes_on.any()
    return float(np.mean(values[goes_on] if of_seeds else values))


@eqx.filter_jit
@jax.vmap
def _outcomes(fault: Array) -> Result:
    """The status of each seed."""
    return choose(fault > 0, RESULTS.diverged, RESULTS.successful)


def _failure(faults: np.ndarray, rows: dict[str, np.ndarray], done: int) -> str:
    """The error message of a run that diverged."""
    remedy = "Pass throw=False to get the model as it was before that step."
    if faults.ndim:
        seed = int(np.argmax(faults > 0))
        return (
            f"{_WHERE}: the {FAULTS[faults[seed]]} of seed {seed} is not finite "
            f"({int(np.sum(faults > 0))} of {len(faults)} seeds diverged by step "
            f"{done - 1}). {remedy}"
        )
    return (
        f"{_WHERE}: the {FAULTS[int(faults)]} is not finite at step {done - 1} (loss "
        f"{float(rows['loss'][-1]):g}, gradient norm "
        f"{float(rows['gradient_norm'][-1]):g}). {remedy}"
    )


def _checked_seeds(key: Any, model: PyTree) -> int | None:
    """The number of seeds, after a check of the model's arrays; `None` for one key."""
    typed = eqx.is_array(key) and jnp.issubdtype(key.dtype, jax.dtypes.prng_key)
    raw = eqx.is_array(key) and key.dtype == jnp.uint32 and key.shape[1:] == (2,)
    if not (typed and key.ndim == 1 or raw and key.ndim == 2):
        check_key(key, _WHERE)
        return None
    seeds = check_count(key.shape[0], "the number of keys", _WHERE)
    for leaf in jax.tree.leaves(eqx.filter(model, eqx.is_array)):
        if leaf.shape[:1] != (seeds,):
            raise ValueError(
                f"{_WHERE}: each array of model must have the axis of the {seeds} keys "
                "in front, as equinox.filter_vmap(make)(keys) returns it, got an array "
                f"of shape {leaf.shape}."
            )
    return seeds


def _checked_data(data: PyTree, batch_size: Any) -> tuple[int | None, int | None]:
    """The number of rows of the data, and the checked batch size."""
    if data is None:
        if batch_size is not None:
            raise ValueError(f"{_WHERE}: batch_size needs data, got none.")
        return None, None
    leaves = jax.tree.leaves(data)
    shapes = [jnp.shape(leaf) for leaf in leaves]
    sizes = {shape[:1] for shape in shapes}
    if not all(map(eqx.is_array, leaves)) or len(sizes) != 1 or sizes & {(), (0,)}:
        raise ValueError(
            f"{_WHERE}: data must be arrays with a common leading axis, got shapes "
            f"{shapes}."
        )
    size = shapes[0][0]
    if batch_size is not None:
        batch_size = check_count(batch_size, "batch_size", _WHERE)
        check_at_most(batch_size, size, "batch_size", _WHERE, "rows of data")
    return size, batch_size


def _as_jax(tree: PyTree) -> PyTree:
    """The tree with its NumPy arrays as JAX arrays."""
    as_jax = lambda leaf: jnp.asarray(leaf) if isinstance(leaf, np.ndarray) else leaf
    return jax.tree.map(as_jax, tree)


def _joined(blocks: list[dict[str, np.ndarray]]) -> dict[str, np.ndarray]:
    return {name: np.concatenate([rows[name] for rows in blocks]) for name in blocks[0]}
