"""Validation of a model on a record that it was not fitted to."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.stats import chi2
from jaxtyping import Array, Float

from ..._check import check_count, check_instance
from ..._check_models import check_forward_mode
from ..._results import error_if, first_failure, promote, RESULTS
from ...dynamics import AbstractDynamics
from ._record import Record, Records, records_of
from ._sampled import Sampling, sampling_of
from ._starts import estimated_starts, guessed_starts, simulated, whole_windows


# Predictions begin at this many samples of each record at most.
_STRETCHES = 200
# 95% of a standard normal distribution lie within this.
_BOUND = 1.96


class Validation(eqx.Module):
    r"""How well the predictions of a model match a record.

    Printing the object prints a table of the errors.

    **Attributes:**

    - `simulated`: a tuple with the outputs of a free run along each record, shape
        `(N, p)`. A free run simulates the model with the controls alone, from an
        estimated first state.
    - `rmse`: the root-mean-square error of the free run, shape `(p,)`. The samples from
        which the first state is estimated are left out of the error.
    - `fit`: the fit of the free run in percent,
        $100\,(1 - |y - \hat y| / |y - \bar y|)$, shape `(p,)`.
    - `ahead`: the root-mean-square error of predictions over 1 to k steps, shape
        `(k, p)`.
    - `autocorrelation`: the correlation of the errors of the free run at lags 1, 2,
        ..., shape `(lags, p)`.
    - `cross_correlation`: the correlation of the errors of the free run with the
        controls 0, 1, ... steps earlier, shape `(lags + 1, p, m)`.
    - `bound`: the 95% bound of the correlations: if the errors and controls are white
        and independent, 95% of the correlations lie between `-bound` and `bound`.
    - `p_value`: the p-value of the Ljung-Box test that the errors are white, shape
        `(p,)`. A small value means that the errors are correlated in time.

    Source: Ljung, 1999 (chapter 16); Ljung and Box, 1978.

    !!! example

        ```python
        import delucax as dlx
        import jax

        sysid = dlx.training.sysid
        true = dlx.LinearDynamics([[0.9, 0.1], [0.0, 0.8]], [[0.0], [1.0]])
        controls = jax.random.normal(jax.random.key(0), (100, 1))
        states = dlx.open_loop(true, [0.0, 0.0], controls)
        estimation, validation = sysid.Record(states, controls, dt=1.0).split()
        sysid.validate(sysid.linear(estimation).model, validation).fit
        ```
    """

    simulated: tuple[Float[Array, "_ p"], ...]
    rmse: Float[Array, " p"]
    fit: Float[Array, " p"]
    ahead: Float[Array, "k p"]
    autocorrelation: Float[Array, "lags p"]
    cross_correlation: Float[Array, "_ p m"]
    bound: Float[Array, ""]
    p_value: Float[Array, " p"]

    def __repr__(self):
        lines = [f"{'output':<10}{'rmse':>12}{'fit, %':>10}{'p(white)':>12}"]
        columns = self.rmse, self.fit, self.p_value
        for i, (error, share, p) in enumerate(zip(*columns, strict=True)):
            lines.append(f"y{i:<9}{error:>12.5g}{share:>10.3g}{p:>12.3g}")
        if len(self.ahead):
            k = len(self.ahead)
            each = zip(self.ahead[0], self.ahead[-1], strict=True)
            ends = ", ".join(f"{float(a):.3g} to {float(b):.3g}" for a, b in each)
            lines.append(f"rmse of predictions of 1 to {k} steps: {ends}")
        return "\n".join(lines)


def validate(
    model: AbstractDynamics,
    record: Records,
    *,
    x0: Any = None,
    start: int = 10,
    ahead: int = 0,
    lags: int = 20,
) -> Validation:
    """Compare a free run and predictions of a model with a record.

    Use a record to which the model was not fitted. The first state is estimated from
    the first samples by least squares. From this state, the free run simulates the
    model with the recorded controls. If `ahead` is positive, predictions over 1 to
    `ahead` steps are compared with the record too. These predictions start at many
    times in the record. The state at the start of each prediction is estimated in the
    same way as the first state.

    **Arguments:**

    - `model`: the dynamics.
    - `record`: a [`delucax.training.sysid.Record`][] or a list of them.
    - `x0`: a guess of the first state, shape `(n,)`, or one guess for each record. By
        default the guess is the first measurement, which is possible only if the
        outputs are the state. For [`delucax.training.sysid.LatentDynamics`][] the
        default is zero.
    - `start`: the number of samples from which a state is estimated, 10 by default.
        These samples are left out of the errors.
    - `ahead`: the largest number of steps of a prediction; 0 by default, for no
        predictions.
    - `lags`: the largest lag of the correlations, 20 by default.

    **Returns:** a [`delucax.training.sysid.Validation`][].

    **Raises:** `ValueError` on arguments of the wrong kind, or if a record is too short
    for `start`, `ahead` and `lags`; an error at run time if the first state cannot be
    estimated.

    !!! example

        ```python
        import delucax as dlx
        import jax

        sysid = dlx.training.sysid
        plant = dlx.Discretized(dlx.systems.Pendulum(length=1.2), dt=0.05)
        controls = jax.random.normal(jax.random.key(0), (100, 1))
        states = dlx.open_loop(plant, [3.0, 0.0], controls)
        guess = dlx.Discretized(dlx.systems.Pendulum(), dt=0.05)
        validation = sysid.validate(guess, sysid.Record(states, controls, dt=0.05))
        validation.rmse
        ```
    """
    where = "sysid.validate"
    check_instance(model, AbstractDynamics, "model", where)
    check_forward_mode(model, where)
    records = records_of(record, where)
    sizes = tuple(getattr(records[0], k).shape[1] for k in ("outputs", "controls"))
    if sizes != (model.observation_size, model.control_size):
        raise ValueError(
            f"{where}: record must have {model.observation_size} outputs and "
            f"{model.control_size} controls, as the model has, got {sizes[0]} and "
            f"{sizes[1]}."
        )
    start = check_count(start, "start", where)
    ahead = check_count(ahead, "ahead", where, least=0)
    lags = check_count(lags, "lags", where)
    shortest = min(map(len, records))
    needed = start + max(ahead, lags)
    if needed >= shortest:
        raise ValueError(
            f"{where}: record must have more than {needed} samples (start + the larger "
            f"of ahead and lags), got {shortest}."
        )
    sampling, groups, rows = sampling_of(model, records, where)
    guesses = guessed_starts(model, x0, groups, where)
    given = model, sampling, guesses, groups, rows, start, ahead, lags
    runs, summary, failure = _validated(*given)
    free = tuple(run for group in runs for run in group)
    validation = Validation(free, *summary)
    failed = failure != RESULTS.successful
    return error_if(failure, validation, failed, lambda why: f"{where}: {why}")


@eqx.filter_jit
def _validated(
    model: AbstractDynamics,
    sampling: Sampling,
    guesses: list[Float[Array, "_ n"]],
    groups: list[Record],
    rows: list[Float[Array, "_ _ row"]],
    start: int,
    ahead: int,
    lags: int,
) -> Any:
    observe = jax.vmap(jax.vmap(model.observe))

    def predicted(x0, times, rows, outputs):
        """The simulated outputs from a state estimated from the first outputs."""
        early = times[:, :start], rows[:, : start - 1], outputs[:, :start]
        begin = estimated_starts(model, sampling, x0, whole_windows(*early))
        run = lambda x, t, rows: simulated(model, sampling, x, t, rows)
        states = jax.vmap(run)(begin.starts, times, rows)
        return observe(times, states), states, begin.result

    runs, stretches, pairs, result = [], [], [], RESULTS.successful
    for x0, group, own in zip(guesses, groups, rows, strict=True):
        y, states, failure = predicted(x0, group.times, own, group.outputs)
        result = first_failure(failure, promote(result))
        runs.append(y)
        pairs.append([a[:, start:] for a in (group.outputs, y, group.controls)])
        if ahead:
            last = group.times.shape[1] - start - ahead
            begins = np.unique(np.linspace(0, last, _STRETCHES).astype(int))
            inside = begins[:, None] + np.arange(start + ahead)
            measured = _flat(group.outputs[:, inside])
            given = _flat(group.times[:, inside]), _flat(own[:, inside[:, :-1]])
            # The free run gives a good guess, also of the states that are not measured.
            y_ahead, *_ = predicted(_flat(states[:, begins]), *given, measured)
            stretches.append((measured - y_ahead)[:, start:])
    errors = [measured - y for measured, y, _ in pairs]
    count = sum(error.shape[0] * error.shape[1] for error in errors)
    mean = lambda arrays: sum(jnp.sum(a, (0, 1)) for a in arrays) / count
    centre = mean([measured for measured, *_ in pairs])
    spread = jnp.sqrt(mean([(measured - centre) ** 2 for measured, *_ in pairs]))
    rmse = jnp.sqrt(mean([error**2 for error in errors]))
    far = jnp.zeros((0, len(rmse)), rmse.dtype)
    if ahead:
        far = jnp.sqrt(jnp.mean(jnp.concatenate(stretches) ** 2, axis=0))
    sides = [(_unit(e), _unit(u)) for e, (*_, u) in zip(errors, pairs, strict=True)]
    of = lambda k, side: sum(_product(s[0], s[side], k) for s in sides) / count
    steps = jnp.arange(lags + 1)
    auto = jax.vmap(lambda k: jnp.diag(of(k, 0)))(steps[1:])
    cross = jax.vmap(lambda k: of(k, 1))(steps)
    # The statistic of the Ljung-Box test.
    box = count * (count + 2) * jnp.sum(auto**2 / (count - steps[1:, None]), axis=0)
    summary = rmse, 100 * (1 - rmse / spread), far, auto, cross
    bound = jnp.asarray(_BOUND / np.sqrt(count), rmse.dtype)
    return runs, (*summary, bound, chi2.sf(box, lags)), result


def _flat(a: Array) -> Array:
    """`a` with its first two axes joined: records and samples."""
    return a.reshape(-1, *a.shape[2:])


def _unit(a: Array) -> Array:
    """`a` scaled to mean zero and variance one; zero if it is constant."""
    std = jnp.std(a, axis=(0, 1))
    return (a - jnp.mean(a, axis=(0, 1))) / jnp.where(std > 0, std, 1)


def _product(a: Array, b: Array, lag: Array) -> Float[Array, "p m"]:
    """The sum of the products of `a` with `b` at `lag` steps before."""
    before = jnp.roll(b, lag, axis=1)
    is_known = jnp.arange(b.shape[1]) >= lag
    return jnp.einsum("rkp,rkm->pm", a, jnp.where(is_known[:, None], before, 0))
