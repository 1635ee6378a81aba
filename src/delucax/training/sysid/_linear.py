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
    r"""Fit linear dynamics to a record of the state by least squares.

    $$\min_{A, B, c} \sum_k |x_{k+1} - A x_k - B u_k - c|^2$$

    Every state must be measured, without noise: noise in the states biases the
    estimate. The confidence intervals assume independent, identically distributed
    residuals.

    **Arguments:**

    - `record`: a [`delucax.training.sysid.Record`][] whose outputs are the states, or a
        list of them; uniform in time.
    - `affine`: whether to estimate the constant $c$; false by default, which means
        $c = 0$.
    - `level`: the confidence level of the intervals, 0.95 by default.
    - `throw`: raise an error if the data do not determine all entries; true by default.
        If false, check `result`.

    **Returns:** [`delucax.training.sysid.Identified`][]. Its `model` is a
    [`delucax.LinearDynamics`][]. Row i of `estimate` holds the entries of $A$, $B$ and
    $c$ for state i.

    **Raises:** `ValueError` if `record` is not a uniform record or a list of them; with
    `throw`, an error at run time if the data do not determine all entries.

    !!! example

        ```python
        import delucax as dlx
        import jax

        controls = jax.random.normal(jax.random.key(0), (50, 1))
        true = dlx.LinearDynamics([[0.9, 0.1], [0.0, 0.8]], [[0.0], [1.0]])
        states = dlx.open_loop(true, [0.0, 0.0], controls)
        record = dlx.training.sysid.Record(states, controls, dt=1.0)
        fit = dlx.training.sysid.linear(record)
        fit.model.A.round(3), fit.model.B.round(3)
        ```

        ```text
        (Array([[0.9, 0.1],
               [0. , 0.8]], dtype=float32),
         Array([[0.],
               [1.]], dtype=float32))
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

    return _fitted(matrices_of, names, records, lags, affine, reach, throw, where)


def arx(
    record: Records,
    *,
    outputs_back: int,
    controls_back: int,
    delay: int = 1,
    level: Any = 0.95,
    throw: bool = True,
) -> Identified:
    r"""Fit an autoregressive model with inputs (ARX) by least squares.

    $$y_k = \sum_{i=1}^{a} A_i y_{k-i} + \sum_{j=0}^{b-1} B_j u_{k-\mathrm{delay}-j}
    + e_k$$

    The model is returned as linear dynamics. The state of these dynamics at step k
    holds the past, `[outputs[k], ..., outputs[k-a+1], controls[k-1], ...]`, and the
    observation is $y_k$.

    **Arguments:**

    - `record`: a [`delucax.training.sysid.Record`][] or a list of them, uniform in
        time. `controls[k]` must not affect an output before `outputs[k + 1]`.
    - `outputs_back`: $a$, the number of past outputs.
    - `controls_back`: $b$, the number of past controls.
    - `delay`: the number of steps from a control to its first effect, 1 by default.
    - `level`: the confidence level of the intervals, 0.95 by default.
    - `throw`: raise an error if the data do not determine all entries; true by default.
        If false, check `result`.

    **Returns:** [`delucax.training.sysid.Identified`][]. Its `model` is a
    [`delucax.LinearDynamics`][]. Row i of `estimate` holds the entries of
    $A_1, \dots, A_a, B_0, \dots, B_{b-1}$ for output i.

    **Raises:** `ValueError` if `record` is not a uniform record or a list of them, a
    count is below 1, or a record has fewer steps than the model looks back; with
    `throw`, an error at run time if the data do not determine all entries.

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
        fit.estimate.round(3)
        ```

        ```text
        Array([[ 1.7 , -0.72,  0.  ,  0.1 ]], dtype=float32)
        ```
    """
    where = "sysid.arx"
    records = uniform_records(record, where)
    a = check_count(outputs_back, "outputs_back", where)
    b = check_count(controls_back, "controls_back", where)
    delay = check_count(delay, "delay", where)
    reach = quantile(level, where)
    p, m = records[0].outputs.shape[1], records[0].controls.shape[1]
    lags = range(1, a + 1), range(delay, delay + b)
    first = max(a, b + delay - 1)
    if (steps := min(map(len, records)) - 1) < first:
        raise ValueError(
            f"{where}: record must have at least {first} steps, as many as the model "
            f"looks back, got {steps}."
        )
    names = [f"y{i}(k-{lag})" for lag in lags[0] for i in range(p)]
    names += [f"u{i}(k-{lag})" for lag in lags[1] for i in range(m)]
    matrices_of = lambda estimate: _realised(estimate, p, m, a, b, delay)
    return _fitted(matrices_of, names, records, lags, False, reach, throw, where)


@eqx.filter_jit
def _regressors(
    groups: list[Record], lags: tuple[Any, Any], affine: bool
) -> tuple[Float[Array, "rows p"], Float[Array, "rows outputs"]]:
    """The past outputs and controls at these lags, and the outputs to be explained, for
    all steps whose whole past is recorded."""
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
    """The estimate and interval of each output, and the certainty of the output with
    the largest relative noise."""
    rows, p = regressors.shape
    # The regressors are scaled to size 1, so that the rank does not depend on units.
    size = jnp.sqrt(jnp.mean(regressors**2, axis=0))
    scale = jnp.where(size > 0, size, 1)
    scaled = regressors / scale
    operator = lx.MatrixLinearOperator(scaled)
    # The solution of least norm if the data do not determine all entries, with the same
    # threshold for the rank as in `Certainty.of`.
    solver = lx.SVD(rcond=10 * max(rows, p) * float(jnp.finfo(scaled.dtype).eps))
    one = lambda target: lx.linear_solve(operator, target, solver, throw=False).value
    estimate = jax.vmap(one, in_axes=1)(targets)
    rest = targets - scaled @ estimate.T
    # The fit uses up p of the degrees of freedom.
    noise = jnp.sqrt(jnp.sum(rest**2, axis=0) / max(rows - p, 1))
    # A direction is unknown if its spread is the size of the outputs themselves.
    typical = jnp.sqrt(jnp.mean(targets**2, axis=0))
    typical = jnp.where(typical > 0, typical, 1)
    worst = jnp.max(noise / typical)
    certainty = Certainty.of(scaled, worst, 1.0)
    # The covariance of output i is noise_i^2 (R' R)^-1: the outputs share the
    # regressors R and differ only in their noise.
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
    where: str,
) -> Identified:
    """Fit a linear model that predicts the outputs from the past at these lags."""
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
    return checked(fit, throw, where)


def _realised(estimate, p, m, a, b, delay) -> dict[str, Any]:
    """The matrices of dynamics whose state is the past that the ARX model needs."""
    # The state holds the controls u_{k-1}, ..., u_{k-held}; u_k is the input.
    held = b + delay - 2
    n = a * p + held * m
    # A is a block companion matrix: its first rows predict, and the others shift the
    # past by a step. The columns of `of_controls` belong to u_k, u_{k-1}, ...
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
