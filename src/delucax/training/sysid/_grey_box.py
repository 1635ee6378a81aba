"""Grey-box models: physics, and a network for what the equations leave out."""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..._check import (
    as_number,
    check_choice,
    check_count,
    check_instance,
    check_key,
    check_positive,
)
from ..._results import error_if, Result, RESULTS
from ..._typing import PRNGKey
from ...dynamics import Discretized
from ...systems import Corrected
from .._trainable import partition_trainable
from ._identified import Identified
from ._multiple_shooting import Prior, Solution, solve
from ._physical import physical
from ._record import Record, Records, records_of
from ._sampled import Sampling, sampling_of
from ._starts import guessed_starts, simulated_records
from ._windows import begins_of, cut_into_windows


_WHERE = "sysid.grey_box"
# With this spread the weights stay so small that only the physics counts.
_NONE = 1e-6
# The network must reduce the error by this share to be kept.
_WORTH = 0.01


class GreyBox(NamedTuple):
    """The result of [`delucax.training.sysid.grey_box`][].

    **Attributes:**

    - `model`: the dynamics, [`delucax.Discretized`][] of a
        [`delucax.systems.Corrected`][] system; if no network reduces the error, it is
        the model without a network.
    - `physics`: the fit without the network, a
        [`delucax.training.sysid.Identified`][].
    - `errors`: a dictionary with an entry for each `spread` that was tried: the
        relative root-mean-square error of a free run over the last part of the records.
        The entry for the spread 0 is the error of the physics alone.
    - `spread`: the spread that was chosen; 0 for the physics alone.
    - `result`: success, or the reason why the last fit ended before it had converged.
        If the last fit did not converge, `model` is the best model so far, and you can
        try a larger `max_steps`.

    The confidence intervals in `physics` belong to the fit of the physics alone. The
    parameters in `model` were estimated together with the network, and have no
    intervals.

    !!! example

        ```python
        import delucax as dlx

        field = dlx.systems.Pendulum()
        physics = dlx.Discretized(field, dt=0.05)
        done = dlx.RESULTS.successful
        dlx.training.sysid.GreyBox(physics, None, {0.0: 0.1}, 0.0, done).spread
        ```

        ```text
        0.0
        ```
    """

    model: Discretized
    physics: Identified
    errors: dict[float, float]
    spread: float
    result: Result


