"""The result of a fit, with its uncertainty and identifiability."""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.special import ndtri
from jaxtyping import Array, Bool, Float

from ..._check import check_range, is_concrete
from ..._module import as_float_array
from ..._results import (
    choose,
    first_failure,
    promote,
    raise_on_failure,
    Result,
    RESULTS,
)


CORRELATED = 4.0
"""The threshold of the whiteness test, in standard deviations."""

_LOADS = 0.02
"""A parameter is unknown if its entry in an unknown direction exceeds this."""


class Identified(eqx.Module):
    r"""A model that was fitted to data, and how well the data determine it.

    A direction is a combination of relative changes of the parameters. In a linear fit,
    the changes are not relative, but scaled with the size of the regressors. The
    directions are the singular vectors of the sensitivity of the data to relative
    changes of the parameters. The spread of a direction is the standard deviation of
    the estimate along this direction. A direction is not identifiable if the data do
    not depend on it, or if its spread is as large as the parameters themselves. Along a
    direction that is not identifiable, the parameters can change together without a
    clear effect on the data. A parameter without a constraint may be zero, so the
    spread is not compared with the size of such a parameter. If its estimate is near
    zero, its relative change is the change divided by a hundred of its standard
    deviations, not by the estimate.

    Printing the object prints the table of `report`.

    **Attributes:**

    - `model`: the fitted dynamics.
    - `names`: the names of the p parameters.
    - `estimate`: the values of the parameters, shape `(p,)`; `(outputs, p)` in a linear
        fit.
    - `std`: the standard deviations of the estimates, same shape. A standard deviation
        is infinite if the parameter is not identifiable, and NaN if the fit did not
        converge.
    - `low`, `high`: the ends of the confidence intervals of the parameters, same shape.
        If a parameter is not identifiable, its interval spans all valid values, for
        example 0 to infinity. If the fit did not converge, both ends are NaN.
    - `directions`: a unit vector in each row, shape `(p, p)`; the first row is the
        direction that the data determine least.
    - `spread`: the standard deviation along each direction, shape `(p,)`; NaN if the
        fit did not converge.
    - `identifiable`: whether each direction is identifiable, shape `(p,)`; false if the
        fit did not converge.
    - `noise`: the standard deviation of the residuals of each output.
    - `correlation`: the number $\sqrt N\, r$, a test of whether the residuals are
        white. Here $N$ is the number of samples, and $r$ is the correlation coefficient
        of the residuals at lag one, for the output where it is largest. For white
        residuals, this number has approximately a standard normal distribution. If it
        is above 4, the model is wrong or the noise is correlated. In both cases the
        confidence intervals are too narrow, and `report` says so. The number is 0 if
        the residuals are only rounding errors, or less than half of the `noise` that
        you passed. In linear fits it is `None`.
    - `x0`: the estimated first state, shape `(n,)`, or `(runs, n)` for a list of
        records; `None` in linear fits, which do not estimate the first state.
    - `window`, `burn_in`: the options of the fit, in steps; `None` and 0 in linear
        fits.
    - `result`: success; `RESULTS.unexciting` if a direction is not identifiable; or the
        reason why the solver failed.

    Source: Ljung, 1999 (section 16.6: the whiteness of residuals).

    !!! example

        ```python
        import delucax as dlx
        import jax

        controls = jax.random.normal(jax.random.key(0), (50, 1))
        true = dlx.LinearDynamics([[0.9, 0.1], [0.0, 0.8]], [[0.0], [1.0]])
        w = 0.01 * jax.random.normal(jax.random.key(1), (50, 2))
        states = dlx.open_loop(true, [0.0, 0.0], controls, w)
        record = dlx.training.sysid.Record(states, controls, dt=1.0)
        fit = dlx.training.sysid.linear(record)
        print(fit.report())
        ```

        ```text
        parameter                   estimate         low        high
        output 0: x0                  0.9006      0.8958      0.9055
        output 0: x1                  0.1022      0.0997      0.1046
        output 0: u0                  0.0019     -0.0012      0.0050
        output 1: x0                 -0.0012     -0.0057      0.0033
        output 1: x1                  0.8005      0.7982      0.8028
        output 1: u0                  0.9988      0.9959      1.0017
        all directions are identifiable
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
    window: int | None = eqx.field(static=True, default=None)
    burn_in: int = eqx.field(static=True, default=0)

    def __repr__(self):
        result: Any = self.result
        if is_concrete(self.estimate) and jnp.shape(result._value) == ():
            return self.report()
        return super().__repr__()

    def report(self) -> str:
        """A table of the parameters with their intervals.

        The report also names the directions that are not identifiable, and warns if the
        residuals are correlated.

        **Returns:** a string of several lines. If the fit did not converge, the report
        says why, and gives no intervals.
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
            lines.append(f"the fit failed, so there are no intervals: {why}")
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


