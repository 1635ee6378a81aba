"""Physical parameters, through the integrator."""

from typing import Any

import equinox as eqx
import jax
import jax.flatten_util
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..._check import (
    check_at_most,
    check_bool,
    check_count,
    check_instance,
    check_positive,
    is_concrete,
)
from ..._module import as_float_array
from ..._results import RESULTS
from ...dynamics import AbstractDynamics
from .._trainable import Assembly, partition_trainable
from ._identified import Certainty, checked, CORRELATED, Identified, quantile
from ._multiple_shooting import (
    flat_constrained,
    per_relative_change,
    relative_unit,
    Solution,
    solve,
)
from ._record import Record, Records, records_of
from ._sampled import sampling_of
from ._starts import guessed_starts, simulated_records, stitched
from ._windows import begins_of, cut_into_windows


_PASSES, _LESS = 4, 0.8
"""The most fits in units of the residuals of the one before, and the share that is no
other noise."""
_SHORT, _HIDDEN = 2, 8
"""The first window of the second attempt, short to keep a bad guess from diverging:
where the state is observed, and where it is not."""


def physical(
    dynamics: AbstractDynamics,
    record: Records,
    parameters: Any,
    *,
    x0: Any = None,
    window: int | None = 20,
    burn_in: int = 0,
    noise: Any = None,
    level: Any = 0.95,
    max_steps: int = 100,
    throw: bool = True,
) -> Identified:
    r"""Parameters of dynamics, by nonlinear least squares through the integrator,

    `min over theta and all z_j of sum_k |(y_k - h(x_k; theta)) / noise|^2`, with `x_k`
    the states that the recorded controls lead to from `z_j`, the state at the beginning
    of window j.

    Levenberg and Marquardt's method. The states at the beginning of each window are
    estimated with the parameters, so that measurement noise does not bias the estimate,
    and windows are short, so that errors stay bounded within each. Steps are
    scaled by the sensitivities, so that parameters of any size can be estimated
    together. Constrained parameters are estimated in the unconstrained space, as in
    [`delucax.training.fit`][], and their intervals are within the valid set.

    Where the fit does not converge, or its residuals are correlated from step to step,
    it starts once more, from a fit on shorter windows: of two steps, or of eight and
    then some more where states are hidden. It has converged where no step of the linear
    model is longer than a twentieth of what the noise makes the estimate vary; if it
    has not, `result` says so, and there are no intervals. A better first guess, a
    shorter window or smaller steps of the integrator may help then.

    **Arguments:**

    - `dynamics`: with the parameters at a first guess. Their own step and controls that
        are held fit any dynamics; other steps, and controls that are interpolated, a
        [`delucax.Discretized`][] system, whose step is then taken over each step of the
        record.
    - `record`: a [`delucax.training.sysid.Record`][] or a list of them.
    - `parameters`: what is estimated: a path such as `"system.length"`, several, or a
        dictionary from path to constraint, as `trainable` of
        [`delucax.training.fit`][].
    - `x0`: a guess of the first state, shape `(n,)`, or one for each record, from which
        those of the windows are simulated; by default the windows begin with what is
        observed there, which must then be the state.
    - `window`: steps of a window, 20 by default; all of the record if it has fewer or
        for `None`, which is the output-error method.
    - `burn_in`: samples at the beginning of each window that do not count. If there are
        any then the states there are not estimated, but stay as they are guessed. 0
        by default.
    - `noise`: the standard deviation of each observation, a number or shape `(p,)`; by
        default that of the residuals of a first fit.
    - `level`: of the confidence intervals, 0.95 by default.
    - `max_steps`: 100 by default.
    - `throw`: raise if it does not converge or some parameters are not identifiable
        (default); if false, look at `result`.

    **Returns:** [`delucax.training.sysid.Identified`][]; its `model` is the dynamics
    with the estimated parameters, its directions are those of relative changes, and its
    `x0` is the estimated state at the beginning of the record, or of each.

    **Raises:** `ValueError` on arguments of the wrong shape or kind, or if there is no
    such parameter; an error at run time as `throw` says.

    Source: Bock, 1983 (multiple shooting); Moré, 1978 (scaling); Ljung, 1999.

    !!! example

        ```python
        import delucax as dlx
        import jax

        key = jax.random.key(0)
        true = dlx.Discretized(dlx.systems.Pendulum(length=1.2), dt=0.05)
        controls = jax.random.normal(key, (40, 1))
        states = dlx.open_loop(true, [3.0, 0.0], controls)
        guess = dlx.Discretized(dlx.systems.Pendulum(), dt=0.05)
        fit = dlx.training.sysid.physical
        record = dlx.training.sysid.Record(states, controls, dt=0.05)
        fitted = fit(guess, record, "system.length", window=20)
        fitted.estimate, fitted.low, fitted.high
        ```
    """
    where = "sysid.physical"
    check_instance(dynamics, AbstractDynamics, "dynamics", where)
    records = records_of(record, where)
    size, n = dynamics.observation_size, dynamics.state_size
    sizes = tuple(getattr(records[0], k).shape[1] for k in ("outputs", "controls"))
    if sizes != (size, dynamics.control_size):
        raise ValueError(
            f"{where}: record must have {size} outputs and {dynamics.control_size} "
            f"controls, as the dynamics have, got {sizes[0]} and {sizes[1]}."
        )
    longest = max(len(record) for record in records) - 1
    whole = longest if window is None else check_count(window, "window", where)
    window = min(whole, longest)
    burn_in = check_count(burn_in, "burn_in", where, least=0)
    check_at_most(burn_in, window, "burn_in", where, "of a window")
    # An array, so that another limit does not compile again.
    most: Any = np.asarray(check_count(max_steps, "max_steps", where))
    reach = quantile(level, where)
    check_bool(throw, "throw", where)
    if noise is not None:
        check_positive(noise, "noise", where)
        noise = jnp.broadcast_to(as_float_array(noise), (size,))
    sampling, groups, rows = sampling_of(dynamics, records, where)
    if x0 is None and size == n:
        guesses = [group.outputs for group in groups]
    else:
        firsts = guessed_starts(dynamics, x0, groups, where)
        guesses = simulated_records(dynamics, sampling, firsts, groups, rows)
    assembly, values = partition_trainable(dynamics, parameters, where)
    names = [
        path + (f"[{','.join(map(str, index))}]" if index else "")
        for path, value in sorted(values.items())
        for index in np.ndindex(value.shape)
    ]

    estimates_starts = burn_in == 0

    def fit(values, guesses, window):
        given = guesses, groups, rows
        starts, data = cut_into_windows(*given, window, burn_in, noise)
        options: Any = dict(estimates_starts=estimates_starts)
        # First in units of the spread of each output; then from there in units of the
        # residuals that are left, which weighs outputs of unlike noise as they deserve.
        solution = solve(assembly, values, starts, data, sampling, most, **options)
        for _ in range(_PASSES if noise is None else 0):
            before, data = solution, data._replace(noise=solution.noise)
            given = solution.values, solution.starts, data, sampling, most
            solution = solve(assembly, *given, **options)
            # The minimum may be another one in these units, with other residuals.
            known = is_concrete(solution.noise)
            if not known or np.all(solution.noise > _LESS * before.noise):
                break
        return solution

    # Where the windows of each record are among all of them.
    counts = [len(begins_of(g, window)) for g in groups for _ in g.outputs]
    at = np.cumsum([0, *counts])
    unknown = len(names) + n * at[-1] * estimates_starts
    few = bool(size * sum(map(len, records)) <= unknown)
    solution = fit(values, guesses, window)
    # A second attempt, if it is known now that the first did not converge, or that its
    # residuals are correlated from step to step, as the noise is not.
    is_observed = size == n
    # A guess of a state that is observed is asked for, and windows begin there.
    has_rungs = estimates_starts and not few and (x0 is None or not is_observed)
    rungs = _rungs(window, is_observed) if has_rungs else []
    if rungs and is_concrete(solution.correlation):
        failed = solution.result != RESULTS.successful
        # On short windows nothing grows, so that a worse guess does, and there are
        # fewer minima that are not the least.
        if failed or float(solution.correlation) > CORRELATED:
            again, states = values, guesses
            for rung in rungs:
                short = fit(again, states, rung)
                again = short.values
                if not is_observed:
                    model = assembly(again)
                    given = sampling, short.starts, groups, rows, rung
                    states = stitched(model, *given)
            last = fit(again, states, window)
            less = np.prod(last.noise) < np.prod(solution.noise)
            if last.result == RESULTS.successful and (failed or less):
                solution = last
    summary = _intervals(assembly, solution, reach, few, at[:-1])
    low, high, known, starts = summary
    fitted = Identified(
        model=assembly(solution.values),
        names=tuple(names),
        estimate=solution.estimate,
        low=low,
        high=high,
        **known._asdict(),
        noise=solution.noise,
        correlation=solution.correlation,
        x0=starts[0] if isinstance(record, Record) else starts,
        # With too few data the iteration need not converge: `checked` then reports that
        # the parameters are not identifiable.
        result=RESULTS.successful if few else solution.result,
    )
    return checked(fitted, throw)


