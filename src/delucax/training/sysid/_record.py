"""Measured data: outputs and controls over time, of one experiment or several."""

import itertools
from collections.abc import Sequence
from typing import Any, Literal, TYPE_CHECKING

import equinox as eqx
import jax
import jax.numpy as jnp
import lineax as lx
import numpy as np
from jaxtyping import Array, Float

from ..._check import check_choice, check_instance, check_step, is_concrete
from ..._message import shortened
from ..._module import as_float_array, shown


Hold = Literal["zero", "linear", "cubic"]
_WHERE = "Record"
_HOLDS = {"zero": 0, "linear": 1, "cubic": 3}
# Times whose steps differ by less than this share are those of one step.
_UNEVEN = 1e-4


class Record(eqx.Module):
    """What was measured in one experiment: outputs and controls at N times.

    Between two samples the control is what `hold` says: the one of the first of them
    (`"zero"`, as a digital controller holds it), the straight line between both
    (`"linear"`), or the natural cubic spline through all (`"cubic"`, for smooth and
    band-limited signals). A slice is a record of these samples, and `len` is N.

    **Arguments:**

    - `outputs`: shape `(N, p)`, or `(N,)` for one output.
    - `controls`: shape `(N, m)` or `(N,)`; or one row less, as a simulation gives
        them, if the hold is zero.
    - `dt`: the time from one sample to the next; or
    - `times`: of the samples, shape `(N,)`, increasing, in any steps.
    - `hold`: `"zero"` by default.

    **Raises:** `ValueError` on arrays of the wrong shape, on samples that are not
    finite, on times that do not increase, and on a column that never changes among
    several of its kind; each with its row and column.

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp

        t = 0.05 * jnp.arange(200)
        Record = dlx.training.sysid.Record
        record = Record(jnp.sin(t), jnp.cos(t), dt=0.05, hold="linear")
        estimation, validation = record.split(0.75)
        len(estimation), len(record[20:])
        ```
    """

    outputs: Float[Array, "N p"]
    controls: Float[Array, "N m"]
    times: Float[Array, " N"]
    steps: Float[Array, " steps"]
    hold: Hold = eqx.field(static=True)
    is_uniform: bool = eqx.field(static=True)

    __repr__ = shown

    def __init__(
        self,
        outputs: Any,
        controls: Any,
        *,
        dt: Any = None,
        times: Any = None,
        hold: Hold = "zero",
    ):
        check_choice(hold, tuple(_HOLDS), "hold", _WHERE)
        outputs, controls = _table(outputs, "outputs"), _table(controls, "controls")
        if len(outputs) < 2:
            raise ValueError(
                f"{_WHERE}: outputs must have 2 samples or more, got {len(outputs)}."
            )
        if len(controls) == len(outputs) - 1 and hold == "zero":
            # No sample comes after the last, so that nothing depends on its control.
            joined = np if isinstance(controls, np.ndarray) else jnp
            controls = joined.concatenate([controls, controls[-1:]])
        if len(controls) != len(outputs):
            less = " or one row less" if hold == "zero" else ""
            raise ValueError(
                f"{_WHERE}: controls must have as many rows as outputs{less}, got "
                f"shapes {controls.shape} and {outputs.shape}."
            )
        if (dt is None) == (times is None):
            raise ValueError(f"{_WHERE}: give one of dt and times.")
        if times is None:
            check_step(dt, _WHERE)
            dt = as_float_array(dt)
            times, steps = dt * np.arange(len(outputs)), dt * np.ones(len(outputs) - 1)
            self.is_uniform = True
        else:
            times = _checked_times(times, len(outputs))
            # Before they are rounded to a lower precision.
            steps = times[1:] - times[:-1]
            self.is_uniform = is_concrete(times) and _has_one_step(steps)
        dtype = jnp.result_type(outputs, controls)
        self.outputs, self.controls, self.times, self.steps = (
            jnp.asarray(array, dtype) for array in (outputs, controls, times, steps)
        )
        self.hold = hold

    def __len__(self) -> int:
        return self.outputs.shape[0]

    def __getitem__(self, index: slice) -> "Record":
        if not isinstance(index, slice) or index.step not in (None, 1):
            raise ValueError(
                f"{_WHERE}: the index must be a slice of neighbouring samples, such as "
                f"[100:], got {shortened(index)}."
            )
        start, stop, _ = index.indices(len(self))
        if stop - start < 2:
            raise ValueError(
                f"{_WHERE}: a slice must leave 2 samples or more of {len(self)}, got "
                f"{shortened(index)}."
            )
        samples = lambda record: (record.outputs, record.controls, record.times)
        cut = eqx.tree_at(samples, self, replace_fn=lambda array: array[start:stop])
        return eqx.tree_at(lambda r: r.steps, cut, self.steps[start : stop - 1])

    @property
    def dt(self) -> Float[Array, ""]:
        """The time between samples; the mean where they are not uniform."""
        # On the host where it can be, which compiles nothing.
        mean = np.mean if is_concrete(self.steps) else jnp.mean
        return jnp.asarray(mean(self.steps), self.steps.dtype)

    def split(self, share: float = 0.5) -> tuple["Record", "Record"]:
        """The record in two, for estimation and validation.

        **Arguments:** `share`: of the samples that are in the first, 0.5 by default.

        **Returns:** two records.

        **Raises:** `ValueError` if one has fewer than 2 samples.
        """
        at = round(float(share) * len(self))
        return self[:at], self[at:]

    def coefficients(self) -> Float[Array, "steps powers m"]:
        """The control between two samples, as a polynomial of the share of the step
        that is over; lowest power first."""
        u = self.controls
        if self.hold == "zero":
            return u[:-1, None]
        if self.hold == "linear":
            return jnp.stack([u[:-1], jnp.diff(u, axis=0)], axis=1)
        h = self.steps[:, None]
        bend = _second_derivatives(u, h)
        second, third = bend[:-1] / 2, jnp.diff(bend, axis=0) / 6
        # Of s = (t - t_k) / h: u_k + h b s + h^2 c s^2 + h^2 d s^3.
        first = jnp.diff(u, axis=0) - h**2 * (second + third)
        return jnp.stack([u[:-1], first, h**2 * second, h**2 * third], axis=1)