def checked(fit: Identified, throw: bool, where: str) -> Identified:
    """`fit` with its final result, and without intervals if the solver failed."""
    intervals = lambda fit: [fit.std, fit.low, fit.high, fit.spread]
    judged = lambda fit: [*intervals(fit), fit.identifiable, fit.result]
    given = fit.estimate, fit.identifiable, fit.result, intervals(fit)
    fit = eqx.tree_at(judged, fit, _judged(*given))
    # The table names the directions that are not identifiable.
    facts = lambda: f"\n\n{fit.report()}\n\n"
    return raise_on_failure(fit, where, throw, "the fit", facts)


@eqx.filter_jit
def _judged(estimate: Array, known: Array, result: Result, intervals: list) -> list:
    """The final intervals, identifiable directions and result of a fit."""
    finite = jnp.all(jnp.isfinite(estimate))
    diverged = choose(finite, RESULTS.successful, RESULTS.diverged)
    solver = first_failure(promote(result), diverged)
    solved = solver == RESULTS.successful
    known = known & solved
    excited = choose(jnp.all(known), RESULTS.successful, RESULTS.unexciting)
    certain = [jnp.where(solved, end, jnp.nan) for end in intervals]
    return [*certain, known, first_failure(solver, excited)]


class Certainty(NamedTuple):
    """The uncertainty of an estimate, from the sensitivity of the data."""

    directions: Float[Array, "p p"]
    spread: Float[Array, " p"]
    identifiable: Bool[Array, " p"]
    std: Float[Array, "*outputs p"]

    @staticmethod
    def of(
        sensitivity: Array, sigma: Array, worst: Any, relative: Any = True
    ) -> "Certainty":
        """The certainty if the scaled residuals have the standard deviation `sigma`.

        A direction is unknown if its spread along the parameters that are `relative`,
        those that cannot be zero, is at least `worst`.
        """
        rows, p = sensitivity.shape
        # With fewer rows than parameters, the remaining directions have size zero.
        if rows < p:
            sensitivity = jnp.pad(sensitivity, ((0, p - rows), (0, 0)))
        # S = U diag(size) V' and the covariance is sigma^2 (S' S)^-1, so the standard
        # deviation along v_i is sigma / size_i. A size below the rounding of S counts
        # as zero.
        _, size, directions = jnp.linalg.svd(sensitivity, full_matrices=False)
        eps = jnp.finfo(sensitivity.dtype).eps
        sensitive = size > 10 * max(rows, p) * eps * size[0]
        spread = jnp.where(sensitive, sigma / jnp.where(sensitive, size, 1), jnp.inf)
        share = jnp.abs(directions)
        reach = jnp.linalg.norm(jnp.where(relative, share, 0), axis=1)
        known = sensitive & (jnp.where(sensitive, spread, 0) * reach < worst)
        # The variance of a parameter is the sum of the shares of all directions.
        added = (share * jnp.where(known, spread, 0)[:, None]) ** 2
        unknown = jnp.where(share > _LOADS, jnp.inf, 0)
        variance = jnp.sum(jnp.where(known[:, None], added, unknown), axis=0)
        # Fix the sign of each direction, which the solver leaves open: among its
        # largest entries, up to 10%, the first is positive.
        is_large = share > 0.9 * jnp.max(share, axis=1, keepdims=True)
        first = jnp.argmax(is_large, axis=1)[:, None]
        directions = directions * jnp.sign(jnp.take_along_axis(directions, first, 1))
        least_known_first = (a[::-1] for a in (directions, spread, known))
        return Certainty(*least_known_first, std=jnp.sqrt(variance))


def quantile(level: Any, where: str) -> Array:
    """The half-width of a confidence interval, in standard deviations."""
    check_range(level, "level", where, 0, 1)
    return _two_sided(as_float_array(level))


@jax.jit
def _two_sided(level: Array) -> Array:
    return ndtri((1 + level) / 2)
