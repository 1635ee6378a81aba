"""The result of an identification, with its uncertainty and identifiability."""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.special import ndtri
from jaxtyping import Array, Bool, Float

from ..._check import check_range, is_concrete
from ..._module import as_float_array
from ..._results import choose, first_failure, promote, Result, RESULTS


CORRELATED = 4.0
"""The threshold of the whiteness test, in standard deviations."""

_LOADS = 0.02
"""The share of an unknown direction in a parameter that makes the parameter unknown."""


class Identified(eqx.Module):
    """A model that was fitted to data, and how well the data determine it.

    The directions are singular vectors of the sensitivity of the data to relative
    changes of the parameters (to changes in units of the regressors' size, in a linear
    fit). Along each there is a spread, the standard deviation of the estimate; where it
    is as large as the parameter itself, or the data do not depend on it at all, the
    direction is not identifiable: the parameters can be moved along it together, and
    the data do not change.

    **Attributes:**

    - `model`: the fitted dynamics, like any other.
    - `names`: of the p parameters.
    - `estimate`: their values, shape `(p,)`; in a linear fit `(outputs, p)`.
    - `std`: their standard deviations, of the same shape; infinite for what is not
        identifiable, NaN where the fit did not converge.
    - `low`, `high`: the ends of their confidence intervals, of the same shape; those of
        all valid values, such as 0 and infinity, for what is not identifiable; NaN
        where the fit did not converge.
    - `directions`: shape `(p, p)`, a unit vector in each row, least known first.
    - `spread`: the standard deviation along each, shape `(p,)`; NaN where the fit did
        not converge.
    - `identifiable`: of each direction, shape `(p,)`; false where the fit did not
        converge.
    - `noise`: the standard deviation of the residuals of each output.
    - `correlation`: of the residuals at lag one, `sqrt(N) r`, with r the correlation
        coefficient over N steps, that of the output where it is largest;
        `None` in linear fits. In white noise it is about normal with variance 1. Above
        4 the model misses something or the noise is correlated; either way the
        intervals are too narrow, and the report says so. 0 where what remains is less
        than half of the `noise` that was given, or rounding.
    - `x0`: the estimated state at the beginning, shape `(n,)`, or `(runs, n)`; `None`
        where it is not estimated, in linear fits.
    - `result`: success; `RESULTS.unexciting` if a direction is not identifiable; or the
        failure of the solver.

    Printed, it is the table of `report`.

    Source: Ljung, 1999 (section 16.6: the whiteness of residuals).

    !!! example

        ```python
        import delucax as dlx
        import jax

        controls = jax.random.normal(jax.random.key(0), (50, 1))
        true = dlx.LinearDynamics([[0.9, 0.1], [0.0, 0.8]], [[0.0], [1.0]])
        states = dlx.open_loop(true, [0.0, 0.0], controls)
        fit = dlx.training.sysid.linear(
            dlx.training.sysid.Record(states, controls, dt=1.0)
        )
        print(fit.report())
        ```
    """

    model: Any
    names: tuple[str, ...] = eqx.field(static=True)
    estimate: Float[Array, "*outputs p"]
    std: Float[Array, "*outputs p"]
    low: Float[Array, "*outputs p"]
    high: Float[Array, "*outputs p"]
    directions: Float[Array, "p p"]
    spread: Float[Array, " p"]
    identifiable: Bool[Array, " p"]
    noise: Float[Array, " y"]
    correlation: Float[Array, ""] | None
    x0: Float[Array, "*runs n"] | None
    result: Result

    def __repr__(self):
        result: Any = self.result
        if is_concrete(self.estimate) and jnp.shape(result._value) == ():
            return self.report()
        return super().__repr__()

    def report(self) -> str:
        """A table of the parameters, with what is not identifiable in words, and
        whether the residuals are correlated.

        **Returns:** text of several lines. Where the fit did not converge it says why,
        and gives no intervals.
        """
        lines = [f"{'parameter':<24}{'estimate':>12}{'low':>12}{'high':>12}"]
        for *output, index in np.ndindex(self.estimate.shape):
            label = "".join(f"output {i}: " for i in output) + self.names[index]
            columns = (self.estimate, self.low, self.high)
            ends = [float(column[*output, index]) for column in columns]
            lines.append(f"{label:<24}" + "".join(f"{end:>12.5g}" for end in ends))
        failed = self.result != RESULTS.successful
        if failed and self.result != RESULTS.unexciting:
            why = RESULTS[self.result]
            lines.append(f"the fit failed, and has no intervals: {why}")
            return "\n".join(lines)
        for row in np.asarray(self.directions)[~np.asarray(self.identifiable)]:
            shares = zip(row, self.names, strict=True)
            parts = [f"{share:+.2f} {n}" for share, n in shares if abs(share) > _LOADS]
            lines.append("not identifiable: " + " ".join(parts))
        if np.all(self.identifiable):
            lines.append("all directions are identifiable")
        if self.correlation is not None and self.correlation > CORRELATED:
            lines.append(
                "the residuals are correlated from step to step: the model may be "
                "wrong, and the intervals are too narrow"
            )
        return "\n".join(lines)


