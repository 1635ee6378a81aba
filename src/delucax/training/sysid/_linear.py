"""Linear models by least squares."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import lineax as lx
import numpy as np
from jaxtyping import Array, Float

from ..._check import check_bool, check_count
from ..._host import host_unless_traced, xp
from ..._results import RESULTS
from ...dynamics import LinearDynamics
from ._identified import Certainty, checked, Identified, quantile
from ._record import grouped, Record, Records, uniform_records


def linear(
    record: Records,
    *,
    affine: bool = False,
    level: Any = 0.95,
    throw: bool = True,
) -> Identified:
    r"""Linear dynamics by least squares on the steps of a record of the state,

    `min over A, B, c of sum_k |x_{k+1} - A x_k - B u_k - c|^2`.

    The recorded states are assumed to be free of noise, which would bias the estimate.
    Intervals assume independent, identically distributed residuals.

    **Arguments:**

    - `record`: a [`delucax.training.sysid.Record`][], whose outputs are the states, or
        a list of them; uniform in time.
    - `affine`: whether to estimate a constant c too; false by default.
    - `level`: of the confidence intervals, 0.95 by default.
    - `throw`: raise if the data do not tell all entries (default); if false, look at
        `result`.

    **Returns:** [`delucax.training.sysid.Identified`][]; its `model` is a
    [`delucax.LinearDynamics`][], and row i of its `estimate` holds the entries of A, B
    and c for the state i.

    **Raises:** `ValueError` if `record` is not one; an error at run time as `throw`
    says.

    !!! example

        ```python
        import delucax as dlx
        import jax

        controls = jax.random.normal(jax.random.key(0), (50, 1))
        true = dlx.LinearDynamics([[0.9, 0.1], [0.0, 0.8]], [[0.0], [1.0]])
        states = dlx.open_loop(true, [0.0, 0.0], controls)
        record = dlx.training.sysid.Record(states, controls, dt=1.0)
        fit = dlx.training.sysid.linear(record)
        fit.model.A, fit.model.B, fit.std
        ```
    """
    where = "sysid.linear"
    records = uniform_records(record, where)
    affine = check_bool(affine, "affine", where)
    reach = quantile(level, where)
    n, m = records[0].outputs.shape[1], records[0].controls.shape[1]
    names = [f"x{i}" for i in range(n)] + [f"u{i}" for i in range(m)]
    names += ["1"] if affine else []
    lags = (1,), (1,)

    def matrices_of(estimate):
        matrices = dict(A=estimate[:, :n], B=estimate[:, n : n + m])
        return matrices | (dict(x_next=estimate[:, -1]) if affine else {})

    return _fitted(matrices_of, names, records, lags, affine, reach, throw)


def arx(
    record: Records,
    *,
    outputs_back: int,
    controls_back: int,
    delay: int = 1,
    level: Any = 0.95,
    throw: bool = True,
) -> Identified:
    r"""An autoregressive model with inputs (ARX) by least squares,

    `y_k = sum_{i=1}^{a} A_i y_{k-i} + sum_{j=0}^{b-1} B_j u_{k-delay-j} + e_k`,

    as linear dynamics whose state is the past `(y_k, ..., y_{k-a+1}, u_{k-1}, ...)` and
    whose observation is `y_k`.

    **Arguments:**

    - `record`: a [`delucax.training.sysid.Record`][] or a list of them, uniform in
        time; `outputs[k + 1]` is the first that `controls[k]` may move.
    - `outputs_back`: a, the outputs looked back on.
    - `controls_back`: b, the controls looked back on.
    - `delay`: steps from a control to its first effect, 1 by default.
    - `level`: of the confidence intervals, 0.95 by default.
    - `throw`: raise if the data do not tell all entries (default); if false, look at
        `result`.

    **Returns:** [`delucax.training.sysid.Identified`][]; row i of its `estimate` holds
    the entries of `A_1, ..., A_a, B_0, ..., B_{b-1}` for the output i. The state of the
    model at step k is `[outputs[k], ..., outputs[k-a+1], controls[k-1], ...]`.

    **Raises:** `ValueError` if `record` is not one, on counts below 1, or fewer steps
    than are looked back on; an error at run time as `throw` says.

    Source: Ljung, 1999.

    !!! example

        ```python
        import delucax as dlx
        import jax

        controls = jax.random.normal(jax.random.key(0), (50, 1))
        true = dlx.LinearDynamics([[0.9, 0.1], [0.0, 0.8]], [[0.0], [1.0]])
        angles = dlx.open_loop(true, [0.0, 0.0], controls)[:, :1]
        back = dict(outputs_back=2, controls_back=2)
        record = dlx.training.sysid.Record(angles, controls, dt=1.0)
        fit = dlx.training.sysid.arx(record, **back, throw=False)
        fit.estimate
        ```
    """
    where = "sysid.arx"
    records = uniform_records(record, where)
    a = check_count(outputs_back, "outputs_back", where)
    b = check_count(controls_back, "controls_back", where)
    delay = check_count(delay, "delay", where)
    reach = quantile(level, where)
    p, m = records[0].outputs.shape[1], records[0].controls.shape[1]
    # Output k is made of outputs k - i and of controls k - delay - j.
    lags = range(1, a + 1), range(delay, delay + b)
    first = max(a, b + delay - 1)
    if (steps := min(map(len, records)) - 1) < first:
        raise ValueError(
            f"{where}: record must have more than the {first} steps that are looked "
            f"back on, got {steps}."
        )
    names = [f"y{i}(k-{lag})" for lag in lags[0] for i in range(p)]
    names += [f"u{i}(k-{lag})" for lag in lags[1] for i in range(m)]
    matrices_of = lambda estimate: _realised(estimate, p, m, a, b, delay)
    return _fitted(matrices_of, names, records, lags, False, reach, throw)


@eqx.filter_jit
def _regressors(
    groups: list[Record], lags: tuple[Any, Any], affine: bool
) -> tuple[Float[Array, "rows p"], Float[Array, "rows outputs"]]:
    """`(regressors, targets)`: for each output whose whole past is recorded, the
    outputs and the controls at these lags."""
    first = max(*lags[0], *lags[1])

    def of(record):
        y, count = record.outputs, len(record)
        signals = zip((y, record.controls), lags, strict=True)
        past = [a[first - k : count - k] for a, own in signals for k in own]
        past += [jnp.ones((count - first, 1), y.dtype)] * affine
        return jnp.concatenate(past, axis=1), y[first:]

    parts = [jax.vmap(of)(group) for group in groups]
    flat = lambda arrays: [array.reshape(-1, array.shape[2]) for array in arrays]
    regressors, targets = (
        jnp.concatenate(flat(arrays)) for arrays in zip(*parts, strict=True)
    )
    return regressors, targets


@jax.jit
def _least_squares(
    regressors: Float[Array, "rows p"],
    targets: Float[Array, "rows outputs"],
    reach: Array,
) -> tuple[dict[str, Array], Certainty]:
    """The estimate of each output with its interval, and what the data tell of the
    output with the largest relative noise."""
    rows, p = regressors.shape
    # In units of the regressors' size, so that the rank does not depend on units.
    size = jnp.sqrt(jnp.mean(regressors**2, axis=0))
    scale = jnp.where(size > 0, size, 1)
    scaled = regressors / scale
    operator = lx.MatrixLinearOperator(scaled)
    # The solution of least norm where the data do not tell all, by the same measure of
    # rounding as `Certainty.of`.
    solver = lx.SVD(rcond=10 * max(rows, p) * float(jnp.finfo(scaled.dtype).eps))
    one = lambda target: lx.linear_solve(operator, target, solver, throw=False).value
    estimate = jax.vmap(one, in_axes=1)(targets)
    rest = targets - scaled @ estimate.T
    # Over rows - p degrees of freedom, not rows: p of them the fit has used up.
    noise = jnp.sqrt(jnp.sum(rest**2, axis=0) / max(rows - p, 1))
    # Unknown where its spread is the size of the outputs themselves.
    typical = jnp.sqrt(jnp.mean(targets**2, axis=0))
    typical = jnp.where(typical > 0, typical, 1)
    worst = jnp.max(noise / typical)
    certainty = Certainty.of(scaled, worst, 1.0)
    # The covariance of output i is noise_i^2 (R' R)^-1: all outputs share the
    # regressors R, and differ in their noise alone.
    unit = certainty.std / jnp.where(worst > 0, worst, 1)
    std = noise[:, None] * unit / scale
    std = jnp.where(jnp.isinf(certainty.std), jnp.inf, jnp.where(worst > 0, std, 0))
    estimate = estimate / scale
    certainty = certainty._replace(
        std=std, identifiable=certainty.identifiable & (rows >= p)
    )
    ends = dict(low=estimate - reach * std, high=estimate + reach * std)
    return dict(estimate=estimate, noise=noise, **ends), certainty


def _fitted(
    matrices_of: Callable[[Any], dict[str, Any]],
    names: list[str],
    records: list[Record],
    lags: tuple[Any, Any],
    affine: bool,
    reach: Array,
    throw: bool,
) -> Identified:
    """The linear model of the outputs by outputs and controls at these lags."""
    lags = tuple(lags[0]), tuple(lags[1])
    rows = _regressors(grouped(records), lags, affine)
    of_outputs, certainty = _least_squares(*rows, reach)
    matrices = host_unless_traced(matrices_of)(of_outputs["estimate"])
    fit = Identified(
        model=LinearDynamics(dt=records[0].dt, **matrices),
        names=tuple(names),
        **of_outputs,
        **certainty._asdict(),
        correlation=None,
        x0=None,
        result=RESULTS.successful,
    )
    return checked(fit, throw)


def _realised(estimate, p, m, a, b, delay) -> dict[str, Any]:
    """The matrices of dynamics whose state is the past that the estimate looks back
    on."""
    # u_{k-1}, ..., u_{k-held}; the control itself is the input.
    held = b + delay - 2
    n = a * p + held * m
    # A is a block companion matrix: the first rows predict, the others move the past on
    # by a step.
    # The coefficients of u_{k-1}, u_{k-2}, ..., of which the first is not in the state.
    of_controls = xp.pad(estimate[:, a * p :], ((0, 0), ((delay - 1) * m, 0)))
    rows = [
        xp.concatenate([estimate[:, : a * p], of_controls[:, m:]], axis=1),
        np.eye(n, k=-p)[p : a * p],
        np.zeros((m, n))[: held * m],
        np.eye(n, k=-m)[a * p + m :],
    ]
    A = xp.concatenate(rows).astype(estimate.dtype)
    rows = [of_controls[:, :m], np.zeros(((a - 1) * p, m)), np.eye(held * m, m)]
    B = xp.concatenate(rows).astype(estimate.dtype)
    C = np.eye(p, n, dtype=estimate.dtype)
    return dict(A=A, B=B, C=C)