def _rungs(window: int, is_observed: bool) -> list[int]:
    """The windows of the second attempt before the last one."""
    if is_observed:
        return [_SHORT] if window > _SHORT else []
    # Hidden states are carried from each to the next, which may be some times as long.
    between = round(np.sqrt(_HIDDEN * window))
    return [rung for rung in (_HIDDEN, between) if 2 * rung <= window]


@eqx.filter_jit
def _intervals(
    assembly: Assembly, solution: Solution, reach: Array, few: bool, firsts: Any
) -> tuple[Array, Array, Certainty, Array]:
    """The ends of the intervals, the certainty of the estimate, and the states at the
    beginnings of these windows."""
    certainty = solution.certainty
    std = certainty.std
    known = certainty._replace(
        std=std * jnp.abs(relative_unit(solution.estimate)),
        identifiable=certainty.identifiable & (not few),
    )
    below, above = (
        _ends(assembly, solution.values, d) for d in (-reach * std, reach * std)
    )
    low, high = jnp.minimum(below, above), jnp.maximum(below, above)
    return low, high, known, solution.starts[firsts]


def _ends(
    assembly: Assembly, values: dict[str, Array], reach: Float[Array, " p"]
) -> Float[Array, " p"]:
    """The valid values at distance `reach` from the estimate, in relative changes."""
    flat, unravel = jax.flatten_util.ravel_pytree(values)
    step = reach * per_relative_change(assembly, values)
    end = flat_constrained(assembly, unravel(flat + step))
    # A constraint keeps numbers off the ends of its set; an interval may reach them.
    edge, size = jnp.finfo(end.dtype), jnp.abs(end)
    end = jnp.where(size >= edge.max, jnp.sign(end) * jnp.inf, end)
    return jnp.where(size <= edge.tiny, 0, end)
