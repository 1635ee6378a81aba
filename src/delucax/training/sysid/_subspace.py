"""Subspace identification of linear state-space models."""

from typing import Any

import equinox as eqx
import jax
import jax.lax as lax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..._check import check_at_most, check_bool, check_count
from ..._module import shown
from ..._results import choose, first_failure, raise_on_failure, Result, RESULTS
from ...dynamics import LinearDynamics
from ._hankel import Realised, realised, Units
from ._record import grouped, Record, Records, uniform_records


_WHERE = "sysid.subspace"
_LEAST_HORIZON = 10


class Subspace(eqx.Module):
    r"""The result of [`delucax.training.sysid.subspace`][].

    **Attributes:**

    - `model`: a [`delucax.LinearDynamics`][], $x_{k+1} = A x_k + B u_k$, $y_k = C x_k$.
        With `affine=True`, `x`, `u` and `y` are deviations from an operating point.
    - `singular_values`: shape `(horizon p,)`, in descending order, in units of the
        spread of the outputs. If the values have a clear gap, the number of values
        before the gap is the order that the model needs.
    - `x0`: the first state, shape `(n,)`, or `(records, n)` for a list of records.
    - `gain`: $K$ of the Kalman predictor $x_{k+1} = A x_k + B u_k + K (y_k - C x_k)$,
        shape `(n, p)`.
    - `start_gain`: the gain of a second predictor, shape `(n, p)`. $B$ and the first
        states were fitted to the errors of this predictor. For a stable model the gain
        is nearly zero, so that the predictor is a free run. For an unstable model the
        gain makes the predictor stable.
    - `error`: the root mean square of the errors `y - C x` of the predictor with the
        gain `start_gain`, shape `(p,)`.
    - `result`: success; `RESULTS.unexciting` if the controls do not excite the system
        enough; `RESULTS.diverged` if the model is not finite.

    !!! example

        ```python
        import delucax as dlx
        import jax

        controls = jax.random.normal(jax.random.key(0), (200, 1))
        A, B, C = [[0.9, 0.3], [-0.3, 0.9]], [[0.0], [1.0]], [[1.0, 0.0]]
        true = dlx.LinearDynamics(A, B, C)
        outputs = dlx.open_loop(true, [1.0, 0.0], controls)[:, :1]
        record = dlx.training.sysid.Record(outputs, controls, dt=1.0)
        fit = dlx.training.sysid.subspace(record[:150], 2)
        fit.start(record[150:])
        ```
    """

    model: LinearDynamics
    singular_values: Float[Array, " values"]
    x0: Float[Array, "*records n"]
    gain: Float[Array, "n p"]
    start_gain: Float[Array, "n p"]
    error: Float[Array, " p"]
    result: Result

    __repr__ = shown

    def start(self, record: Records) -> Float[Array, "*records n"]:
        """Estimate the first state of another record from all of its samples.

        From this state, the predictor with `start_gain` has the smallest sum of squared
        errors. For a stable model this predictor is a free run.

        **Arguments:** `record`: a [`delucax.training.sysid.Record`][] or a list of
        them; uniform in time.

        **Returns:** shape `(n,)`, or `(records, n)` for a list.

        **Raises:** `ValueError` if `record` is not a uniform record or a list of them,
        or does not have the numbers of outputs and controls of the model.
        """
        where = "Subspace.start"
        records = uniform_records(record, where)
        sizes = len(self.error), self.model.control_size
        given = records[0].outputs.shape[1], records[0].controls.shape[1]
        if given != sizes:
            raise ValueError(
                f"{where}: record must have {sizes[0]} outputs and {sizes[1]} controls,"
                f" as the model has, got {given[0]} and {given[1]}."
            )
        starts = _starts(self.model, self.start_gain, grouped(records))
        return starts[0] if isinstance(record, Record) else starts


