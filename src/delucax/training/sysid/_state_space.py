"""Neural state-space models of outputs and controls, with an encoder of the state."""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.lax as lax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
import optax
from jaxtyping import Array, Bool, Float, Int

from ..._check import as_number, check_bool, check_count, check_key, check_positive
from ..._module import mlp
from ..._results import Result, RESULTS
from ..._typing import PRNGKey
from .._fit import fit
from .._record import History
from .._steps import AbstractSurrogate
from ._latent import Encoder, LatentDynamics
from ._linear_start import linear_start
from ._record import Record, Records, uniform_records


_WHERE = "sysid.state_space"
# The last learning rate as a share of the first.
_LAST_RATE = 0.01
# The gradients of windows whose simulation diverges are clipped to this norm.
_LARGEST_GRADIENT = 1.0


class StateSpace(NamedTuple):
    """The result of [`delucax.training.sysid.state_space`][].

    **Attributes:**

    - `model`: the dynamics, a [`delucax.training.sysid.LatentDynamics`][].
    - `encoder`: computes the state from past outputs and controls, a
        [`delucax.training.sysid.Encoder`][].
    - `error`: the root-mean-square error of each output in a free run over the
        validation part, shape `(p,)`.
    - `start_error`: the same error before training.
    - `history`: the record of the training, a [`delucax.training.History`][]. The
        metric `"validation"` of this history is the validation error divided by the
        spread of the outputs.
    - `result`: success, or `RESULTS.diverged` if the training ended early or no free
        run was finite.

    !!! example

        ```python
        import delucax as dlx
        import jax
        import numpy as np

        sysid = dlx.training.sysid
        controls = np.random.default_rng(0).normal(size=(100, 1))
        record = sysid.Record(np.tanh(np.cumsum(controls) / 9), controls, dt=0.1)
        given = dict(past=4, horizon=8, steps=20, key=jax.random.key(0))
        fitted = sysid.state_space(record, 1, **given)
        x = fitted.encoder(record.outputs[-4:], record.controls[-4:])
        fitted.model.observe(0.0, x)
        ```
    """

    model: LatentDynamics
    encoder: Encoder
    error: Float[Array, " p"]
    start_error: Float[Array, " p"]
    history: History
    result: Result


