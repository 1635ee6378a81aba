"""Physical parameters, through the integrator."""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.flatten_util
import jax.lax as lax
import jax.numpy as jnp
import lineax as lx
import numpy as np
from jaxtyping import Array

from ..._check import as_vector, check_bool, check_count, check_positive
from ..._fields import as_float_array
from ..._results import choose, Result, RESULTS
from ...dynamics import AbstractDynamics, open_loop
from .._trainable import take_apart
from ._identified import Certainty, Identified, outcome, quantile, raised
from ._linear import runs_of


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
    a window is short enough that small errors do not grow beyond measure. What has a
    constraint is moved in its unconstrained value, as in [`delucax.training.fit`][],
    and its interval is within the legal set.

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
    with the parameters found, and its directions are those of relative changes.

    **Raises:** `ValueError` on arrays of the wrong shape or kind, or if there is no
    such parameter; an error at run time as `throw` says.

    Source: Bock, 1983 (multiple shooting); Ljung, 1999.

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
    if not isinstance(dynamics, AbstractDynamics):
        raise ValueError(
            f"{where}: dynamics must be an AbstractDynamics, got "
            f"{type(dynamics).__name__}."
        )
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
    count = steps // window
    if x0 is None:
        if size != n:
            raise ValueError(
                f"{where}: x0 must be given where the state (of size {n}) is not what "
                f"is observed (of size {size})."
            )
        guesses = observations[:, : count * window : window]
    else:
        x0 = as_vector(x0, n, "x0", where)
        run = jax.vmap(lambda u: open_loop(dynamics, x0, u))
        guesses = run(controls)[:, : count * window : window]
    guesses = guesses.reshape(runs * count, n)
    stop = count * window
    inputs = controls[:, :stop].reshape(runs * count, window, -1)
    index = np.arange(count)[:, None] * window + np.arange(window + 1)
    seen = observations[:, index].reshape(runs * count, window + 1, size)
    begins = np.tile(np.arange(count) * window, runs)
    # The observation where a window ends and the next begins counts once.
    counts = np.ones((count, window + 1), bool)
    counts[:-1, -1] = False
    counts = np.tile(counts, (runs, 1))
    if noise is None:
        # An output that never moves has a spread of rounding.
        spread, size_seen = jnp.std(seen, axis=(0, 1)), jnp.max(jnp.abs(seen), (0, 1))
        moves = spread > 1e3 * float(jnp.finfo(seen.dtype).eps) * size_seen
        first = jnp.where(moves, spread, jnp.where(size_seen > 0, size_seen, 1))
    else:
        first = noise

    assembly, values = take_apart(dynamics, parameters, where)
    names = [
        path + (f"[{','.join(map(str, index))}]" if index else "")
        for path, value in sorted(values.items())
        for index in np.ndindex(value.shape)
    ]
    problem = _Problem(begins, inputs, seen, counts, first)
    starts = guesses.astype(seen.dtype)
    solved = _solve(assembly, values, starts, problem, max_steps)
    if noise is None:
        # Data without noise leave rounding alone, that of a whole window.
        eps = float(jnp.finfo(seen.dtype).eps)
        problem = problem._replace(noise=jnp.maximum(solved.noise, 1e3 * eps * first))
        again = solved.values, solved.starts, problem, max_steps
        solved = _solve(assembly, *again)
    values, legal, certainty = solved.values, solved.legal, solved.certainty
    std = certainty.std
    ends = [_ends(assembly, values, sign * reach * std) for sign in (-1, 1)]
    finite = jnp.all(jnp.isfinite(legal))
    few = size * int(np.sum(counts)) <= len(names) + guesses.size
    known = certainty.identifiable & (not few)
    # Where many values fit as well the iteration wanders: the data are to be blamed.
    solver = RESULTS.successful if few else solved.result
    found = Identified(
        model=assembly(values),
        names=tuple(names),
        estimate=legal,
        std=std * jnp.abs(_size(legal)),
        low=jnp.minimum(*ends),
        high=jnp.maximum(*ends),
        directions=certainty.directions,
        spread=certainty.spread,
        identifiable=known,
        noise=solved.noise,
        result=outcome(known, solver, finite),
    )
    return raised(found, throw)


class _Problem(NamedTuple):
    """Windows of data, and the scale of each output."""

    begins: Any
    controls: Array
    observations: Array
    counts: Any
    noise: Array


class _Solution(NamedTuple):
    values: Any
    starts: Array
    legal: Array
    certainty: Certainty
    noise: Array
    result: Result


