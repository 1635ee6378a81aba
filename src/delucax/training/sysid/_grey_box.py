"""Physics with a network for what it leaves out."""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..._check import (
    check_choice,
    check_count,
    check_instance,
    check_key,
    check_positive,
    check_range,
)
from ..._results import RESULTS
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
# That of weights which correct next to nothing: the physics alone.
_NONE = 1e-6
# A network is worth it from this gain on, a share of the error.
_WORTH = 0.01


class GreyBox(NamedTuple):
    """Physics with a network, as [`delucax.training.sysid.grey_box`][] fits it.

    **Attributes:**

    - `model`: the dynamics, a [`delucax.Discretized`][]
        [`delucax.systems.Corrected`][]; those of the physics alone where no network is
        better.
    - `physics`: the fit without the network, an `Identified`.
    - `errors`: from each tried `spread` to the root of the mean squared relative error
        on what was kept for the choice, and from 0 to that of the physics.
    - `spread`: the one that was chosen; 0 for the physics alone.

    !!! example

        ```python
        import delucax as dlx

        field = dlx.systems.Pendulum()
        physics = dlx.Discretized(field, dt=0.05)
        dlx.training.sysid.GreyBox(physics, None, {0.0: 0.1}, 0.0).spread
        ```
    """

    model: Discretized
    physics: Identified
    errors: dict[float, float]
    spread: float


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
    r"""Physical parameters, and a network for what the equations leave out,

    `min over theta, phi, z of sum_k |(y_k - h(x_k)) / noise|^2 + |(phi - phi_0) / s|^2`
    with `dx/dt = f(t, x, u; theta) + size * network(x, u; phi)`.

    First the physics is fitted alone, by [`delucax.training.sysid.physical`][], which
    also gives the noise. Then the network, whose last layer begins at zero, is fitted
    with it, by the same method of Levenberg and Marquardt. Its weights have a normal
    prior: of deviation 1 around their random beginning in the inner layers, of
    deviation `spread` around zero in the last one. The spread is chosen by the free
    run over the last part of the records, which those fits do not use; with it, all is
    fitted once more to the whole. Where no network is better by 1%, the physics alone
    is returned.

    **Arguments:**

    - `dynamics`: a [`delucax.Discretized`][] system with parameters at a first guess.
    - `record`: a [`delucax.training.sysid.Record`][] or a list of them.
    - `parameters`: what is estimated, as in [`delucax.training.sysid.physical`][].
    - `width`, `depth`: of the network, 8 and 1 by default.
    - `corrected`: the names of the states whose derivatives are corrected, each by the
        size of its deviation along the record; all by default. Leave out those that
        are known, such as that of a position.
    - `spreads`: that are tried, 0.01, 0.03, 0.1 and 0.3 by default.
    - `x0`, `window`: as in `physical`; `None` takes each record as one window.
    - `share`: of each record, for the fits by which the spread is chosen; 0.75 by
        default.
    - `max_steps`: of each fit, 50 by default.
    - `key`: a random key, for the first weights.

    **Returns:** a [`delucax.training.sysid.GreyBox`][].

    **Raises:** `ValueError` on arguments of the wrong kind; an error at run time if
    the physics alone cannot be fitted.

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
    check_range(share, "share", _WHERE, 0, 1)
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
    physics = result.error_if(physics, failed)

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
        return GreyBox(plain, physics, errors, spread)
    chosen, prior = solutions[spread], _prior(values, spread, depth)
    begin = chosen.values, chosen.starts
    final = solve(assembly, *begin, data, sampling, most, prior)
    return GreyBox(assembly(final.values), physics, errors, spread)


@eqx.filter_jit
def _scales(guesses: list[Array], groups: list[Record]) -> dict[str, Array]:
    """Of the network's inputs, and of the derivatives."""
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
    """Where the parameters are behind the network, and the network."""
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
    """Of the weights around their beginnings."""
    network = "system.network.layers."

    def std(path):
        if path.startswith(f"{network}{depth}."):
            return spread
        return 1.0 if path.startswith(network) else np.inf

    return Prior(
        values, {path: jnp.full_like(v, std(path)) for path, v in values.items()}
    )


def _is_early(groups: list[Record], window: int, share: float) -> Array:
    """Of each point of a window, whether it is in the first part of its record."""
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
    """Of a free run, on the last part of the records, relative to the outputs there."""
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