def state_space(
    record: Records,
    states: int,
    *,
    past: int,
    horizon: int = 50,
    width: int = 16,
    depth: int = 1,
    steps: int = 2000,
    batch_size: int = 64,
    learning_rate: Any = 1e-2,
    validation: Any = 0.2,
    validate_every: int = 100,
    progress: bool = True,
    key: PRNGKey,
) -> StateSpace:
    r"""Train a neural state-space model together with its encoder, on records of
    outputs and controls.

    $$x_{k+1} = A x_k + B u_k + f(x_k, u_k), \qquad y_k = C x_k + h(x_k)$$

    The signals are normalised. The encoder is a network that computes the state from
    the last `past` outputs and controls.

    The networks $f$ and $h$, the matrices and the encoder are trained together. The
    loss is the mean squared error of predictions over windows of `horizon` steps, which
    begin anywhere in the records. The encoder gives the state at the beginning of a
    window. Each step of Adam draws new windows at random, and the learning rate follows
    a cosine decay. Training starts with the linear model of
    [`delucax.training.sysid.subspace`][] with $f = h = 0$, or at random weights if the
    data do not give such a model.

    The last part of each record is kept for validation. Every `validate_every` steps, a
    free run over this part is simulated, from a state that the encoder gives.
    `state_space` returns the weights with the smallest error in these free runs.

    The state has no unit and no physical meaning, because another training gives
    another state. To get the outputs, call `model.observe`. As in `subspace`, a control
    affects the outputs from the next sample on. The plant must be stable, because the
    errors in a free run of an unstable plant grow even for a good model.

    **Arguments:**

    - `record`: a [`delucax.training.sysid.Record`][] or a list of them, uniform in
        time.
    - `states`: n, the number of states.
    - `past`: the number of past samples that the encoder uses; a few times n is a good
        choice.
    - `horizon`: the number of steps of a window, 50 by default. A good choice is the
        number of steps after which an initial state of the plant has almost no effect
        any more.
    - `width`, `depth`: the number of units in each hidden layer of a network, and the
        number of its hidden layers; 16 and 1 by default.
    - `steps`: the number of training steps, 2000 by default.
    - `batch_size`: the number of windows in a training step, 64 by default.
    - `learning_rate`: the initial learning rate, 0.01 by default.
    - `validation`: the fraction of each record that is kept for validation, 0.2 by
        default.
    - `validate_every`: the number of training steps between two free runs, 100 by
        default.
    - `progress`: whether to show a progress bar with the loss; true by default.
    - `key`: a random key.

    **Returns:** [`delucax.training.sysid.StateSpace`][].

    **Raises:** `ValueError` if a count is below 1, the learning rate is not positive,
    `validation` is not between 0 and 1, or a record has fewer than `past + horizon`
    samples before its validation part.

    Source: Beintema, Toth and Schoukens, 2021 and 2023 (SUBNET).

    !!! example

        ```python
        import delucax as dlx
        import jax
        import numpy as np

        sysid = dlx.training.sysid
        controls = np.random.default_rng(0).normal(size=(100, 1))
        record = sysid.Record(np.tanh(np.cumsum(controls) / 9), controls, dt=0.1)
        given = dict(past=4, horizon=8, steps=20, key=jax.random.key(0))
        fitted = sysid.state_space(record, 1, **given)
        fitted.error, fitted.start_error
        ```
    """
    records = uniform_records(record, _WHERE)
    counts = dict(past=past, horizon=horizon, width=width, steps=steps, states=states)
    counts |= dict(batch_size=batch_size, validate_every=validate_every)
    for name, count in counts.items():
        check_count(count, name, _WHERE)
    check_count(depth, "depth", _WHERE, least=0)
    check_positive(learning_rate, "learning_rate", _WHERE)
    share = as_number(validation, "validation", _WHERE)
    if not 0 < share < 1:
        raise ValueError(
            f"{_WHERE}: validation must be between 0 and 1, got {validation!r}."
        )
    check_bool(progress, "progress", _WHERE)
    of_start, of_steps = jr.split(check_key(key, _WHERE))
    lengths = [len(one) - max(1, round(share * len(one))) for one in records]
    for index, length in enumerate(lengths):
        if length < past + horizon:
            raise ValueError(
                f"{_WHERE}: record[{index}] must have at least {past + horizon} "
                "samples (past + horizon) before its validation part, got "
                f"{length}."
            )
    estimation = [one[:n] for one, n in zip(records, lengths, strict=True)]
    model = _start(estimation, states, past, width, depth, of_start)
    loss = _Stretches(
        **_stretches_of(estimation, past, horizon),
        free=_free_runs_of(records, lengths, past),
        horizon=horizon,
        batch_size=batch_size,
        every=validate_every,
        last=steps,
    )
    rate = optax.cosine_decay_schedule(float(learning_rate), steps, _LAST_RATE)
    clip = optax.clip_by_global_norm(_LARGEST_GRADIENT)
    optimiser = optax.chain(clip, optax.adam(rate))
    given: Any = dict(key=of_steps, progress=progress, throw=False)
    # An update judges the weights before its step. So one more step judges the last
    # weights, and its own weights are not used.
    fitted = fit(loss, model, optimiser, steps + 1, **given)
    (dynamics, encoder), error, start_error = fitted.model
    result = fitted.result
    if not np.all(np.isfinite(error)):
        result = RESULTS.diverged
    return StateSpace(dynamics, encoder, error, start_error, fitted.history, result)


class _FreeRuns(NamedTuple):
    """The validation parts of all records, and the past samples before each."""

    past_outputs: Float[Array, "records past p"]
    past_controls: Float[Array, "records past m"]
    outputs: Float[Array, "records steps p"]
    controls: Float[Array, "records steps m"]
    counts: Bool[Array, "records steps"]

    def error(self, model: tuple[LatentDynamics, Encoder]) -> Float[Array, " p"]:
        """The root-mean-square error of each output in the free runs."""
        given = self.past_outputs, self.past_controls
        rest = _predicted(model, *given, self.controls) - self.outputs
        square = jnp.mean(rest**2, axis=(0, 1), where=self.counts[..., None])
        # Infinity instead of NaN, because it compares as larger than any error.
        return jnp.where(jnp.isfinite(square), jnp.sqrt(square), jnp.inf)


class _Stretches(AbstractSurrogate):
    """The prediction error over windows that begin anywhere. It remembers the weights
    that did best in the free runs."""

    outputs: Float[Array, "rows p"]
    controls: Float[Array, "rows m"]
    starts: Int[Array, " starts"]
    free: _FreeRuns
    horizon: int = eqx.field(static=True)
    batch_size: int = eqx.field(static=True)
    every: int = eqx.field(static=True)
    last: int = eqx.field(static=True)

    def init(self, model, key):
        unknown = jnp.full_like(self.outputs[0], jnp.inf)
        weights = eqx.filter(model, eqx.is_inexact_array)
        errors = dict(least=unknown, first=unknown, latest=unknown)
        return dict(best=weights, **errors)

    def update(self, model, memory, step, key):
        def judged(memory):
            error = self.free.error(model)
            size = lambda error: _mean_square(error / model[0].y_size)
            better = size(error) < size(memory["least"])
            weights = eqx.filter(model, eqx.is_inexact_array)
            kept = memory["best"], memory["least"]
            pick = lambda new, old: jnp.where(better, new, old)
            best, least = jax.tree.map(pick, (weights, error), kept)
            first = jnp.where(step == 0, error, memory["first"])
            return dict(best=best, least=least, first=first, latest=error)

        due = (step % self.every == 0) | (step == self.last)
        return lax.cond(due, judged, lambda memory: memory, memory)

    def __call__(self, model, memory, key):
        dynamics, encoder = model
        picked = jr.randint(key, (self.batch_size,), 0, len(self.starts))
        begins = self.starts[picked][:, None]
        before = begins + np.arange(-encoder.past, 0)
        inside = begins + np.arange(self.horizon)
        given = self.outputs[before], self.controls[before], self.controls[inside]
        rest = _predicted(model, *given) - self.outputs[inside]
        relative = memory["latest"] / dynamics.y_size
        metrics = dict(validation=jnp.sqrt(_mean_square(relative)))
        return _mean_square(rest / dynamics.y_size), metrics

    def finished(self, model, memory):
        best = eqx.combine(memory["best"], model)
        return best, memory["least"], memory["first"]