@eqx.filter_jit
def _solve(assembly, values, starts, problem, max_steps):
    """Levenberg and Marquardt's method, one small problem for each window.

    The state at the beginning of a window moves nothing but that window, so it is
    eliminated there, and the cost of a step is linear in the number of windows; a
    solver of dense least squares would pay its cube.
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

    def cost_of(theta, starts):
        rest = jax.vmap(window, in_axes=(None, 0, 0))(theta, starts, data)[0]
        return jnp.sum(rest**2)

    def body(carry):
        theta, starts, damping, cost, _, count = carry
        (by_theta, by_start), rest = sensitivity(theta, starts, data)

        def damped(H):
            size = jnp.diagonal(H, axis1=-2, axis2=-1)
            size = jnp.maximum(size, 1e-8 * jnp.max(size, -1, keepdims=True) + 1e-30)
            return H + damping * size[..., None] * jnp.eye(H.shape[-1], dtype=dtype)

        H_tt = damped(jnp.einsum("kri,krj->ij", by_theta, by_theta))
        H_xx = damped(jnp.einsum("kri,krj->kij", by_start, by_start))
        H_xt = jnp.einsum("kri,krj->kij", by_start, by_theta)
        g_t = jnp.einsum("kri,kr->i", by_theta, rest)
        g_x = jnp.einsum("kri,kr->ki", by_start, rest)
        inner = jax.vmap(_solved)(H_xx, jnp.concatenate([H_xt, g_x[..., None]], 2))
        by_t, by_g = inner[..., :-1], inner[..., -1]
        schur = H_tt - jnp.einsum("kij,kil->jl", H_xt, by_t)
        right = g_t - jnp.einsum("kij,ki->j", H_xt, by_g)
        step = _solved(schur, right[:, None])[:, 0]
        new = theta - step, starts - (by_g - jnp.einsum("kij,j->ki", by_t, step))
        new_cost = cost_of(*new)
        better = new_cost < cost
        fall = jnp.where(better, (cost - new_cost) / cost, jnp.inf)
        theta, starts = jax.tree.map(
            lambda a, b: jnp.where(better, a, b), new, (theta, starts)
        )
        damping = jnp.where(better, damping / 8, damping * 4)
        cost = jnp.where(better, new_cost, cost)
        return theta, starts, jnp.clip(damping, 1e-10, 1e10), cost, fall, count + 1

    small = 1e-9 if dtype == jnp.float64 else 1e-5
    scale = 100 * jnp.finfo(dtype).eps ** 2

    def going(carry):
        *_, damping, cost, fall, count = carry
        done = (fall < small) | (damping >= 1e9) | (cost < scale * rest_size)
        return ~done & (count < max_steps)

    rest_size = problem.observations.size
    first = cost_of(flat, starts)
    damping, fall = jnp.asarray(1e-2, dtype), jnp.asarray(jnp.inf, dtype)
    carry = (flat, starts, damping, first, fall, jnp.zeros((), int))
    theta, starts, _, cost, _, count = lax.while_loop(going, body, carry)
    solver = choose(
        count < max_steps,
        choose(jnp.isfinite(cost), RESULTS.successful, RESULTS.diverged),
        RESULTS.not_converged,
    )

    (by_theta, by_start), rest = sensitivity(theta, starts, data)
    free = jnp.sum(problem.counts) * problem.observations.shape[2] - p - starts.size
    free = jnp.maximum(free, 1)
    sigma = jnp.sqrt(jnp.sum(rest**2) / free)
    each = jnp.sum(rest.reshape(problem.observations.shape) ** 2, axis=(0, 1))
    noise = problem.noise * jnp.sqrt(each * problem.observations.shape[2] / free)
    values = unravel(theta)
    # What the states at the beginnings could explain as well tells nothing.
    basis, _ = jnp.linalg.qr(by_start)
    own = by_theta - basis @ (jnp.swapaxes(basis, 1, 2) @ by_theta)
    slope = own.reshape(-1, p) * _per_relative(assembly, values)
    # No more certain than the noise that was given, or than rounding lets it be.
    certainty = Certainty.of(slope, jnp.maximum(sigma, 1), 1.0)
    legal = _flat_legal(assembly, values)
    noise = noise.astype(dtype)
    return _Solution(values, starts, legal, certainty, noise, solver)


def _solved(H, right):
    """The solution of a positive definite system."""
    operator = lx.MatrixLinearOperator(H, lx.positive_semidefinite_tag)
    solver = lx.Cholesky()
    one = lambda b: lx.linear_solve(operator, b, solver, throw=False).value  # noqa: E731
    return jax.vmap(one, in_axes=1, out_axes=1)(right)


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
    return _flat_legal(assembly, unravel(flat + step))