def grey_box(
    dynamics: Discretized,
    record: Records,
    parameters: Any,
    *,
    width: int = 8,
    depth: int = 1,
    corrected: Sequence[str] | None = None,
    spreads: Sequence[float] = (0.01, 0.03, 0.1, 0.3),
    x0: Any = None,
    window: int | None = 20,
    share: float = 0.75,
    max_steps: int = 50,
    key: PRNGKey,
) -> GreyBox:
    r"""Fit physical parameters together with a network, which learns what the equations
    leave out.

    $$\min_{\theta, \phi, z} \sum_k \left|\frac{y_k - h(x_k)}{\mathrm{noise}}\right|^2
    + \left|\frac{\phi - \phi_0}{s}\right|^2, \qquad
    \dot x = f(t, x, u; \theta) + \mathrm{size} \cdot \mathrm{network}(x, u; \phi)$$

    Here $z$ contains the states at which the windows begin. The fit has three stages:

    1. [`delucax.training.sysid.physical`][] fits the physics alone, and estimates the
       noise.
    2. The physics and the network are fitted together to the first part of each record,
        once for each of `spreads`, by the Levenberg-Marquardt method. The last layer of
        the network starts at zero. The weights have a normal prior with the standard
        deviation $s$. In the inner layers, the mean of the prior is the random initial
        weights, and $s = 1$. In the last layer, its mean is zero, and $s$ is the
        spread.
    3. The spread with the smallest error in a free run over the last part of the
        records is chosen, and the model is fitted once more to the whole records. If no
        network reduces this error by 1%, `grey_box` returns the model without a
        network.

    **Arguments:**

    - `dynamics`: a [`delucax.Discretized`][] system whose parameters are a first guess.
    - `record`: a [`delucax.training.sysid.Record`][] or a list of them.
    - `parameters`: the parameters to estimate, as in
        [`delucax.training.sysid.physical`][].
    - `width`, `depth`: the number of units in each hidden layer of the network, and the
        number of its hidden layers; 8 and 1 by default.
    - `corrected`: the names of the states whose derivatives the network corrects; all
        by default. Leave out derivatives that are known exactly, such as the derivative
        of a position. The size of each correction is by default the standard deviation
        of the derivative along the record.
    - `spreads`: the standard deviations to try for the prior of the last layer; 0.01,
        0.03, 0.1 and 0.3 by default.
    - `x0`, `window`: as in `physical`; a `window` of `None` takes each record as one
        window.
    - `share`: the fraction of each record to which the model is fitted while the spread
        is chosen, between 0 and 1; 0.75 by default.
    - `max_steps`: the maximum number of iterations of each fit, 50 by default. For the
        fit of the physics alone, this maximum is never below 100.
    - `key`: a random key for the initial weights.

    **Returns:** a [`delucax.training.sysid.GreyBox`][].

    **Raises:** `ValueError` on arguments of the wrong kind; an error at run time if
    the fit of the physics alone fails.

    Source: Ljung, 1999 (regularised prediction errors); Forgione and Piga, 2021.

    !!! example

        ```python
        import delucax as dlx
        import jax

        sysid = dlx.training.sysid
        true = dlx.Discretized(dlx.systems.Pendulum(damping=0.3), dt=0.05)
        controls = 3 * jax.random.normal(jax.random.key(0), (60, 1))
        states = dlx.open_loop(true, [1.0, 0.0], controls)
        record = sysid.Record(states, controls, dt=0.05)
        guess = dlx.Discretized(dlx.systems.Pendulum(), dt=0.05)
        small = dict(width=3, spreads=[0.3], max_steps=5, key=jax.random.key(1))
        known = dict(x0=[1.0, 0.0], corrected=["velocity"])
        grey = sysid.grey_box(guess, record, "system.length", **known, **small)
        grey.errors, grey.spread
        ```
    """
    check_instance(dynamics, Discretized, "dynamics", _WHERE)
    records = records_of(record, _WHERE)
    if not 0 < as_number(share, "share", _WHERE) < 1:
        raise ValueError(f"{_WHERE}: share must be between 0 and 1, got {share!r}.")
    for spread in spreads:
        check_positive(spread, "spreads", _WHERE)
    key = check_key(key, _WHERE)
    names = dynamics.state_names
    for name in corrected or ():
        check_choice(name, tuple(names), "corrected", _WHERE)
    most: Any = np.asarray(check_count(max_steps, "max_steps", _WHERE))
    longest = max(map(len, records)) - 1
    window = longest if window is None else check_count(window, "window", _WHERE)
    window = min(window, longest)
    given: Any = dict(x0=x0, window=window, max_steps=max(max_steps, 100), throw=False)
    physics = physical(dynamics, record, parameters, **given)
    result: Any = physics.result
    failed = (result != RESULTS.successful) & (result != RESULTS.unexciting)
    physics = error_if(result, physics, failed, lambda why: f"{_WHERE}: {why}")

    plain: Any = physics.model
    sampling, groups, rows = sampling_of(plain, records, _WHERE)
    firsts = physics.x0
    if isinstance(record, Record) and firsts is not None:
        firsts = firsts[None]
    firsts = guessed_starts(plain, firsts, groups, _WHERE)
    guesses = simulated_records(plain, sampling, firsts, groups, rows)
    scales = _scales(guesses, groups)
    if corrected is not None:
        scales["size"] = scales["size"] * jnp.asarray([n in corrected for n in names])
    system = Corrected(plain.system, width, depth, **scales, key=key)
    whole = dataclasses.replace(plain, system=system)
    assembly, values = partition_trainable(whole, _paths(parameters), _WHERE)
    starts, data = cut_into_windows(guesses, groups, rows, window, 0, physics.noise)
    is_kept = _is_early(groups, window, float(share))
    early = data._replace(counts=data.counts & is_kept)

    errors, solutions = {}, {}
    last: Any = None
    for spread in (0.0, *sorted(map(float, spreads))):
        prior = _prior(values, max(spread, _NONE), depth)
        begin = (values, starts) if last is None else (last.values, last.starts)
        last = solve(assembly, *begin, early, sampling, most, prior)
        solutions[spread] = last
        errors[spread] = float(
            _late_error(assembly, last, sampling, groups, rows, window, float(share))
        )
    spread = min(errors, key=lambda s: np.nan_to_num(errors[s], nan=np.inf))
    if errors[spread] > (1 - _WORTH) * errors[0.0]:
        spread = 0.0
    if spread == 0.0:
        return GreyBox(plain, physics, errors, spread, result)
    chosen, prior = solutions[spread], _prior(values, spread, depth)
    begin = chosen.values, chosen.starts
    final = solve(assembly, *begin, data, sampling, most, prior)
    return GreyBox(assembly(final.values), physics, errors, spread, final.result)


