"""Physical parameters, through the integrator."""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.flatten_util
import jax.lax as lax
import jax.numpy as jnp
import jax.scipy.linalg as jsl
import numpy as np
from jaxtyping import Array

from ..._check import (
    as_vector,
    check_bool,
    check_count,
    check_instance,
    check_positive,
    is_concrete,
)
from ..._module import as_float_array
from ..._results import choose, Result, RESULTS
from ...dynamics import AbstractDynamics, open_loop
from .._trainable import take_apart
from ._identified import Certainty, checked, CORRELATED, Identified, quantile
from ._linear import runs_of


_NEAR = 0.05
"""The standard deviations from the minimum within which a fit has converged."""

_SHORT = 2
"""The steps of a window in which not even a wild model grows much."""


def physical(
    dynamics: AbstractDynamics,
    observations: Any,
    controls: Any,
    parameters: Any,
    *,
    x0: Any = None,
    window: int = 20,
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
    estimated with the parameters, so that noise in what was observed does no harm, and
    a window is short enough that small errors do not grow beyond measure. Steps are
    scaled by the sensitivities, so that parameters of any size can be estimated
    together. What has a constraint is moved in its unconstrained value, as in
    [`delucax.training.fit`][], and its interval is within the legal set.

    Where the states are observed, and the fit does not converge or what remains of the
    data is correlated from step to step, it starts once more, from a fit on windows of
    two steps. It has converged where no step of the linear
    model is longer than a twentieth of what the noise makes the estimate vary; if it
    has not, `result` says so, and there are no intervals. A better first guess, a
    shorter window or smaller steps of the integrator may help then.

    **Arguments:**

    - `dynamics`: with the parameters at a first guess.
    - `observations`: shape `(T + 1, p)`, or runs of it, `(runs, T + 1, p)`.
    - `controls`: shape `(T, m)`, or `(runs, T, m)`.
    - `parameters`: what is estimated: a path such as `"system.length"`, several, or a
        dictionary from path to constraint, as `trainable` of
        [`delucax.training.fit`][].
    - `x0`: a guess of the first state, shape `(n,)`, from which those of the windows
        are simulated; by default the windows begin with what is observed there, which
        must then be the state.
    - `window`: steps of a window, 20 by default; all T if there are fewer. What does
        not fill the last is left out.
    - `noise`: the standard deviation of each observation, a number or shape `(p,)`; by
        default as in what remains of a first fit.
    - `level`: of the confidence intervals, 0.95 by default.
    - `max_steps`: 100 by default.
    - `throw`: raise if it does not converge or the data do not tell all parameters
        (default); if false, look at `result`.

    **Returns:** [`delucax.training.sysid.Identified`][]; its `model` is the dynamics
    with the estimated parameters, its directions are those of relative changes, and its
    `x0` is the estimated state at the beginning of the run, or of each run.

    **Raises:** `ValueError` on arrays of the wrong shape or kind, or if there is no
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
        found = fit(guess, states, controls, "system.length", window=20)
        found.estimate, found.low, found.high
        ```
    """
    where = "sysid.physical"
    check_instance(dynamics, AbstractDynamics, "dynamics", where)
    is_batch = jnp.ndim(as_float_array(controls)) == 3
    observations, controls = runs_of(observations, controls, "observations", where)
    size, n = dynamics.observation_size, dynamics.state_size
    if observations.shape[2] != size or controls.shape[2] != dynamics.control_size:
        raise ValueError(
            f"{where}: observations and controls must have {size} and "
            f"{dynamics.control_size} entries a step, got shapes {observations.shape} "
            f"and {controls.shape}."
        )
    runs, steps = controls.shape[:2]
    window = min(check_count(window, "window", where), steps)
    max_steps = check_count(max_steps, "max_steps", where)
    reach = quantile(level, where)
    check_bool(throw, "throw", where)
    if noise is not None:
        check_positive(noise, "noise", where)
        noise = jnp.broadcast_to(as_float_array(noise), (size,))
    if x0 is not None:
        x0 = as_vector(x0, n, "x0", where)
        guesses = jax.vmap(lambda u: open_loop(dynamics, x0, u))(controls)
        guesses = guesses.astype(observations.dtype)
    elif size == n:
        guesses = observations
    else:
        raise ValueError(
            f"{where}: x0 must be given where the state (of size {n}) is not what is "
            f"observed (of size {size})."
        )
    assembly, values = take_apart(dynamics, parameters, where)
    names = [
        path + (f"[{','.join(map(str, index))}]" if index else "")
        for path, value in sorted(values.items())
        for index in np.ndindex(value.shape)
    ]

    def fit(values, window):
        starts, problem, first = _windows(guesses, observations, controls, window)
        problem = problem._replace(noise=first if noise is None else noise)
        solved = _solve(assembly, values, starts, problem, max_steps)
        if noise is not None:
            return solved
        # Data without noise leave rounding alone, that of a whole window.
        floor = 1e3 * float(jnp.finfo(first.dtype).eps) * first
        problem = problem._replace(noise=jnp.maximum(solved.noise, floor))
        return _solve(assembly, solved.values, solved.starts, problem, max_steps)

    count = steps // window
    unknown = len(names) + runs * count * n
    few = size * runs * (count * window + 1) <= unknown
    solved = fit(values, window)
    if x0 is None and not few and window > _SHORT and _is_doubtful(solved):
        # On short windows nothing grows, so that a worse guess does, and there are
        # fewer minima that are not the least.
        again = fit(fit(values, _SHORT).values, window)
        failed = solved.result != RESULTS.successful
        if again.result == RESULTS.successful:
            if failed or jnp.prod(again.noise) < jnp.prod(solved.noise):
                solved = again
    values, legal, certainty = solved.values, solved.legal, solved.certainty
    std = certainty.std
    ends = [_ends(assembly, values, sign * reach * std) for sign in (-1, 1)]
    starts = solved.starts.reshape(runs, count, n)[:, 0]
    fitted = Identified(
        model=assembly(values),
        names=tuple(names),
        estimate=legal,
        std=std * jnp.abs(_size(legal)),
        low=jnp.minimum(*ends),
        high=jnp.maximum(*ends),
        directions=certainty.directions,
        spread=certainty.spread,
        identifiable=certainty.identifiable & (not few),
        noise=solved.noise,
        correlation=solved.correlation,
        x0=starts if is_batch else starts[0],
        # Where many values fit as well the iteration wanders: the data are to be
        # blamed.
        result=RESULTS.successful if few else solved.result,
    )
    return checked(fitted, throw)


def _is_doubtful(solved):
    """Whether it is known now that the iteration did not converge, or that it ended
    where what remains is correlated from step to step, as the noise is not."""
    if not is_concrete(solved.cost):
        return False
    failed = solved.result != RESULTS.successful
    return bool(failed | (solved.correlation > CORRELATED))


def _windows(guesses, observations, controls, window):
    """`(starts, problem, spread of each output)`, cut into windows."""
    runs, steps, _ = controls.shape
    n, size = guesses.shape[2], observations.shape[2]
    count = steps // window
    stop = count * window
    starts = guesses[:, :stop:window].reshape(runs * count, n)
    inputs = controls[:, :stop].reshape(runs * count, window, -1)
    index = np.arange(count)[:, None] * window + np.arange(window + 1)
    observed = observations[:, index].reshape(runs * count, window + 1, size)
    begins = np.tile(np.arange(count) * window, runs)
    # The observation where a window ends and the next begins counts once.
    counts = np.ones((count, window + 1), bool)
    counts[:-1, -1] = False
    counts = np.tile(counts, (runs, 1))
    # An output that never moves has a spread of rounding.
    spread, largest = jnp.std(observed, axis=(0, 1)), jnp.max(jnp.abs(observed), (0, 1))
    moves = spread > 1e3 * float(jnp.finfo(observed.dtype).eps) * largest
    spread = jnp.where(moves, spread, jnp.where(largest > 0, largest, 1))
    return starts, _Problem(begins, inputs, observed, counts, spread), spread


class _Problem(NamedTuple):
    """Windows of data, and the scale of each output."""

    begins: Any
    controls: Array
    observations: Array
    counts: Any
    noise: Array


class _Point(NamedTuple):
    """Residuals and sensitivities at values of the parameters and first states."""

    theta: Array
    starts: Array
    by_theta: Array
    by_start: Array
    rest: Array
    cost: Array


class _Solution(NamedTuple):
    values: Any
    starts: Array
    cost: Array
    legal: Array
    certainty: Certainty
    noise: Array
    correlation: Array
    result: Result


@eqx.filter_jit
def _solve(assembly, values, starts, problem, max_steps):
    """Levenberg and Marquardt's method, one small problem for each window.

    The state at the beginning of a window moves nothing but that window, so it is
    eliminated there, and the cost of a step is linear in the number of windows; a
    solver of dense least squares would pay its cube. Steps are measured by the largest
    sensitivities so far (Moré, 1978), and so do not depend on units. It has converged
    where no step of the linear model is longer than a small part of what the noise
    makes the estimate differ by.
    """
    flat, unravel = jax.flatten_util.ravel_pytree(values)
    p = flat.size
    dtype = problem.observations.dtype

    def window(theta, x, data):
        begin, controls, seen, counts = data
        model = assembly(unravel(theta))
        times = (begin + jnp.arange(controls.shape[0] + 1)) * model.dt

        def step(x, inputs):
            t, u = inputs
            x_next, _ = model.advance(t, x, u, None)
            return x_next.astype(x.dtype), x

        last, states = lax.scan(step, x, (times[:-1], controls))
        states = jnp.concatenate([states, last[None]])
        rest = (seen - jax.vmap(model.observe)(times, states)) / problem.noise
        rest = jnp.where(counts[:, None], rest, 0).ravel().astype(dtype)
        return rest, rest

    data = problem[:4]
    slopes = jax.jacfwd(window, argnums=(0, 1), has_aux=True)
    sensitivity = jax.vmap(slopes, in_axes=(None, 0, 0))

    def scaled(point, largest):
        """Sensitivities as multiples of the largest so far, and these."""
        norms = jnp.linalg.norm(point.by_theta, axis=(0, 1))
        norms = norms, jnp.linalg.norm(point.by_start, axis=1)
        largest = jax.tree.map(jnp.maximum, largest, norms)
        units = jax.tree.map(lambda norm: jnp.where(norm > 0, norm, 1), largest)
        own = [point.by_theta / units[0], point.rest[..., None]]
        by_start = point.by_start / units[1][:, None]
        return jnp.concatenate(own, axis=2), by_start, largest, units

    def projected(own, by_start, damping):
        """First on the states at the beginnings of the windows, then on the rest."""
        eliminate = jax.vmap(_eliminate, in_axes=(0, 0, None))
        R_x, on_starts, left = eliminate(by_start, own, damping)
        own = left.reshape(-1, p + 1)
        R, on_theta, _ = _eliminate(own[:, :p], own[:, p:], damping)
        return R_x, on_starts, R, on_theta[:, 0], own

    def body(carry):
        candidate, best, largest, damping, at_minimum, _, count = carry
        slopes, rest = sensitivity(*candidate, data)
        cost = jnp.sum(rest**2)
        better = cost < best.cost
        here = _Point(*candidate, *slopes, rest=rest, cost=cost)
        best = jax.tree.map(lambda a, b: jnp.where(better, a, b), here, best)
        damping = jnp.where(better | at_minimum, damping / 8, damping * 4)
        damping = jnp.clip(damping, 1e-10, 1e10)
        own, by_start, largest, units = scaled(best, largest)
        R_x, on_starts, R, on_theta, _ = projected(own, by_start, damping)
        step = jsl.solve_triangular(R, on_theta)
        right = on_starts[..., p] - on_starts[..., :p] @ step
        steps = jax.vmap(jsl.solve_triangular)(R_x, right)
        candidate = best.theta - step / units[0], best.starts - steps / units[1]
        # What the linear model promises of a step. A damped one falls short, so it is
        # a minimum only where one that is hardly damped promises nothing.
        promise = jnp.sum(on_theta**2) + jnp.sum(on_starts[..., p] ** 2)
        at_minimum = promise <= small * best.cost
        done = (
            at_minimum & (damping <= 1e-5) | (damping >= 1e9) | (best.cost < rounding)
        )
        return candidate, best, largest, damping, at_minimum, done, count + 1

    eps = jnp.finfo(dtype).eps
    small = 1e-9 if dtype == jnp.float64 else 1e-7
    rounding = 100 * eps**2 * problem.observations.size

    def going(carry):
        *_, done, count = carry
        return ~done & (count <= max_steps)

    rows = problem.observations[0].size
    zeros = lambda *shape: jnp.zeros(shape, dtype)  # noqa: E731
    point = _Point(
        theta=flat,
        starts=starts,
        by_theta=zeros(len(starts), rows, p),
        by_start=zeros(len(starts), rows, starts.shape[1]),
        rest=zeros(len(starts), rows),
        cost=zeros() + jnp.inf,
    )
    none = zeros(p), zeros(*starts.shape)
    no = jnp.array(False)
    carry = (flat, starts), point, none, zeros() + 8e-3, no, no, jnp.zeros((), int)
    _, best, _, _, _, _, count = lax.while_loop(going, body, carry)

    theta, starts, rest, cost = best.theta, best.starts, best.rest, best.cost
    own, by_start, _, units = scaled(best, none)
    # What the states at the beginnings could explain as well tells nothing.
    _, on_starts, _, on_theta, own = projected(own, by_start, eps)
    free = jnp.sum(problem.counts) * problem.observations.shape[2] - p - starts.size
    free = jnp.maximum(free, 1)
    sigma = jnp.sqrt(jnp.sum(rest**2) / free)
    rest = rest.reshape(problem.observations.shape)
    each = jnp.sum(rest**2, axis=(0, 1))
    paired = jnp.sum(rest[:, 1:] * rest[:, :-1], axis=(0, 1))
    correlation = jnp.sqrt(jnp.sum(problem.counts)) * jnp.max(
        paired / jnp.where(each > 0, each, 1)
    )
    # Rounding is correlated as it likes.
    correlation = jnp.where(sigma < 0.5, 0, correlation)
    noise = problem.noise * jnp.sqrt(each * problem.observations.shape[2] / free)
    values = unravel(theta)
    # No more certain than the noise that was given, or than rounding lets it be.
    sigma = jnp.maximum(sigma, 1)
    slope = own[:, :p] * units[0] * _per_relative(assembly, values)
    certainty = Certainty.of(slope, sigma, 1.0)
    off = jnp.linalg.norm(on_starts[..., p], axis=1), jnp.linalg.norm(on_theta)
    settled = jnp.maximum(jnp.max(off[0]), off[1]) <= _NEAR * sigma
    stopped = choose(count <= max_steps, RESULTS.no_descent, RESULTS.not_converged)
    stopped = choose(settled, RESULTS.successful, stopped)
    solver = choose(jnp.isfinite(cost), stopped, RESULTS.diverged)
    legal = _flat_legal(assembly, values)
    noise = jnp.where(jnp.isfinite(cost), noise, jnp.nan).astype(dtype)
    return _Solution(values, starts, cost, legal, certainty, noise, correlation, solver)


def _eliminate(A, B, damping):
    """Least squares `min |A z - b|^2 + damping |z|^2` for the columns b of B.

    `(R, C, left)`: `R z = C`, and what is left of B, with a row more for each z.
    """
    n = A.shape[1]
    A = jnp.concatenate([A, jnp.sqrt(damping) * jnp.eye(n, dtype=A.dtype)])
    B = jnp.concatenate([B, jnp.zeros((n, B.shape[1]), B.dtype)])
    Q, R = jnp.linalg.qr(A)
    C = Q.T @ B
    return R, C, B - Q @ C


def _flat_legal(assembly, values):
    """The legal values in one vector."""
    legal = {
        path: assembly.constraints[path].constrain(value)
        if path in assembly.constraints
        else value
        for path, value in values.items()
    }
    return jax.flatten_util.ravel_pytree(legal)[0]


def _size(legal):
    """What a relative change of 1 of each legal value amounts to."""
    return jnp.where(legal == 0, 1, legal)


def _per_relative(assembly, values):
    """The change of each unconstrained value that makes a relative change of 1."""
    tangent = jax.tree.map(jnp.ones_like, values)
    flat = lambda values: _flat_legal(assembly, values)  # noqa: E731
    legal, rate = jax.jvp(flat, (values,), (tangent,))
    return _size(legal) / rate


def _ends(assembly, values, reach):
    """The legal values that far from the estimate, in relative changes."""
    flat, unravel = jax.flatten_util.ravel_pytree(values)
    step = reach * _per_relative(assembly, values)
    legal = _flat_legal(assembly, unravel(flat + step))
    # A constraint keeps numbers off the ends of its set; an interval may reach them.
    edge, size = jnp.finfo(legal.dtype), jnp.abs(legal)
    end = jnp.where(size >= edge.max, jnp.sign(legal) * jnp.inf, legal)
    return jnp.where(size <= edge.tiny, 0, end)
