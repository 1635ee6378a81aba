"""Nonlinear least squares over windows of recorded data: multiple shooting."""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.flatten_util
import jax.lax as lax
import jax.numpy as jnp
import jax.scipy.linalg as jsl
from jaxtyping import Array, Float, Int

from ..._results import choose, Result, RESULTS
from .._trainable import Assembly
from ._identified import Certainty
from ._sampled import Sampling
from ._windows import Windows


_NEAR = 0.05
"""The standard deviations from the minimum within which a fit has converged."""


class Prior(NamedTuple):
    """A normal distribution of the unconstrained values, before anything is measured.
    An infinite deviation says nothing."""

    mean: dict[str, Array]
    std: dict[str, Array]


class _Point(NamedTuple):
    """Residuals and sensitivities at values of the parameters and first states."""

    theta: Float[Array, " p"]
    starts: Float[Array, "windows n"]
    by_theta: Float[Array, "windows rows p"]
    by_start: Float[Array, "windows rows n"]
    residuals: Float[Array, "windows rows"]
    cost: Float[Array, ""]


class Solution(NamedTuple):
    """The least-squares estimate and its uncertainty."""

    values: dict[str, Array]
    starts: Float[Array, "windows n"]
    estimate: Float[Array, " p"]
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
    """The parameters and the state at the beginning of each window that fit best, or
    the parameters alone."""
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

    # Its rows are residuals too, (theta - mean) / std.
    pull, centre = jnp.zeros(p, dtype), flat
    if prior is not None:
        pull = 1 / jax.flatten_util.ravel_pytree(prior.std)[0]
        centre = jax.flatten_util.ravel_pytree(prior.mean)[0]

    *recorded, noise, floor = data
    noise = jnp.maximum(noise, floor)
    # Forward, for parameters and states are few and residuals many.
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
    # Any point is better than the first, so that it is linearised in the loop too, and
    # the sensitivities are compiled once.
    start = _Point(flat, starts, *slopes, zeros(windows, rows), zeros() + jnp.inf)
    best, count = _levenberg_marquardt(linearised, prior_rows, start, max_steps)

    eps = jnp.finfo(dtype).eps
    theta, starts, cost = best.theta, best.starts, best.cost
    by_theta, by_start, _, units = _scaled(best, (zeros(p), zeros(*starts.shape)))
    # What the states at the beginnings could explain as well tells nothing.
    known = prior_rows(theta, units[0])
    _, on_starts, _, on_theta, by_theta = _projected(by_theta, by_start, known, eps)
    size = data.observations.shape[2]
    # Degrees of freedom: what is observed less what is estimated.
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
    # Of the degrees of freedom, which all outputs share, each has `free / size`.
    noise = noise * jnp.sqrt(each * size / free)
    values = unravel(theta)
    # No more certain than the noise that was given, or than rounding lets it be.
    sigma = jnp.maximum(sigma, 1)
    slope = by_theta[:, :p] * units[0] * per_relative_change(assembly, values)
    certainty = Certainty.of(slope, sigma, 1.0)
    longest = jnp.max(jnp.linalg.norm(on_starts[..., p], axis=1))
    settled = jnp.maximum(longest, jnp.linalg.norm(on_theta)) <= _NEAR * sigma
    result = choose(count <= max_steps, RESULTS.no_descent, RESULTS.not_converged)
    result = choose(settled, RESULTS.successful, result)
    result = choose(jnp.isfinite(cost), result, RESULTS.diverged)
    estimate = flat_constrained(assembly, values)
    noise = jnp.where(jnp.isfinite(cost), noise, jnp.nan).astype(dtype)
    return Solution(values, starts, estimate, certainty, noise, correlation, result)


