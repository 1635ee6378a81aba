"""Confidence intervals by a bootstrap of the residuals."""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.lax as lax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
from jaxtyping import Array, Bool, Float

from ..._check import (
    check_at_most,
    check_count,
    check_instance,
    check_key,
    check_range,
    is_concrete,
)
from ..._module import as_float_array
from ..._results import RESULTS
from ..._typing import PRNGKey
from ...dynamics import AbstractDynamics
from ._identified import Identified
from ._physical import physical
from ._record import Record, Records, records_of
from ._sampled import Sampling, sampling_of
from ._starts import estimated_starts, guessed_starts, simulated_records, stitched
from ._windows import begins_of, cut_into_windows


_WHERE = "sysid.bootstrap"
# This many fits run in one batch.
_AT_ONCE = 20


class Bootstrap(NamedTuple):
    """The estimates from resampled records, and their confidence intervals.

    Printing the object prints a table.

    **Attributes:**

    - `names`: the names of the p parameters.
    - `estimates`: the estimates of each draw, shape `(draws, p)`; NaN if the fit of a
        draw failed.
    - `std`: the standard deviations of the estimates, shape `(p,)`.
    - `low`, `high`: the ends of the confidence intervals, shape `(p,)`.
    - `failures`: the number of fits that failed. Failed fits are left out of `std`,
        `low` and `high`.

    !!! example

        ```python
        import delucax as dlx
        import numpy as np

        draws = np.random.default_rng(0).normal(1.0, 0.1, (100, 1))
        ends = np.quantile(draws, [0.025, 0.975], axis=0)
        std = draws.std(axis=0)
        dlx.training.sysid.Bootstrap(("mass",), draws, std, *ends, 0).low
        ```

        ```text
        array([0.86271225])
        ```
    """

    names: tuple[str, ...]
    estimates: Float[Array, "draws p"]
    std: Float[Array, " p"]
    low: Float[Array, " p"]
    high: Float[Array, " p"]
    failures: Any

    def __repr__(self):
        if not is_concrete(self.std) or jnp.ndim(self.std) != 1:
            return tuple.__repr__(self)
        head = ("parameter", "std", "low", "high")
        lines = ["{:<24}{:>12}{:>12}{:>12}".format(*head)]
        for name, *ends in zip(self.names, self.std, self.low, self.high, strict=True):
            lines.append(f"{name:<24}" + "".join(f"{float(e):>12.5g}" for e in ends))
        lines.append(f"{int(self.failures)} of {len(self.estimates)} fits failed")
        return "\n".join(lines)