def subspace(
    record: Records,
    order: int,
    *,
    horizon: int | None = None,
    affine: bool = False,
    throw: bool = True,
) -> Subspace:
    r"""Fit a linear state-space model of outputs and controls by a subspace method.

    $$x_{k+1} = A x_k + B u_k + K e_k, \qquad y_k = C x_k + e_k, \qquad
    e \text{ white noise}$$

    The method needs no first guess and no iterations. The method predicts the outputs
    of the next `horizon` steps from the past, and removes the effect of the controls of
    these steps. The remaining prediction has as many independent directions as the
    system has states. To find these directions, the Hankel matrices are factorised into
    a triangular and an orthogonal matrix. The directions are the singular vectors of a
    block of the triangular matrix, and they give $A$, $C$ and $K$. Then $B$, the first
    states and the operating point are computed by linear least squares, so that a free
    run of the model has the smallest squared error. The computing time and the memory
    grow linearly with the number of samples.

    The model is strictly proper: a control affects the outputs from the next sample on,
    as in all dynamics of this library. If your control affects the output of the same
    sample, fit `Record(outputs[:-1], controls[1:], dt=dt)`. Controls that depend on the
    noise, such as the controls of a feedback, bias the estimate. The model is not
    forced to be stable: if the order is too high, it may have an unstable mode.

    **Arguments:**

    - `record`: a [`delucax.training.sysid.Record`][] or a list of them, uniform in
        time, with any number of outputs and controls.
    - `order`: n, the number of states. The `singular_values` of the result show how
        many states are needed. They do not depend on `order` if you pass `horizon`.
    - `horizon`: the number of future steps that are predicted, and also the number of
        past steps that are used. A longer horizon reduces the effect of noise, because
        it averages over more samples. By default the horizon is the larger of 10 and
        twice the order, or shorter if the records have too few samples.
    - `affine`: whether to estimate an operating point too, for outputs and controls
        that are not measured from an equilibrium; false by default.
    - `throw`: raise an error if the controls do not excite the system enough; true by
        default. If false, check `result`.

    **Returns:** [`delucax.training.sysid.Subspace`][]. The model is in balanced
    coordinates: its states are ordered by how much they contribute to the outputs.

    **Raises:** `ValueError` if `record` is not a uniform record or a list of them, a
    count is below 1, `order` exceeds `(horizon - 1)` times the number of outputs, or
    there are too few samples for the horizon; an error at run time as `throw` says, if
    the controls are not persistently exciting, for example constant or the sum of fewer
    than `(horizon + order) / 2` sines.

    Source: Van Overschee and De Moor, 1994 and 1996 (N4SID); Verhaegen and Dewilde,
    1992 (the weights, MOESP); Ljung, 1999.

    !!! example

        ```python
        import delucax as dlx
        import jax

        controls = jax.random.normal(jax.random.key(0), (200, 1))
        A, B, C = [[0.9, 0.3], [-0.3, 0.9]], [[0.0], [1.0]], [[1.0, 0.0]]
        true = dlx.LinearDynamics(A, B, C)
        outputs = dlx.open_loop(true, [1.0, 0.0], controls)[:, :1]
        record = dlx.training.sysid.Record(outputs, controls, dt=1.0)
        fit = dlx.training.sysid.subspace(record, order=2)
        fit.singular_values[:3].round(3)
        ```

        ```text
        Array([2.023, 1.483, 0.   ], dtype=float32)
        ```
    """
    records = uniform_records(record, _WHERE)
    order = check_count(order, "order", _WHERE)
    affine = check_bool(affine, "affine", _WHERE)
    throw = check_bool(throw, "throw", _WHERE)
    p, m = records[0].outputs.shape[1], records[0].controls.shape[1]
    if affine:
        check_at_most(p, order, "the number of outputs", _WHERE, "states, if affine")
    horizon = _checked_horizon(horizon, order, p, m, affine, records)
    groups = grouped(records)
    units, known = realised(groups, order, horizon, affine)
    matrices: Any
    matrices, rest = _regressed(known, units, groups, affine)
    if isinstance(record, Record):
        rest["x0"] = rest["x0"][0]
    model = LinearDynamics(dt=records[0].dt, **matrices)
    fit = Subspace(model, singular_values=known.singular_values, **rest)
    return raise_on_failure(fit, _WHERE, throw, "the fit")