def checked(fit: Identified, throw: bool) -> Identified:
    """`fit` with its final result, and without intervals where the solver failed."""
    intervals = lambda fit: [fit.std, fit.low, fit.high, fit.spread]
    judged = lambda fit: [*intervals(fit), fit.identifiable, fit.result]
    given = fit.estimate, fit.identifiable, fit.result, intervals(fit)
    fit = eqx.tree_at(judged, fit, _judged(*given))
    result: Any = fit.result
    return result.error_if(fit, result != RESULTS.successful) if throw else fit


@eqx.filter_jit
def _judged(estimate: Array, known: Array, result: Result, intervals: list) -> list:
    """The intervals, what is identifiable, and the result, if the fit is judged."""
    finite = jnp.all(jnp.isfinite(estimate))
    diverged = choose(finite, RESULTS.successful, RESULTS.diverged)
    solver = first_failure(promote(result), diverged)
    solved = solver == RESULTS.successful
    known = known & solved
    excited = choose(jnp.all(known), RESULTS.successful, RESULTS.unexciting)
    certain = [jnp.where(solved, end, jnp.nan) for end in intervals]
    return [*certain, known, first_failure(solver, excited)]


class Certainty(NamedTuple):
    """The uncertainty of an estimate, from the sensitivity of the data to it."""

    directions: Float[Array, "p p"]
    spread: Float[Array, " p"]
    identifiable: Bool[Array, " p"]
    std: Float[Array, "*outputs p"]

    @staticmethod
    def of(sensitivity: Array, sigma: Array, worst: Any) -> "Certainty":
        """From scaled residuals with a standard deviation `sigma`.

        `worst` is the spread from which on a direction counts as unknown.
        """
        rows, p = sensitivity.shape
        # With fewer rows than parameters the rest of the directions has no size.
        if rows < p:
            sensitivity = jnp.pad(sensitivity, ((0, p - rows), (0, 0)))
        # S = U diag(size) V': along v_i the estimate has the standard deviation
        # sigma / size_i, as its covariance is sigma^2 (S' S)^-1. A size below the
        # rounding of S counts as zero.
        _, size, directions = jnp.linalg.svd(sensitivity, full_matrices=False)
        eps = jnp.finfo(sensitivity.dtype).eps
        sensitive = size > 10 * max(rows, p) * eps * size[0]
        spread = jnp.where(sensitive, sigma / jnp.where(sensitive, size, 1), jnp.inf)
        known = sensitive & (spread < worst)
        share = jnp.abs(directions)
        # The variance of a parameter is the sum of what the directions add to it.
        added = (share * jnp.where(known, spread, 0)[:, None]) ** 2
        unknown = jnp.where(share > _LOADS, jnp.inf, 0)
        variance = jnp.sum(jnp.where(known[:, None], added, unknown), axis=0)
        # A sign for each direction, so that it is the same whatever the solver: the
        # first of the entries that are about the largest is positive.
        is_large = share > 0.9 * jnp.max(share, axis=1, keepdims=True)
        first = jnp.argmax(is_large, axis=1)[:, None]
        directions = directions * jnp.sign(jnp.take_along_axis(directions, first, 1))
        least_known_first = (a[::-1] for a in (directions, spread, known))
        return Certainty(*least_known_first, std=jnp.sqrt(variance))


def quantile(level: Any, where: str) -> Array:
    """The half-width of a confidence interval in standard deviations."""
    check_range(level, "level", where, 0, 1)
    return _two_sided(as_float_array(level))


@jax.jit
def _two_sided(level: Array) -> Array:
    return ndtri((1 + level) / 2)
