"""Linear state-space models of outputs and controls, by subspaces."""

from typing import Any

import equinox as eqx
import jax
import jax.lax as lax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..._check import check_at_most, check_bool, check_count
from ..._module import shown
from ..._results import choose, first_failure, Result, RESULTS
from ...dynamics import LinearDynamics
from ._hankel import Realised, realised, Units
from ._record import grouped, Record, Records, uniform_records


_WHERE = "sysid.subspace"
_LEAST_HORIZON = 10


class Subspace(eqx.Module):
    """A linear model of outputs and controls, as [`delucax.training.sysid.subspace`][]
    returns it.

    **Attributes:**

    - `model`: a [`delucax.LinearDynamics`][], `x_next = A x + B u`, `y = C x`; about an
        operating point, where the fit was affine.
    - `singular_values`: shape `(horizon p,)`, in falling order. The order is their
        number before the largest gap, if there is one. 1 is the spread of the outputs.
    - `x0`: the first state, shape `(n,)`, or one for each record, `(records, n)`.
    - `gain`: K of the Kalman predictor, `x_next = A x + B u + K (y - C x)`, shape
        `(n, p)`.
    - `start_gain`: that of the predictor by which B and the first states were fitted.
        About zero for a stable model, so that its prediction is a free run; for
        another, one that makes it stable. Shape `(n, p)`.
    - `error`: the root mean square of `y - C x` in the latter, shape `(p,)`.
    - `result`: success; `RESULTS.unexciting` if the controls do not move the system
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
        """The first state of other records, from all of their samples: that from which
        a free run (for a model that is not stable, the predictor with `start_gain`)
        errs least, in the sum of squares.

        **Arguments:** `record`: a [`delucax.training.sysid.Record`][] or a list of
        them; uniform in time.

        **Returns:** shape `(n,)`, or `(records, n)` for a list.

        **Raises:** `ValueError` if `record` is none, or has other outputs or controls.
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
    r"""A linear state-space model of outputs and controls, without a first guess and
    without iterations,

    `x_{k+1} = A x_k + B u_k + K e_k`, `y_k = C x_k + e_k`, with e white.

    What the past tells of the outputs of the next `horizon` steps, beside what the
    controls of these steps do, has as many directions as there are states. They are
    the singular vectors of a block of the triangular factor of all stretches of
    `2 horizon` samples, and give A, C and K. B, the first states and the operating
    point then follow by linear least squares on the errors of a free run. The factor is
    updated by some thousand stretches at a time, so that time and memory are linear in
    the number of samples.

    The model is strictly proper: a control moves no output before the next sample, as
    in all dynamics here. Where it does, as a measured input between two samples may,
    `Record(outputs[:-1], controls[1:], dt=dt)` is the record of such a model. Controls
    that depend on the noise, as those of a feedback do, bias the estimate. The model is
    not forced to be stable; too high an order may give a mode that is not.

    **Arguments:**

    - `record`: a [`delucax.training.sysid.Record`][] or a list of them, uniform in
        time, with any number of outputs and controls.
    - `order`: the number of states, n. `singular_values`, which do not depend on it,
        tell how many are needed.
    - `horizon`: the steps that are predicted, and as many that are looked back on. More
        average over more noise. By default the larger of 10 and twice the order, or
        what the records have samples for.
    - `affine`: whether to estimate an operating point too, about which the model is
        linear, for outputs and controls that are not measured from an equilibrium;
        false by default.
    - `throw`: raise if the controls tell too little (default); if false, look at
        `result`.

    **Returns:** [`delucax.training.sysid.Subspace`][]. Its states are balanced: they
    are in the order of what they contribute.

    **Raises:** `ValueError` if `record` is none, on counts below 1, if `order` exceeds
    `(horizon - 1)` times the outputs, or if there are too few samples for the
    horizon; an error at run time as `throw` says, if the controls are not persistently
    exciting: if they are constant, say, or fewer sines than `(horizon + order) / 2`.

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
        fit.model.A, fit.singular_values
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
    result: Any = rest["result"]
    if throw:
        matrices = result.error_if(matrices, result != RESULTS.successful)
    if isinstance(record, Record):
        rest["x0"] = rest["x0"][0]
    model = LinearDynamics(dt=records[0].dt, **matrices)
    return Subspace(model, singular_values=known.singular_values, **rest)


def _checked_horizon(
    horizon: Any, order: int, p: int, m: int, affine: bool, records: list[Record]
) -> int:
    """A horizon that the order fits, and for which there are samples."""

    rows = lambda h: affine + 2 * h * (m + p)
    columns = lambda h: sum(max(0, len(record) - 2 * h + 1) for record in records)
    # A shifted by a step, the outputs of the horizon must still tell all states.
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
            f"{_WHERE}: record must have {rows(horizon)} stretches of {2 * horizon} "
            f"samples or more for a horizon of {horizon} steps, got "
            f"{columns(horizon)} from {sum(map(len, records))} samples."
        )
    return horizon


@eqx.filter_jit
def _regressed(
    known: Realised, units: Units, groups: list[Record], affine: bool
) -> tuple[dict[str, Array], dict[str, Any]]:
    """B, an operating point and the first states by the errors of the predictor: the
    matrices of the model, and all else, in the units of the records."""
    A, C, gain = known.A, known.C, known.start_gain
    (p, n), m = C.shape, groups[0].controls.shape[2]
    dtype = A.dtype
    predictor = A - gain @ C

    def of(y, u):
        """For each output, what it owes to the first state, B and the offset, and what
        they must explain."""

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
        # Without an offset its columns are left out.
        table = table if affine else table[:, : n + n * m]
        return table, (y - rows[..., -1]).reshape(-1)

    tables = [jax.vmap(of)(*units.of(group)) for group in groups]
    factors = [jax.vmap(_triangle)(*pair) for pair in tables]
    # Each record has a first state of its own; the rest is common to all.
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
    # A model holds finite numbers; the result says that these are none.
    matrices = jax.tree.map(lambda M: jnp.where(finite, M, 0), matrices)
    gains = dict(gain=known.gain / y_size, start_gain=known.start_gain / y_size)
    return matrices, dict(x0=x0, error=error, result=result, **gains)


def _triangle(table: Float[Array, "rows q"], target: Float[Array, " rows"]) -> Array:
    joined = jnp.concatenate([table, target[:, None]], axis=1)
    # As many rows as columns at least.
    lacking = max(0, joined.shape[1] - len(joined))
    return jnp.linalg.qr(jnp.pad(joined, ((0, lacking), (0, 0))), mode="r")


def _solved(table: Array, target: Array) -> Array:
    """The least squares, of the least norm where the table does not tell all."""
    return jnp.linalg.lstsq(table, target)[0]


@eqx.filter_jit
def _starts(model: LinearDynamics, gain: Array, groups: list[Record]) -> Array:
    """The first states for which the predictor errs least."""
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