def _levenberg_marquardt(
    linearised: Any, prior_rows: Any, start: _Point, max_steps: Int[Array, ""]
) -> tuple[_Point, Array]:
    """`(the best point, the number of points tried)`.

    The state at the beginning of a window moves nothing but that window, so it is
    eliminated there, and the cost of a step is linear in the number of windows; a
    solver of dense least squares would pay its cube. Steps are measured by the largest
    sensitivities so far (Moré, 1978), and so do not depend on units. It has converged
    where no step of the linear model is longer than a small part of what the noise
    makes the estimate differ by.
    """
    p, dtype = start.theta.size, start.residuals.dtype
    # Shares of the cost, a sum of squares: about the rounding of it in float32.
    small = 1e-9 if dtype == jnp.float64 else 1e-7
    rounding = 100 * jnp.finfo(dtype).eps ** 2 * start.residuals.size

    def body(carry):
        candidate, best, largest, damping, at_minimum, _, count = carry
        here = linearised(*candidate)
        better = here.cost < best.cost
        best = jax.tree.map(lambda a, b: jnp.where(better, a, b), here, best)
        # Less damping after a success than more after a failure: nearer to the steps
        # of Gauss and Newton. A step at the minimum fails by rounding alone.
        damping = jnp.where(better | at_minimum, damping / 8, damping * 4)
        damping = jnp.clip(damping, 1e-10, 1e10)
        by_theta, by_start, largest, units = _scaled(best, largest)
        known = prior_rows(best.theta, units[0])
        projected = _projected(by_theta, by_start, known, damping)
        R_x, on_starts, R, on_theta, _ = projected
        step = jsl.solve_triangular(R, on_theta)
        # Back substitution: once the step of theta is known, each window has its own.
        right = on_starts[..., p] - on_starts[..., :p] @ step
        steps = jax.vmap(jsl.solve_triangular)(R_x, right)
        # r + J z = 0, with J the derivative of the residuals themselves: the step is
        # -z.
        candidate = best.theta - step / units[0], best.starts - steps / units[1]
        # The decrease of the cost that the linear model predicts. A damped step falls
        # short of it, so it is a minimum only where a step that is hardly damped
        # predicts none.
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
    # The guess counts as a success, of a cost below infinity: from it the first step
    # goes with 1e-3.
    damping = jnp.zeros((), dtype) + 8e-3
    carry = first, start, none, damping, no, no, jnp.zeros((), int)
    _, best, *_, count = lax.while_loop(running, body, carry)
    return best, count


def _scaled(point: _Point, largest: Any) -> tuple[Array, Array, Any, Any]:
    """Sensitivities as multiples of the largest so far, these, and their units.

    The residuals are a last column of those by the parameters.
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
    """Eliminate the states at the beginnings of the windows, then the parameters, of
    which something is `known`, a row for each."""
    p = by_theta.shape[2] - 1
    eliminate = jax.vmap(_eliminate, in_axes=(0, 0, None))
    R_x, on_starts, left = eliminate(by_start, by_theta, damping)
    left = jnp.concatenate([left.reshape(-1, p + 1), known])
    R, on_theta, _ = _eliminate(left[:, :p], left[:, p:], damping)
    return R_x, on_starts, R, on_theta[:, 0], left


def _eliminate(A: Array, B: Array, damping: Any) -> tuple[Array, Array, Array]:
    """Least squares `min |A z - b|^2 + damping |z|^2` for the columns b of B.

    `(R, C, residual)`: `R z = C`, and the residual of B, one row longer per entry of z.
    """
    # By QR of [A; sqrt(damping) I], whose condition number is that of A, and not of
    # the normal equations A' A.
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


def relative_unit(estimate: Float[Array, " p"]) -> Float[Array, " p"]:
    """The unit of a relative change of each constrained value: itself, or 1 for 0."""
    return jnp.where(estimate == 0, 1, estimate)


def per_relative_change(
    assembly: Assembly, values: dict[str, Array]
) -> Float[Array, " p"]:
    """The change of each unconstrained value that makes a relative change of 1."""
    tangent = jax.tree.map(jnp.ones_like, values)
    flat = lambda values: flat_constrained(assembly, values)
    estimate, rate = jax.jvp(flat, (values,), (tangent,))
    return relative_unit(estimate) / rate
