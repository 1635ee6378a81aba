"""Multiple shooting: nonlinear least squares over windows of recorded data."""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.flatten_util
import jax.lax as lax
import jax.numpy as jnp
import jax.scipy.linalg as jsl
import numpy as np
from jaxtyping import Array, Float, Int

from ..._results import choose, Result, RESULTS
from .._trainable import Assembly
from ._identified import Certainty
from ._sampled import Sampling
from ._windows import Windows


_CLEAR = 100.0
"""A change of so many standard deviations of the noise is clear."""
_NEAR = 0.05
"""A fit has converged within this many standard deviations of the minimum."""


class Prior(NamedTuple):
    """A normal prior of the unconstrained values. An infinite standard deviation means
    that nothing is known of a value."""

    mean: dict[str, Array]
    std: dict[str, Array]


class _Point(NamedTuple):
    """An iterate: parameters and first states, with residuals and sensitivities."""

    theta: Float[Array, " p"]
    starts: Float[Array, "windows n"]
    by_theta: Float[Array, "windows rows p"]
    by_start: Float[Array, "windows rows n"]
    residuals: Float[Array, "windows rows"]
    cost: Float[Array, ""]


class Solution(NamedTuple):
    """The least-squares estimate, its uncertainty and its residuals."""

    values: dict[str, Array]
    starts: Float[Array, "windows n"]
    estimate: Float[Array, " p"]
    unit: Float[Array, " p"]
    certainty: Certainty
    noise: Float[Array, " y"]
    correlation: Float[Array, ""]
    result: Result


@eqx.filter_jit
def solve(
    assembly: Assembly,
    values: dict[str, Array],
    starts: Float[Array, "windows n"],
    data: Windows,
    sampling: Sampling,
    max_steps: Int[Array, ""],
    prior: Prior | None = None,
    estimates_starts: bool = True,
) -> Solution:
    """Fit the parameters and the first state of each window to the data.

    With `estimates_starts` false, the first states are kept at their guesses.
    """
    flat, unravel = jax.flatten_util.ravel_pytree(values)
    p = flat.size
    dtype = data.observations.dtype

    def window(theta, x, data):
        times, rows, observed, counts = data
        model = assembly(unravel(theta))
        if not estimates_starts:
            x = lax.stop_gradient(x)
        advance = sampling(model)

        def step(x, inputs):
            t, row = inputs
            return advance(t, x, row).astype(x.dtype), x

        last, states = lax.scan(step, x, (times[:-1], rows))
        states = jnp.concatenate([states, last[None]])
        residuals = (observed - jax.vmap(model.observe)(times, states)) / noise
        residuals = jnp.where(counts[:, None], residuals, 0).ravel().astype(dtype)
        return residuals, residuals

    # The prior adds the residuals (theta - mean) / std.
    pull, centre = jnp.zeros(p, dtype), flat
    if prior is not None:
        pull = 1 / jax.flatten_util.ravel_pytree(prior.std)[0]
        centre = jax.flatten_util.ravel_pytree(prior.mean)[0]

    *recorded, noise, floor = data
    noise = jnp.maximum(noise, floor)
    # Forward mode, because there are few parameters and states and many residuals.
    slopes = jax.jacfwd(window, argnums=(0, 1), has_aux=True)
    sensitivity = jax.vmap(slopes, in_axes=(None, 0, 0))

    def linearised(theta, starts):
        slopes, residuals = sensitivity(theta, starts, tuple(recorded))
        cost = jnp.sum(residuals**2) + jnp.sum((pull * (theta - centre)) ** 2)
        return _Point(theta, starts, *slopes, residuals=residuals, cost=cost)

    def prior_rows(theta, unit):
        if prior is None:
            return jnp.zeros((0, p + 1), dtype)
        residual = pull * (theta - centre)
        return jnp.concatenate([jnp.diag(pull / unit), residual[:, None]], axis=1)

    rows = data.observations[0].size
    windows, n = starts.shape
    zeros = lambda *shape: jnp.zeros(shape, dtype)
    slopes = zeros(windows, rows, p), zeros(windows, rows, n)
    # The first point has an infinite cost. So the loop linearises the guess too, and
    # the sensitivities are compiled only once.
    start = _Point(flat, starts, *slopes, zeros(windows, rows), zeros() + jnp.inf)
    best, count = _levenberg_marquardt(linearised, prior_rows, start, max_steps)

    eps = jnp.finfo(dtype).eps
    theta, starts, cost = best.theta, best.starts, best.cost
    by_theta, by_start, _, units = _scaled(best, (zeros(p), zeros(*starts.shape)))
    # Changes of the data that the first states could explain as well say nothing about
    # the parameters, so the first states are eliminated here too.
    known = prior_rows(theta, units[0])
    _, on_starts, _, on_theta, by_theta = _projected(by_theta, by_start, known, eps)
    size = data.observations.shape[2]
    # The degrees of freedom: the number of observations less the number of unknowns.
    unknown = p + (starts.size if estimates_starts else 0)
    free = jnp.maximum(jnp.sum(data.counts) * size - unknown, 1)
    sigma = jnp.sqrt(jnp.sum(best.residuals**2) / free)
    residuals = best.residuals.reshape(data.observations.shape)
    # sqrt(N) r, about standard normal if the residuals are white (Ljung, 1999).
    each = jnp.sum(residuals**2, axis=(0, 1))
    paired = jnp.sum(residuals[:, 1:] * residuals[:, :-1], axis=(0, 1))
    largest = jnp.max(paired / jnp.where(each > 0, each, 1))
    correlation = jnp.sqrt(jnp.sum(data.counts)) * largest
    # The correlation of rounding errors has no meaning.
    correlation = jnp.where(sigma < 0.5, 0, correlation)
    # The outputs share the degrees of freedom equally: each has free / size.
    noise = noise * jnp.sqrt(each * size / free)
    values = unravel(theta)
    # The estimate is not more certain than the given noise or rounding allows.
    sigma = jnp.maximum(sigma, 1)
    estimate, rate = constrained_with_rate(assembly, values)
    slope = by_theta[:, :p] * units[0] / rate
    relative = _cannot_be_zero(assembly, values)
    unit = _unit(estimate, slope, sigma, relative)
    certainty = Certainty.of(slope * unit, sigma, 1.0, relative)
    longest = jnp.max(jnp.linalg.norm(on_starts[..., p], axis=1))
    settled = jnp.maximum(longest, jnp.linalg.norm(on_theta)) <= _NEAR * sigma
    result = choose(count <= max_steps, RESULTS.no_descent, RESULTS.not_converged)
    result = choose(settled, RESULTS.successful, result)
    result = choose(jnp.isfinite(cost), result, RESULTS.diverged)
    noise = jnp.where(jnp.isfinite(cost), noise, jnp.nan).astype(dtype)
    known = estimate, unit, certainty
    return Solution(values, starts, *known, noise, correlation, result)


