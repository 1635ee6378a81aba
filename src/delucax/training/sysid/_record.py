"""Records of measured outputs and controls over time."""

import itertools
from collections.abc import Sequence
from typing import Any, Literal, TYPE_CHECKING

import equinox as eqx
import jax
import jax.numpy as jnp
import lineax as lx
import numpy as np
from jaxtyping import Array, Float

from ..._check import (
    as_number,
    check_bool,
    check_choice,
    check_instance,
    check_step,
    is_concrete,
)
from ..._message import shortened
from ..._module import as_float_array, shown


Hold = Literal["zero", "linear", "cubic"]
_WHERE = "Record"
_HOLDS = {"zero": 0, "linear": 1, "cubic": 3}
# Times are uniform if their steps differ by less than this share.
_UNEVEN = 1e-4
# A gap is a step so many times as long as this quantile of the steps.
_GAP, _USUAL = 5, 0.9


class Record(eqx.Module):
    """The measurements of one experiment: outputs and controls at N times.

    A slice of a record is a record of the selected samples, and `len(record)` is N.

    **Arguments:**

    - `outputs`: shape `(N, p)`, or `(N,)` for one output.
    - `controls`: shape `(N, m)`, or `(N,)` for one control. If `hold` is `"zero"`, the
        controls may have one row less than the outputs, as in a simulation.
    - `dt`: the time between two samples, for uniform samples; or
    - `times`: the times of the samples, shape `(N,)`, increasing. Steps may differ.
    - `allow_gaps`: accept gaps in `times`; false by default. A gap is a step that is
        more than five times as long as the 90% quantile of all steps.
    - `hold`: the control between two samples, `"zero"` by default:
        - `"zero"`: the control of the sample before, as a digital controller holds it;
        - `"linear"`: the straight line between the two samples;
        - `"cubic"`: the natural cubic spline through all samples, for smooth and
            band-limited signals.

    **Raises:** `ValueError` if an array has the wrong shape, a sample is not finite,
    the times do not increase or have a gap, an output never changes, or one of several
    controls never changes. The error message names the row and the column.

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

        ```text
        (150, 180)
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
        allow_gaps: bool = False,
    ):
        check_choice(hold, tuple(_HOLDS), "hold", _WHERE)
        outputs, controls = _table(outputs, "outputs"), _table(controls, "controls")
        if len(outputs) < 2:
            raise ValueError(
                f"{_WHERE}: outputs must have at least 2 samples, got {len(outputs)}."
            )
        if len(controls) == len(outputs) - 1 and hold == "zero":
            # Nothing depends on the last control, because no sample comes after it.
            joined = np if isinstance(controls, np.ndarray) else jnp
            controls = joined.concatenate([controls, controls[-1:]])
        if len(controls) != len(outputs):
            less = " or one row less" if hold == "zero" else ""
            raise ValueError(
                f"{_WHERE}: controls must have as many rows as outputs{less}, got "
                f"shapes {controls.shape} and {outputs.shape}."
            )
        if (dt is None) == (times is None):
            got = "neither" if dt is None else "both"
            raise ValueError(f"{_WHERE}: give either dt or times, got {got}.")
        if times is None:
            check_step(dt, _WHERE)
            dt = as_float_array(dt)
            times, steps = dt * np.arange(len(outputs)), dt * np.ones(len(outputs) - 1)
            self.is_uniform = True
        else:
            check_bool(allow_gaps, "allow_gaps", _WHERE)
            times = _checked_times(times, len(outputs), allow_gaps)
            # Differences are taken before the times are rounded to a lower precision.
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
                f"{_WHERE}: a slice must leave at least 2 of the {len(self)} samples, "
                f"got {shortened(index)}."
            )
        samples = lambda record: (record.outputs, record.controls, record.times)
        cut = eqx.tree_at(samples, self, replace_fn=lambda array: array[start:stop])
        return eqx.tree_at(lambda r: r.steps, cut, self.steps[start : stop - 1])

    @property
    def dt(self) -> Float[Array, ""]:
        """The time between samples; the mean time if the samples are not uniform."""
        # On the host if possible, which compiles nothing.
        mean = np.mean if is_concrete(self.steps) else jnp.mean
        return jnp.asarray(mean(self.steps), self.steps.dtype)

    def split(self, share: float = 0.5) -> tuple["Record", "Record"]:
        """Split the record in two, for estimation and validation.

        **Arguments:** `share`: the fraction of the samples in the first part, 0.5 by
        default.

        **Returns:** two records.

        **Raises:** `ValueError` if `share` is not between 0 and 1, or a part has fewer
        than 2 samples.
        """
        if not 0 < as_number(share, "share", "Record.split") < 1:
            raise ValueError(
                f"Record.split: share must be between 0 and 1, got {share}."
            )
        at = round(float(share) * len(self))
        return self[:at], self[at:]

    def coefficients(self) -> Float[Array, "steps powers m"]:
        """The control between two samples, as the coefficients of a polynomial in the
        share of the step that has passed, lowest power first."""
        u = self.controls
        if self.hold == "zero":
            return u[:-1, None]
        if self.hold == "linear":
            return jnp.stack([u[:-1], jnp.diff(u, axis=0)], axis=1)
        h = self.steps[:, None]
        bend = _second_derivatives(u, h)
        second, third = bend[:-1] / 2, jnp.diff(bend, axis=0) / 6
        # u_k + first s + h^2 second s^2 + h^2 third s^3, with s = (t - t_k) / h.
        first = jnp.diff(u, axis=0) - h**2 * (second + third)
        return jnp.stack([u[:-1], first, h**2 * second, h**2 * third], axis=1)


if TYPE_CHECKING:
    Records = Record | Sequence[Record]
else:
    Records = Any


def records_of(records: Any, where: str) -> list[Record]:
    """One or several records as a list. Raise if they do not fit together."""
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
                    f"{where}: all records must have the same number of {what}, got "
                    f"{size} in record[0] and {other} in record[{index}]."
                )
        if record.hold != first.hold:
            raise ValueError(
                f"{where}: all records must have the same hold, got {first.hold!r} in "
                f"record[0] and {record.hold!r} in record[{index}]."
            )
    return list(listed)


def grouped(records: list[Record]) -> list[Record]:
    """Stack neighbouring records of the same length, so that many records compile to
    the same program as one."""
    alike = lambda record: (len(record), record.is_uniform)
    groups = [list(group) for _, group in itertools.groupby(records, alike)]
    return [jax.tree.map(_stacked, *group) for group in groups]


def _stacked(*arrays: Any) -> Array:
    if not all(map(is_concrete, arrays)):
        return jnp.stack(arrays)
    return jnp.asarray(np.stack(arrays))


def uniform_records(records: Any, where: str) -> list[Record]:
    """As `records_of`, and raise unless all records have the same uniform step."""
    listed = records_of(records, where)
    for index, record in enumerate(listed):
        if not record.is_uniform:
            raise ValueError(
                f"{where}: the samples must be uniform in time, but those of "
                f"record[{index}] are not. Resample them, or fit a model in continuous "
                "time with sysid.physical."
            )
        steps = record.dt, listed[0].dt
        known = all(map(is_concrete, steps))
        if known and not np.allclose(*map(float, steps), rtol=_UNEVEN):
            raise ValueError(
                f"{where}: all records must have the same dt, got "
                f"{float(listed[0].dt):g} in record[0] and {float(record.dt):g} in "
                f"record[{index}]."
            )
    return listed


def _table(value: Any, name: str) -> Any:
    """`value` as an array of real finite columns, or an error."""
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
            f"column {column}, and {np.sum(~finite)} such entries in all. Split the "
            "record where samples are missing."
        )
    still = np.ptp(array, axis=0) == 0
    # A single control may be constant for a whole experiment. A constant output, or one
    # constant control among several, is the wrong column or was not connected.
    if still.any() and (name == "outputs" or not still.all()):
        column = int(np.argmax(still))
        raise ValueError(
            f"{_WHERE}: column {column} of {name} is {array[0, column]:g} in all "
            f"{len(array)} rows. Leave it out."
        )
    return array


def _checked_times(times: Any, count: int, allow_gaps: bool) -> Any:
    array = as_float_array(times)
    if array.shape != (count,):
        raise ValueError(
            f"{_WHERE}: times must have shape ({count},), a time for each row of "
            f"outputs, got {array.shape}."
        )
    if not is_concrete(array):
        return array
    # In the given precision, because float32 rounds the steps away if times are large.
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
    steps = np.diff(array)
    usual = np.quantile(steps, _USUAL)
    if not allow_gaps and steps.max() > _GAP * usual:
        row = int(np.argmax(steps))
        raise ValueError(
            f"{_WHERE}: times has a gap of {steps[row]:g} between rows {row} and "
            f"{row + 1}; nine tenths of the steps are at most {usual:g}. Split the "
            "record there and pass a list of records, or pass allow_gaps=True if the "
            "controls are known in between."
        )
    return array


def _has_one_step(steps: Any) -> bool:
    return bool(np.ptp(steps) <= _UNEVEN * np.mean(steps))


def _second_derivatives(u: Array, h: Array) -> Array:
    """The second derivatives of the natural cubic spline at the samples."""
    if len(u) == 2:
        return jnp.zeros_like(u)
    slopes = jnp.diff(u, axis=0) / h
    right = 6 * jnp.diff(slopes, axis=0)
    h = h[:, 0]
    matrix = lx.TridiagonalLinearOperator(2 * (h[:-1] + h[1:]), h[1:-1], h[1:-1])
    one = lambda column: lx.linear_solve(matrix, column, lx.Tridiagonal()).value
    inner = jax.vmap(one, in_axes=1, out_axes=1)(right)
    return jnp.pad(inner, ((1, 1), (0, 0)))