def bootstrap(
    fitted: Identified,
    record: Records,
    parameters: Any = None,
    *,
    draws: int = 100,
    block: int = 1,
    window: int | None = None,
    level: Any = 0.95,
    max_steps: int = 20,
    key: PRNGKey,
) -> Bootstrap:
    """Confidence intervals of physical parameters by a bootstrap of the residuals.

    Each draw makes a new record: it adds residuals, drawn at random from the residuals
    of the fit, to the outputs of the fitted model. The parameters are then fitted to
    the new record, starting at `fitted`. The spread of the estimates over all draws
    gives the intervals.

    The intervals of [`delucax.training.sysid.physical`][] assume that the noise is
    white and normal, and that the model is nearly linear in the parameters within the
    interval. The bootstrap assumes neither normal noise nor a linear model. If the
    noise is not white, draw blocks of neighbouring residuals together with `block`. The
    cost is one fit for each draw.

    **Arguments:**

    - `fitted`: the result of [`delucax.training.sysid.physical`][].
    - `record`: the data to which the parameters were fitted, a
        [`delucax.training.sysid.Record`][] or a list of them.
    - `parameters`: the parameters of the fit, in the form that `physical` takes; by
        default the names in `fitted`. If you passed a dictionary with constraints to
        `physical`, pass the same dictionary here.
    - `draws`: the number of draws, at least 2; 100 by default.
    - `block`: the number of neighbouring residuals that are drawn together, 1 by
        default. A good choice is several times the number of samples over which the
        noise is correlated.
    - `window`: the window of each fit in steps; by default the window of `fitted`.
    - `level`: the confidence level, 0.95 by default.
    - `max_steps`: the maximum number of iterations of each fit, 20 by default.
    - `key`: a random key.

    **Returns:** a [`delucax.training.sysid.Bootstrap`][].

    **Raises:** `ValueError` on arguments of the wrong kind, if `fitted` is not a result
    of `physical`, or if `block` is longer than the shortest record.

    Source: Efron and Tibshirani, 1993; Künsch, 1989 (blocks).

    !!! example

        ```python
        import delucax as dlx
        import jax

        sysid, keys = dlx.training.sysid, jax.random.split(jax.random.key(0), 3)
        true = dlx.Discretized(dlx.systems.Pendulum(length=1.2), dt=0.05)
        controls = jax.random.normal(keys[0], (40, 1))
        states = dlx.open_loop(true, [3.0, 0.0], controls)
        states = states + 0.01 * jax.random.normal(keys[1], states.shape)
        record = sysid.Record(states, controls, dt=0.05)
        guess = dlx.Discretized(dlx.systems.Pendulum(), dt=0.05)
        fitted = sysid.physical(guess, record, "system.length")
        sysid.bootstrap(fitted, record, draws=20, key=keys[2]).std
        ```
    """
    check_instance(fitted, Identified, "fitted", _WHERE)
    check_instance(fitted.model, AbstractDynamics, "fitted.model", _WHERE)
    records = records_of(record, _WHERE)
    draws = check_count(draws, "draws", _WHERE, least=2)
    shortest = min(map(len, records))
    block = check_count(block, "block", _WHERE)
    of = "samples of the shortest record"
    check_at_most(block, shortest, "block", _WHERE, of)
    check_range(level, "level", _WHERE, 0, 1)
    key = check_key(key, _WHERE)
    if fitted.x0 is None:
        raise ValueError(
            f"{_WHERE}: fitted must be a result of sysid.physical, which estimates the "
            "first state; got a fit whose x0 is None."
        )
    if parameters is None:
        parameters = sorted({name.split("[")[0] for name in fitted.names})
    model, x0 = fitted.model, fitted.x0
    longest = max(map(len, records)) - 1
    window = fitted.window if window is None else window
    window = min(check_count(window, "window", _WHERE), longest)
    sampling, groups, rows = sampling_of(model, records, _WHERE)
    firsts = x0[None] if isinstance(record, Record) else x0
    firsts = guessed_starts(model, firsts, groups, _WHERE)
    given = model, sampling, firsts, groups, rows, window
    outputs, residuals = _residuals(*given)
    # The fit made the residuals smaller than the noise; scale them up by the degrees
    # of freedom that it used: the parameters, and a state at the start of each window.
    begins = sum(len(begins_of(g, window)) * len(g.outputs) for g in groups)
    unknown = len(fitted.names) + begins * x0.shape[-1]
    total = sum(map(len, records)) * outputs[0].shape[1]
    residuals = residuals * np.sqrt(total / max(total - unknown, 1))
    # A block is within one record.
    ends = np.cumsum([len(y) for y in outputs])
    last = np.repeat(ends, np.diff(ends, prepend=0)) - block
    possible = jnp.asarray(np.flatnonzero(np.arange(ends[-1]) <= last))
    options: Any = dict(x0=x0, window=window, burn_in=fitted.burn_in)
    options |= dict(max_steps=max_steps, throw=False)

    def one(key):
        made = []
        keys = jr.split(key, len(records))
        for own, given, y in zip(keys, records, outputs, strict=True):
            count = -(-len(given) // block)
            begins = possible[jr.randint(own, (count,), 0, len(possible))]
            at = (begins[:, None] + jnp.arange(block)).ravel()[: len(given)]
            y = y + residuals[at]
            made.append(
                eqx.tree_at(lambda r: r.outputs, given, y.astype(given.outputs.dtype))
            )
        again: Any = made[0] if isinstance(record, Record) else made
        fit = physical(model, again, parameters, **options)
        result: Any = fit.result
        return fit.estimate, result == RESULTS.successful

    estimates, solved = _all(one, jr.split(key, draws))
    return Bootstrap(fitted.names, *_summary(estimates, solved, as_float_array(level)))


@eqx.filter_jit
def _residuals(
    model: AbstractDynamics,
    sampling: Sampling,
    firsts: list[Float[Array, "_ n"]],
    groups: list[Record],
    rows: list[Float[Array, "_ _ row"]],
    window: int,
) -> tuple[list[Float[Array, "_ y"]], Float[Array, "all y"]]:
    """The outputs of the model along each record, and the residuals of all records."""
    guesses = simulated_records(model, sampling, firsts, groups, rows)
    starts, data = cut_into_windows(guesses, groups, rows, window, 0, None)
    starts = estimated_starts(model, sampling, starts, data).starts
    states = stitched(model, sampling, starts, groups, rows, window)
    observe = jax.vmap(jax.vmap(model.observe))
    outputs, left = [], []
    for group, x in zip(groups, states, strict=True):
        y = observe(group.times, x)
        outputs += list(y)
        left.append((group.outputs - y).reshape(-1, y.shape[2]))
    residuals = jnp.concatenate(left)
    return outputs, residuals - jnp.mean(residuals, axis=0)


@eqx.filter_jit
def _all(one: Any, keys: Array) -> tuple[Array, Array]:
    return lax.map(one, keys, batch_size=_AT_ONCE)


@jax.jit
def _summary(
    estimates: Float[Array, "draws p"], solved: Bool[Array, " draws"], level: Array
) -> tuple[Array, ...]:
    counted = jnp.where(solved[:, None], estimates, jnp.nan)
    ends = (1 - level) / 2, (1 + level) / 2
    low, high = (jnp.nanquantile(counted, end, axis=0) for end in ends)
    return counted, jnp.nanstd(counted, axis=0, ddof=1), low, high, jnp.sum(~solved)