@eqx.filter_jit
def _scales(guesses: list[Array], groups: list[Record]) -> dict[str, Array]:
    """The mean and size of the inputs of the network, and the size of its outputs."""
    flat = lambda arrays: jnp.concatenate([a.reshape(-1, a.shape[-1]) for a in arrays])
    x, u = flat(guesses), flat([group.controls for group in groups])
    slopes = flat(
        [
            jnp.diff(guess, axis=1) / group.steps[..., None]
            for guess, group in zip(guesses, groups, strict=True)
        ]
    )
    spread = lambda a: jnp.where(jnp.std(a, axis=0) > 0, jnp.std(a, axis=0), 1)
    return dict(
        x_mean=jnp.mean(x, axis=0),
        x_scale=spread(x),
        u_mean=jnp.mean(u, axis=0),
        u_scale=spread(u),
        size=jnp.std(slopes, axis=0),
    )


def _paths(parameters: Any) -> dict[str, Any]:
    """The paths of the parameters in the corrected system, and of the network."""
    if isinstance(parameters, str):
        parameters = [parameters]
    limits = (
        parameters if isinstance(parameters, Mapping) else dict.fromkeys(parameters)
    )
    behind = lambda path: path.replace("system.", "system.system.", 1)
    return {behind(path): limit for path, limit in limits.items()} | {
        "system.network": None
    }


def _prior(values: dict[str, Array], spread: float, depth: int) -> Prior:
    """The prior of the weights about their initial values."""
    network = "system.network.layers."

    def std(path):
        if path.startswith(f"{network}{depth}."):
            return spread
        return 1.0 if path.startswith(network) else np.inf

    return Prior(
        values, {path: jnp.full_like(v, std(path)) for path, v in values.items()}
    )


def _is_early(groups: list[Record], window: int, share: float) -> Array:
    """Whether each point of a window is in the first part of its record."""
    parts = []
    for group in groups:
        inside = begins_of(group, window)[:, None] + np.arange(window + 1)
        is_early = inside < share * group.times.shape[1]
        parts.append(np.tile(is_early, (len(group.outputs), 1)))
    return jnp.asarray(np.concatenate(parts))


@eqx.filter_jit
def _late_error(
    assembly: Any,
    solution: Solution,
    sampling: Sampling,
    groups: list[Record],
    rows: list[Any],
    window: int,
    share: float,
) -> Float[Array, ""]:
    """The error of a free run over the last part of the records, relative to the
    standard deviation of the outputs there."""
    model = assembly(solution.values)
    count, firsts = 0, []
    for group in groups:
        runs, each = len(group.outputs), len(begins_of(group, window))
        firsts.append(solution.starts[count : count + runs * each : each])
        count += runs * each
    states = simulated_records(model, sampling, firsts, groups, rows)
    observe = jax.vmap(jax.vmap(model.observe))
    errors, outputs = [], []
    for x, group in zip(states, groups, strict=True):
        late = slice(int(np.ceil(share * group.times.shape[1])), None)
        y = group.outputs[:, late]
        errors.append(
            (y - observe(group.times[:, late], x[:, late])).reshape(-1, y.shape[2])
        )
        outputs.append(y.reshape(-1, y.shape[2]))
    error, y = jnp.concatenate(errors), jnp.concatenate(outputs)
    return jnp.sqrt(jnp.mean(jnp.mean(error**2, axis=0) / jnp.var(y, axis=0)))