def _mean_square(array: Array) -> Array:
    return jnp.mean(array**2)


def _predicted(
    model: tuple[LatentDynamics, Encoder],
    past_outputs: Float[Array, "runs past p"],
    past_controls: Float[Array, "runs past m"],
    controls: Float[Array, "runs steps m"],
) -> Float[Array, "runs steps p"]:
    """The outputs of free runs from the states that the encoder computes."""
    dynamics, encoder = model
    advance = lambda x, u: dynamics.advance(0.0, x, u, None)[0]
    step = lambda x, u: (jax.vmap(advance)(x, u), x)
    starts = jax.vmap(encoder)(past_outputs, past_controls)
    _, states = lax.scan(step, starts, jnp.swapaxes(controls, 0, 1))
    # Observing all states at once is faster than one by one.
    observe = jax.vmap(jax.vmap(lambda x: dynamics.observe(0.0, x)))
    return observe(jnp.swapaxes(states, 0, 1))


def _start(
    estimation: list[Record],
    states: int,
    past: int,
    width: int,
    depth: int,
    key: PRNGKey,
) -> tuple[LatentDynamics, Encoder]:
    """The initial model and encoder: the linear start, or else random networks."""
    start = linear_start(estimation, states, past)
    of_dynamics, of_encoder, *rest = jr.split(key, 5)
    p, m = (getattr(estimation[0], k).shape[1] for k in ("outputs", "controls"))
    sizes: Any = dict(width=width, depth=depth, **start.units)
    dynamics = LatentDynamics(
        start.A, start.B, start.C, dt=estimation[0].dt, key=of_dynamics, **sizes
    )
    encoder = Encoder(start.matrix, past, p, key=of_encoder, **sizes)
    if start.is_good:
        biases = lambda pair: [
            net.layers[-1].bias for net in (pair[0].output, pair[1].network)
        ]
        given = [jax.device_put(part) for part in (start.level, start.offset)]
        return eqx.tree_at(biases, (dynamics, encoder), given)
    ends = [(states + m, states), (states, p), (past * (p + m), states)]
    networks = [
        mlp(inputs, outputs, width, depth, key=own)
        for (inputs, outputs), own in zip(ends, rest, strict=True)
    ]
    where = lambda pair: [pair[0].transition, pair[0].output, pair[1].network]
    return eqx.tree_at(where, (dynamics, encoder), networks)


def _stretches_of(records: list[Record], past: int, horizon: int) -> dict[str, Array]:
    """All rows of the records one after the other, and the rows at which a window may
    begin."""
    ends = np.cumsum([len(record) for record in records])
    begins = [
        np.arange(end - len(record) + past, end - horizon + 1)
        for record, end in zip(records, ends, strict=True)
    ]
    joined = lambda name: np.concatenate([getattr(r, name) for r in records])
    rows = dict(outputs=joined("outputs"), controls=joined("controls"))
    return jax.device_put(rows | dict(starts=np.concatenate(begins).astype(np.int32)))


def _free_runs_of(records: list[Record], lengths: list[int], past: int) -> _FreeRuns:
    """The validation parts of the records after `lengths`, padded to one length."""
    longest = max(len(r) - n for r, n in zip(records, lengths, strict=True))
    runs = []
    for record, n in zip(records, lengths, strict=True):
        y, u = np.asarray(record.outputs), np.asarray(record.controls)
        fill = ((0, longest - len(y) + n), (0, 0))
        counts = np.arange(longest) < len(y) - n
        parts = np.pad(y[n:], fill), np.pad(u[n:], fill, mode="edge")
        runs.append((y[n - past : n], u[n - past : n], *parts, counts))
    stacked = tuple(np.stack(part) for part in zip(*runs, strict=True))
    return _FreeRuns._make(jax.device_put(stacked))
