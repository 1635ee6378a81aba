"""Intervals by resampling the residuals."""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.lax as lax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
from jaxtyping import Array, Bool, Float

from ..._check import check_at_most, check_count, check_instance, check_key, check_range
from ..._module import as_float_array
from ..._results import RESULTS
from ..._typing import PRNGKey
from ...dynamics import AbstractDynamics
from ._identified import Identified
from ._physical import physical
from ._record import Record, Records, records_of
from ._sampled import Sampling, sampling_of
from ._starts import estimated_starts, guessed_starts, simulated_records, stitched
from ._windows import cut_into_windows


_WHERE = "sysid.bootstrap"
# Fits that run side by side.
_AT_ONCE = 20


class Bootstrap(NamedTuple):
    """Estimates from resampled records.

    **Attributes:**

    - `names`: of the p parameters.
    - `estimates`: shape `(draws, p)`, NaN for a fit that failed.
    - `std`: their standard deviations, shape `(p,)`.
    - `low`, `high`: the ends of their intervals, shape `(p,)`.
    - `failures`: how many of the fits failed; those do not count.

    !!! example

        ```python
        import delucax as dlx
        import numpy as np

        draws = np.random.default_rng(0).normal(1.0, 0.1, (100, 1))
        ends = np.quantile(draws, [0.025, 0.975], axis=0)
        std = draws.std(axis=0)
        dlx.training.sysid.Bootstrap(("mass",), draws, std, *ends, 0).low
        ```
    """

    names: tuple[str, ...]
    estimates: Float[Array, "draws p"]
    std: Float[Array, " p"]
    low: Float[Array, " p"]
    high: Float[Array, " p"]
    failures: Any


def bootstrap(
    fitted: Identified,
    record: Records,
    parameters: Any = None,
    *,
    draws: int = 100,
    block: int = 1,
    window: int | None = 20,
    level: Any = 0.95,
    max_steps: int = 20,
    key: PRNGKey,
) -> Bootstrap:
    """Intervals of a fit by [`delucax.training.sysid.physical`][], from fits to records
    whose residuals are drawn anew.

    Each draw adds to the outputs of the fitted model residuals that are taken at random
    from those of the fit, and fits once more from there. These intervals need neither a
    model that is linear over them, nor normal noise; with `block` above 1 not white
    noise either, because blocks of neighbouring residuals are drawn together. They take
    as many fits as there are draws.

    **Arguments:**

    - `fitted`: the fit.
    - `record`: that it was fitted to, a [`delucax.training.sysid.Record`][] or a list
        of them.
    - `parameters`: those of the fit; by default what `fitted` names.
    - `draws`: how many, 100 by default.
    - `block`: neighbouring residuals that are drawn together, 1 by default; some times
        as many as the noise is correlated over.
    - `window`: that of the fit, 20 by default.
    - `level`: of the intervals, 0.95 by default.
    - `max_steps`: of each fit, 20 by default.
    - `key`: a random key.

    **Returns:** a [`delucax.training.sysid.Bootstrap`][].

    **Raises:** `ValueError` on arguments of the wrong kind.

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
    check_at_most(block, shortest, "block", _WHERE, "of a record")
    check_range(level, "level", _WHERE, 0, 1)
    key = check_key(key, _WHERE)
    if fitted.x0 is None:
        raise ValueError(
            f"{_WHERE}: fitted must be of sysid.physical, which estimates where the "
            "record starts."
        )
    if parameters is None:
        parameters = sorted({name.split("[")[0] for name in fitted.names})
    model, x0 = fitted.model, fitted.x0
    longest = max(map(len, records)) - 1
    whole = longest if window is None else check_count(window, "window", _WHERE)
    window = min(whole, longest)
    sampling, groups, rows = sampling_of(model, records, _WHERE)
    firsts = x0[None] if isinstance(record, Record) else x0
    firsts = guessed_starts(model, firsts, groups, _WHERE)
    given = model, sampling, firsts, groups, rows, window
    outputs, residuals = _residuals(*given)
    # The fit has used some degrees of freedom up.
    unknown = len(fitted.names) + x0.size
    total = sum(map(len, records)) * outputs[0].shape[1]
    residuals = residuals * np.sqrt(total / max(total - unknown, 1))
    options: Any = dict(x0=x0, window=window, max_steps=max_steps, throw=False)

    def one(key):
        made = []
        keys = jr.split(key, len(records))
        for own, given, y in zip(keys, records, outputs, strict=True):
            count = -(-len(given) // block)
            begins = jr.randint(own, (count,), 0, len(residuals) - block + 1)
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
    """The outputs of the model along each record, and what remains of all."""
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