if TYPE_CHECKING:
    Records = Record | Sequence[Record]
else:
    Records = Any


def records_of(records: Any, where: str) -> list[Record]:
    """One record or several as a list; raises if they do not fit together."""
    listed = [records] if isinstance(records, Record) else records
    if not isinstance(listed, Sequence) or not listed:
        raise ValueError(
            f"{where}: record must be a delucax.training.sysid.Record or a list of "
            f"them, got {shortened(records)}."
        )
    first = listed[0]
    for index, record in enumerate(listed):
        check_instance(record, Record, f"record[{index}]", where)
        for what in ("outputs", "controls"):
            size, other = (getattr(r, what).shape[1] for r in (first, record))
            if size != other:
                raise ValueError(
                    f"{where}: all records must have the same {what}, got {size} and, "
                    f"in record[{index}], {other} columns."
                )
        if record.hold != first.hold:
            raise ValueError(
                f"{where}: all records must have one hold, got {first.hold!r} and "
                f"{record.hold!r}."
            )
    return list(listed)


def grouped(records: list[Record]) -> list[Record]:
    """Neighbours of one length stacked, so that many records make no larger program
    than one."""
    alike = lambda record: (len(record), record.is_uniform)
    groups = [list(group) for _, group in itertools.groupby(records, alike)]
    return [jax.tree.map(_stacked, *group) for group in groups]


def _stacked(*arrays: Any) -> Array:
    if not all(map(is_concrete, arrays)):
        return jnp.stack(arrays)
    return jnp.asarray(np.stack(arrays))