def _levenberg_marquardt(
    linearised: Any, prior_rows: Any, start: _Point, max_steps: Int[Array, ""]
) -> tuple[_Point, Array]:
    """The best point, and the number of points tried.

    The first state of a window affects only that window, so it is eliminated there. The
    work of an iteration is therefore linear in the number of windows, where dense least
    squares would take its cube. Steps are scaled by the largest sensitivities so far
    (Moré, 1978), so that they do not depend on units.
    """
    p, dtype = start.theta.size, start.residuals.dtype
    # As a share of the cost; in float32 about the rounding of this sum of squares.
    small = 1e-9 if dtype == jnp.float64 else 1e-7
    rounding = 100 * jnp.finfo(dtype).eps ** 2 * start.residuals.size

    def body(carry):
        candidate, best, largest, damping, at_minimum, _, count = carry
        here = linearised(*candidate)
        better = here.cost < best.cost
        best = jax.tree.map(lambda a, b: jnp.where(better, a, b), here, best)
        # Damping falls faster after a success than it grows after a failure, so that
        # the steps come near to Gauss-Newton steps. At the minimum, a step fails by
        # rounding alone.
        damping = jnp.where(better | at_minimum, damping / 8, damping * 4)
        damping = jnp.clip(damping, 1e-10, 1e10)
        by_theta, by_start, largest, units = _scaled(best, largest)
        known = prior_rows(best.theta, units[0])
        projected = _projected(by_theta, by_start, known, damping)
        R_x, on_starts, R, on_theta, _ = projected
        step = jsl.solve_triangular(R, on_theta)
        # Back substitution: the step of theta gives the step of each first state.
        right = on_starts[..., p] - on_starts[..., :p] @ step
        steps = jax.vmap(jsl.solve_triangular)(R_x, right)
        # The residuals are r + J z, so the step is -z.
        candidate = best.theta - step / units[0], best.starts - steps / units[1]
        # The decrease of the cost that the linear model predicts. It is small for a
        # strongly damped step too, so a minimum also needs little damping.
        predicted = jnp.sum(on_theta**2) + jnp.sum(on_starts[..., p] ** 2)
        at_minimum = predicted <= small * best.cost
        done = at_minimum & (damping <= 1e-5) | (damping >= 1e9)
        done = done | (best.cost < rounding)
        return candidate, best, largest, damping, at_minimum, done, count + 1

    def running(carry):
        *_, done, count = carry
        return ~done & (count <= max_steps)

    none = jnp.zeros(p, dtype), jnp.zeros(start.starts.shape, dtype)
    no, first = jnp.array(False), (start.theta, start.starts)
    # The guess counts as a success, because its cost is below infinity. So the first
    # step has the damping 8e-3 / 8 = 1e-3.
    damping = jnp.zeros((), dtype) + 8e-3
    carry = first, start, none, damping, no, no, jnp.zeros((), int)
    _, best, *_, count = lax.while_loop(running, body, carry)
    return best, count


