"""Physical parameters by nonlinear least squares through the integrator."""

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
from ..._check_models import check_forward_mode
from ..._module import as_float_array
from ..._results import RESULTS
from ...dynamics import AbstractDynamics
from .._trainable import Assembly, partition_trainable
from ._identified import Certainty, checked, CORRELATED, Identified, quantile
from ._multiple_shooting import (
    constrained_with_rate,
    flat_constrained,
    Solution,
    solve,
)
from ._record import Record, Records, records_of
from ._sampled import sampling_of
from ._starts import guessed_starts, simulated_records, stitched
from ._windows import begins_of, cut_into_windows


_PASSES, _LESS = 4, 0.8
"""The noise is estimated by at most `_PASSES` more fits, each in units of the residuals
of the one before. They end when no residual falls below `_LESS` times its value."""
_SHORT, _HIDDEN = 2, 8
"""The first window of the second attempt if the state is measured, and if it is not.
It is short to keep a bad guess from diverging."""


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
    r"""Fit parameters of dynamics to a record, by multiple shooting.

    $$\min_{\theta, z} \sum_k \left|\frac{y_k - h(x_k; \theta)}{\mathrm{noise}}
    \right|^2$$

    The record is cut into short windows. Within window $j$, the states $x_k$ are
    simulated with the recorded controls, from the state $z_j$ at the beginning of the
    window. The states $z_j$ are estimated together with the parameters, so that
    measurement noise does not bias the estimate. Short windows keep a simulation with
    wrong parameters from drifting far from the record. Unlike in the original method,
    the end of a window need not match the beginning of the next window, so each window
    adds one unknown state. If some states are not measured, a fit with `window=None` is
    often several times as precise as a fit on short windows. A fit on short windows
    gives a good first guess for the fit with `window=None`.

    The method is Levenberg-Marquardt. The steps of the method are scaled by the
    sensitivities of the data, so that parameters of very different size can be
    estimated together. Constrained parameters are estimated in the unconstrained space,
    as in [`delucax.training.fit`][], so their confidence intervals satisfy the
    constraints.

    The fit has converged if the next step would change the estimate by at most a
    twentieth of the standard deviation that the noise causes. If the fit has not
    converged, or if its residuals are correlated from step to step, a second attempt
    starts from fits on shorter windows. These windows have two steps if the state is
    measured. Otherwise the windows have eight steps in the first of these fits, and
    between eight and `window` steps in the next one. If the second attempt does not
    converge either, `result` gives the reason, and the result has no intervals. In this
    case try a better first guess, a shorter window, or smaller steps of the integrator.

    **Arguments:**

    - `dynamics`: the dynamics; their parameters are the first guess. If the time steps
        of the dynamics and of the record differ, or if the controls are interpolated,
        the dynamics must be a [`delucax.Discretized`][] system without events. The
        dynamics then take one step for each step of the record, with the same solver
        and the same number of substeps.
    - `record`: a [`delucax.training.sysid.Record`][] or a list of them.
    - `parameters`: the parameters to estimate: a path such as `"system.length"`, a list
        of paths, or a dictionary from path to constraint, like the argument `trainable`
        of [`delucax.training.fit`][].
    - `x0`: a guess of the first state, shape `(n,)`, or one guess for each record. A
        simulation from `x0` gives the first guess of the states at which the windows
        begin. By default the measurements are this first guess, which is possible only
        if the outputs are the state.
    - `window`: the number of steps of a window, 20 by default. `None` takes each record
        as one window, which is the output-error method.
    - `burn_in`: the number of samples at the beginning of each window that are left out
        of the errors, 0 by default. If `burn_in` is positive, the states at which the
        windows begin are not estimated, but keep their guesses.
    - `noise`: the standard deviation of the noise of each output, a number or shape
        `(p,)`; by default the noise is estimated from the residuals of a first fit.
    - `level`: the confidence level of the intervals, 0.95 by default.
    - `max_steps`: the maximum number of iterations, 100 by default.
    - `throw`: raise an error if the fit does not converge or some parameters are not
        identifiable; true by default. If false, check `result`.

    **Returns:** [`delucax.training.sysid.Identified`][]. `model` is the dynamics with
    the estimated parameters, and `x0` is the estimated first state of the record, or of
    each record.

    **Raises:** `ValueError` on arguments of the wrong shape or kind, or if one of
    `parameters` does not exist. If `throw` is true, a `ValueError` is also raised if
    the record has fewer measurements than unknowns, and a `RuntimeError` if the fit
    fails. Under a transformation such as `jax.jit`, a failed fit gives an error at run
    time.

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
    check_forward_mode(dynamics, where)
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
    check_at_most(burn_in, window, "burn_in", where, "steps of a window")
    # An array, so that another limit does not cause a recompilation.
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
        # The first fit weights each output by its spread, the next ones by its
        # residuals, which estimate its noise.
        solution = solve(assembly, values, starts, data, sampling, most, **options)
        for _ in range(_PASSES if noise is None else 0):
            before, data = solution, data._replace(noise=solution.noise)
            given = solution.values, solution.starts, data, sampling, most
            solution = solve(assembly, *given, **options)
            # The new weights may lead to another minimum, with smaller residuals.
            known = is_concrete(solution.noise)
            if not known or np.all(solution.noise > _LESS * before.noise):
                break
        return solution

    # The index of the first window of each record among all windows.
    counts = [len(begins_of(g, window)) for g in groups for _ in g.outputs]
    at = np.cumsum([0, *counts])
    unknown = len(names) + n * at[-1] * estimates_starts
    measured = size * sum(map(len, records))
    few = bool(measured <= unknown)
    if few and throw:
        states = unknown - len(names)
        raise ValueError(
            f"{where}: record must have more measurements than unknowns, got "
            f"{measured} for {len(names)} parameters and {states} states at which "
            "windows begin. Record more, fit less, or take longer windows."
        )
    solution = fit(values, guesses, window)
    # Make a second attempt if the first did not converge or its residuals are
    # correlated. Under a trace this is not known, and there is none.
    is_observed = size == n
    # If the state is measured but x0 is given, the windows start as the caller asked.
    has_rungs = estimates_starts and not few and (x0 is None or not is_observed)
    rungs = _rungs(window, is_observed) if has_rungs else []
    if rungs and is_concrete(solution.correlation):
        failed = solution.result != RESULTS.successful
        # On short windows errors do not grow, so a worse guess suffices, and there are
        # fewer local minima.
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
        window=window,
        burn_in=burn_in,
        # With too few data the iteration may not converge. `checked` then reports that
        # the parameters are not identifiable.
        result=RESULTS.successful if few else solution.result,
    )
    return checked(fitted, throw, where)


def _rungs(window: int, is_observed: bool) -> list[int]:
    """The shorter windows of the second attempt, in steps."""
    if is_observed:
        return [_SHORT] if window > _SHORT else []
    # Hidden states come from the fit on the shorter window before. So that they are
    # good enough, the length of the window grows by a limited factor.
    between = round(np.sqrt(_HIDDEN * window))
    return [rung for rung in (_HIDDEN, between) if 2 * rung <= window]


@eqx.filter_jit
def _intervals(
    assembly: Assembly, solution: Solution, reach: Array, few: bool, firsts: Any
) -> tuple[Array, Array, Certainty, Array]:
    """The ends of the intervals, the certainty of the estimate, and the first states of
    the windows `firsts`."""
    certainty = solution.certainty
    std = certainty.std
    known = certainty._replace(
        std=std * jnp.abs(solution.unit),
        identifiable=certainty.identifiable & (not few),
    )
    below, above = (_ends(assembly, solution, d) for d in (-reach * std, reach * std))
    low, high = jnp.minimum(below, above), jnp.maximum(below, above)
    return low, high, known, solution.starts[firsts]


def _ends(
    assembly: Assembly, solution: Solution, reach: Float[Array, " p"]
) -> Float[Array, " p"]:
    """The constrained values at a distance of `reach` units from the estimate."""
    flat, unravel = jax.flatten_util.ravel_pytree(solution.values)
    _, rate = constrained_with_rate(assembly, solution.values)
    step = reach * solution.unit / rate
    end = flat_constrained(assembly, unravel(flat + step))
    # A constraint keeps values away from the ends of its set, but an interval may reach
    # them.
    edge, size = jnp.finfo(end.dtype), jnp.abs(end)
    end = jnp.where(size >= edge.max, jnp.sign(end) * jnp.inf, end)
    return jnp.where(size <= edge.tiny, 0, end)