def uniform_records(records: Any, where: str) -> list[Record]:
    """As `records_of`, of records that all have one and the same step."""
    listed = records_of(records, where)
    for index, record in enumerate(listed):
        if not record.is_uniform:
            raise ValueError(
                f"{where}: the samples must be uniform in time, those of "
                f"record[{index}] are not: fit a model in continuous time to them, or "
                "resample them."
            )
        steps = record.dt, listed[0].dt
        known = all(map(is_concrete, steps))
        if known and not np.allclose(*map(float, steps), rtol=_UNEVEN):
            raise ValueError(
                f"{where}: all records must have one dt, got {float(listed[0].dt):g} "
                f"and, in record[{index}], {float(record.dt):g}."
            )
    return listed


def _table(value: Any, name: str) -> Any:
    """Real finite columns."""
    array = value if isinstance(value, np.ndarray) else as_float_array(value)
    rule = f"{_WHERE}: {name} must be real numbers of shape (samples, size), got "
    if not eqx.is_array_like(array) or isinstance(array, float):
        raise ValueError(f"{rule}{shortened(value)}.")
    array = array.astype(float) if array.dtype.kind in "iub" else array
    if array.ndim == 1:
        array = array[:, None]
    is_real = jnp.issubdtype(array.dtype, jnp.floating)
    if array.ndim != 2 or not is_real or not array.shape[1]:
        raise ValueError(f"{rule}shape {array.shape} of {array.dtype}.")
    if not is_concrete(array):
        return array
    array = np.asarray(array)
    finite = np.isfinite(array)
    if not finite.all():
        row, column = np.argwhere(~finite)[0]
        raise ValueError(
            f"{_WHERE}: {name} must be finite, got {array[row, column]} in row {row}, "
            f"column {column}; {np.sum(~finite)} such entries in all. Split the record "
            "where samples are missing."
        )
    still = np.ptp(array, axis=0) == 0
    # A single control may be held for a whole experiment; a column among several that
    # never moves is a wrong one, or a channel that was not connected.
    if still.any() and not still.all():
        column = int(np.argmax(still))
        raise ValueError(
            f"{_WHERE}: column {column} of {name} is {array[0, column]:g} in all "
            f"{len(array)} rows; leave it out."
        )
    return array


def _checked_times(times: Any, count: int) -> Any:
    array = as_float_array(times)
    if array.shape != (count,):
        raise ValueError(
            f"{_WHERE}: times must have shape ({count},), a time for each row of "
            f"outputs, got {array.shape}."
        )
    if not is_concrete(array):
        return array
    # In the precision that was given: far from zero float32 rounds steps away.
    array = np.asarray(times, float)
    finite = np.isfinite(array)
    if not finite.all():
        row = int(np.argmin(finite))
        raise ValueError(
            f"{_WHERE}: times must be finite, got {array[row]} in row {row}."
        )
    increases = np.diff(array) > 0
    if not increases.all():
        row = int(np.argmin(increases)) + 1
        what = "repeats" if array[row] == array[row - 1] else "is before"
        raise ValueError(
            f"{_WHERE}: times must increase, but {array[row]:g} in row {row} {what} "
            f"{array[row - 1]:g} in row {row - 1}."
        )
    return array


def _has_one_step(steps: Any) -> bool:
    return bool(np.ptp(steps) <= _UNEVEN * np.mean(steps))


def _second_derivatives(u: Array, h: Array) -> Array:
    """Of the natural cubic spline: a tridiagonal system, zero at both ends."""
    if len(u) == 2:
        return jnp.zeros_like(u)
    slopes = jnp.diff(u, axis=0) / h
    right = 6 * jnp.diff(slopes, axis=0)
    h = h[:, 0]
    matrix = lx.TridiagonalLinearOperator(2 * (h[:-1] + h[1:]), h[1:-1], h[1:-1])
    one = lambda column: lx.linear_solve(matrix, column, lx.Tridiagonal()).value
    inner = jax.vmap(one, in_axes=1, out_axes=1)(right)
    return jnp.pad(inner, ((1, 1), (0, 0)))