def _scaled(point: _Point, largest: Any) -> tuple[Array, Array, Any, Any]:
    """The sensitivities in units of the largest so far, the largest, and the units.

    The residuals are appended as the last column of the sensitivities to parameters.
    """
    by_theta, by_start = point.by_theta, point.by_start
    norms = jnp.linalg.norm(by_theta, axis=(0, 1)), jnp.linalg.norm(by_start, axis=1)
    largest = jax.tree.map(jnp.maximum, largest, norms)
    units = jax.tree.map(lambda norm: jnp.where(norm > 0, norm, 1), largest)
    columns = [by_theta / units[0], point.residuals[..., None]]
    by_start = by_start / units[1][:, None]
    return jnp.concatenate(columns, axis=2), by_start, largest, units


def _projected(
    by_theta: Array, by_start: Array, known: Array, damping: Any
) -> tuple[Array, ...]:
    """Eliminate the first states of the windows, then the parameters. `known` are the
    rows of the prior."""
    p = by_theta.shape[2] - 1
    eliminate = jax.vmap(_eliminate, in_axes=(0, 0, None))
    R_x, on_starts, left = eliminate(by_start, by_theta, damping)
    left = jnp.concatenate([left.reshape(-1, p + 1), known])
    R, on_theta, _ = _eliminate(left[:, :p], left[:, p:], damping)
    return R_x, on_starts, R, on_theta[:, 0], left


def _eliminate(A: Array, B: Array, damping: Any) -> tuple[Array, Array, Array]:
    """Least squares `min |A z - b|^2 + damping |z|^2` for the columns b of B.

    Returns `(R, C, residual)`. The solution is `R z = C`. The residual has a row more
    than B for each entry of z.
    """
    # QR of [A; sqrt(damping) I] keeps the condition number of A, which the normal
    # equations A' A would square.
    n = A.shape[1]
    A = jnp.concatenate([A, jnp.sqrt(damping) * jnp.eye(n, dtype=A.dtype)])
    B = jnp.concatenate([B, jnp.zeros((n, B.shape[1]), B.dtype)])
    Q, R = jnp.linalg.qr(A)
    C = Q.T @ B
    return R, C, B - Q @ C


def flat_constrained(
    assembly: Assembly, values: dict[str, Array]
) -> Float[Array, " p"]:
    """The constrained values in one vector."""
    return jax.flatten_util.ravel_pytree(assembly.constrained(values))[0]


def constrained_with_rate(
    assembly: Assembly, values: dict[str, Array]
) -> tuple[Float[Array, " p"], Float[Array, " p"]]:
    """The constrained values, and their derivatives by the unconstrained ones."""
    tangent = jax.tree.map(jnp.ones_like, values)
    flat = lambda values: flat_constrained(assembly, values)
    return jax.jvp(flat, (values,), (tangent,))


def _cannot_be_zero(assembly: Assembly, values: dict[str, Array]) -> Any:
    """Whether each value has a constraint."""
    return np.concatenate(
        [
            np.full(value.size, path in assembly.constraints)
            for path, value in sorted(values.items())
        ]
    )


def _unit(
    estimate: Float[Array, " p"], slope: Array, sigma: Array, relative: Any
) -> Float[Array, " p"]:
    """The unit of a change of each constrained value: the value itself, or 1 if it is
    zero. A value without a constraint may be near zero; its unit is then a change that
    the data show clearly."""
    unit = jnp.where(estimate == 0, 1, estimate)
    size = jnp.linalg.norm(slope, axis=0)
    clear = jnp.where(size > 0, _CLEAR * sigma / jnp.where(size > 0, size, 1), 0)
    return jnp.where(relative | (jnp.abs(unit) >= clear), unit, clear)