def _checked_horizon(
    horizon: Any, order: int, p: int, m: int, affine: bool, records: list[Record]
) -> int:
    """The horizon, checked against the order and the number of samples."""

    rows = lambda h: affine + 2 * h * (m + p)
    columns = lambda h: sum(max(0, len(record) - 2 * h + 1) for record in records)
    # A comes from the outputs of the horizon but one step; they must determine all
    # states.
    least = -(-order // p) + 1
    if horizon is None:
        horizon = max(_LEAST_HORIZON, 2 * order)
        while horizon > least and columns(horizon) < rows(horizon):
            horizon -= 1
    horizon = check_count(horizon, "horizon", _WHERE)
    most = (horizon - 1) * p
    check_at_most(order, most, "order", _WHERE, "outputs of horizon - 1 steps")
    if columns(horizon) < rows(horizon):
        raise ValueError(
            f"{_WHERE}: record must have at least {rows(horizon)} windows of "
            f"{2 * horizon} samples for a horizon of {horizon} steps, got "
            f"{columns(horizon)} in {sum(map(len, records))} samples."
        )
    return horizon


@eqx.filter_jit
def _regressed(
    known: Realised, units: Units, groups: list[Record], affine: bool
) -> tuple[dict[str, Array], dict[str, Any]]:
    """Fit B, the operating point and the first states to the errors of the predictor.

    Returns the matrices of the model, and the other results, in the units of the
    records.
    """
    A, C, gain = known.A, known.C, known.start_gain
    (p, n), m = C.shape, groups[0].controls.shape[2]
    dtype = A.dtype
    predictor = A - gain @ C

    def of(y, u):
        """The regressors of the outputs for the first state, B and the offset, and the
        outputs that they must explain."""

        def step(Z, inputs):
            y, u = inputs
            moved = jnp.kron(u[None], jnp.eye(n, dtype=dtype))
            parts = [jnp.zeros((n, n), dtype), moved, -gain, (gain @ y)[:, None]]
            return predictor @ Z + jnp.concatenate(parts, axis=1), C @ Z

        width = n + n * m + p
        Z = jnp.eye(n, width + 1, dtype=dtype)
        _, rows = lax.scan(step, Z, (y, u))
        rows = rows + jnp.eye(p, width + 1, n + n * m, dtype=dtype)
        table = rows[..., :width].reshape(-1, width)
        # Without an offset, its columns are left out.
        table = table if affine else table[:, : n + n * m]
        return table, (y - rows[..., -1]).reshape(-1)

    tables = [jax.vmap(of)(*units.of(group)) for group in groups]
    factors = [jax.vmap(_triangle)(*pair) for pair in tables]
    # Each record has its own first state; B and the offset are common to all.
    common = jnp.concatenate(
        [f[:, n:, n:].reshape(-1, f.shape[2] - n) for f in factors]
    )
    shared = _solved(common[:, :-1], common[:, -1])
    own = lambda f: _solved(f[:n, :n], f[:n, -1] - f[:n, n:-1] @ shared)
    starts = [jax.vmap(own)(factor) for factor in factors]
    rest = [
        target - jnp.einsum("rkq,rq->rk", table[..., :n], x0) - table[..., n:] @ shared
        for (table, target), x0 in zip(tables, starts, strict=True)
    ]
    rest = jnp.concatenate([errors.reshape(-1, p) for errors in rest])
    (y_mean, y_size), (u_mean, u_size) = units
    error = y_size * jnp.sqrt(jnp.mean(rest**2, axis=0))
    B = shared[: n * m].reshape(m, n).T
    matrices = dict(A=A, B=B / u_size, C=y_size[:, None] * C)
    x0 = jnp.concatenate(starts)
    if affine:
        level = y_mean + y_size * shared[n * m :]
        x_ref = jnp.linalg.pinv(matrices["C"]) @ level
        matrices |= dict(x_ref=x_ref, u_ref=u_mean)
        x0 = x0 + x_ref
    finite = jnp.all(jnp.isfinite(x0)) & jnp.all(jnp.isfinite(B))
    result = choose(known.excited, RESULTS.successful, RESULTS.unexciting)
    result = first_failure(result, choose(finite, RESULTS.successful, RESULTS.diverged))
    # A model must hold finite numbers. `result` says that the fit failed.
    matrices = jax.tree.map(lambda M: jnp.where(finite, M, 0), matrices)
    gains = dict(gain=known.gain / y_size, start_gain=known.start_gain / y_size)
    return matrices, dict(x0=x0, error=error, result=result, **gains)


def _triangle(table: Float[Array, "rows q"], target: Float[Array, " rows"]) -> Array:
    """The triangular factor of a table with its target as the last column."""
    joined = jnp.concatenate([table, target[:, None]], axis=1)
    # Pad to at least as many rows as columns.
    lacking = max(0, joined.shape[1] - len(joined))
    return jnp.linalg.qr(jnp.pad(joined, ((0, lacking), (0, 0))), mode="r")


def _solved(table: Array, target: Array) -> Array:
    """The least-squares solution, with the least norm if it is not unique."""
    return jnp.linalg.lstsq(table, target)[0]


@eqx.filter_jit
def _starts(model: LinearDynamics, gain: Array, groups: list[Record]) -> Array:
    """The first states from which the predictor has the least squared error."""
    n, C = model.state_size, model.C
    assert C is not None
    predictor = model.A - gain @ C

    def of(record):
        def step(Z, inputs):
            y, u = inputs
            known = model.B @ u + gain @ y
            return predictor @ Z + jnp.pad(known[:, None], ((0, 0), (n, 0))), C @ Z

        y, u = record.outputs - C @ model.x_ref, record.controls - model.u_ref
        _, rows = lax.scan(step, jnp.eye(n, n + 1, dtype=y.dtype), (y, u))
        target = (y - rows[..., -1]).reshape(-1)
        return model.x_ref + _solved(rows[..., :n].reshape(-1, n), target)

    return jnp.concatenate([jax.vmap(of)(group) for group in groups])
