"""Records from CSV files and from data frames."""

import csv
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ..._message import shortened
from ._record import Hold, Record


Names = str | Sequence[str]


def read_csv(
    path: Any,
    *,
    outputs: Names,
    controls: Names,
    times: str | None = None,
    dt: Any = None,
    by: str | None = None,
    hold: Hold = "zero",
    allow_gaps: bool = False,
    delimiter: str = ",",
) -> Any:
    """Read a record from a CSV file whose first line names the columns.

    **Arguments:**

    - `path`: the path of the file.
    - `outputs`, `controls`: the name of a column, or a list of names.
    - `times`: the name of the column with the times; or
    - `dt`: the time from one row to the next.
    - `by`: the name of a column that labels the experiments. Neighbouring rows with the
        same label make one record. By default the file is one record.
    - `hold`: the form of the control between two samples, as in
        [`delucax.training.sysid.Record`][]; `"zero"` by default.
    - `allow_gaps`: accept gaps in the times; false by default.
    - `delimiter`: the character between columns, a comma by default.

    **Returns:** a [`delucax.training.sysid.Record`][], or a list of them if `by` is
    given.

    **Raises:** `ValueError` if a column is missing or an entry is not a number. The
    error message names the line and the column.

    !!! example

        ```python
        import delucax as dlx
        from pathlib import Path

        rows = [f"{0.1 * k},{k % 3},{k % 2}" for k in range(9)]
        Path("run.csv").write_text("\\n".join(["t,level,pump", *rows]))
        names = dict(outputs="level", controls="pump", times="t")
        record = dlx.training.sysid.read_csv("run.csv", **names)
        len(record)
        ```

        ```text
        9
        ```
    """
    where = f"sysid.read_csv: {Path(path).name}"
    with open(path, newline="", encoding="utf-8-sig") as file:
        try:
            header, *lines = [row for row in csv.reader(file, delimiter=delimiter)]
        except (ValueError, UnicodeDecodeError, csv.Error) as error:
            raise ValueError(
                f"{where} must be a text file whose first line names the columns."
            ) from error
    names = [name.strip() for name in header]
    wanted = _wanted(outputs, controls, times)
    places = {name: _place(name, names, where) for name in wanted + _listed(by)}
    table: dict[str, list[Any]] = {name: [] for name in places}
    for number, line in enumerate(lines, start=2):
        if not any(entry.strip() for entry in line):
            continue
        for name, place in places.items():
            entry = line[place].strip() if place < len(line) else ""
            table[name].append(
                entry if name == by else _number(entry, name, f"line {number}", where)
            )
    if not all(table.values()):
        raise ValueError(f"{where} must have rows of numbers below its first line.")
    columns = {name: np.asarray(values) for name, values in table.items()}
    return _records(columns, outputs, controls, times, dt, by, hold, allow_gaps)


def from_frame(
    frame: Any,
    *,
    outputs: Names,
    controls: Names,
    times: str | None = None,
    dt: Any = None,
    by: str | None = None,
    hold: Hold = "zero",
    allow_gaps: bool = False,
) -> Any:
    """Make a record from a data frame or a dictionary of columns.

    **Arguments:**

    - `frame`: a data frame of pandas or Polars, or a dictionary of columns. If the
        times are dates, they are converted to seconds since the first row.
    - `outputs`, `controls`, `times`, `dt`, `by`, `hold`, `allow_gaps`: as in
        [`delucax.training.sysid.read_csv`][].

    **Returns:** a [`delucax.training.sysid.Record`][], or a list of them if `by` is
    given.

    **Raises:** `ValueError` if a column is missing or does not hold numbers.

    !!! example

        ```python
        import delucax as dlx
        import pandas as pd

        frame = pd.DataFrame({"level": [0.0, 1.0, 3.0], "pump": [1.0, 2.0, 0.0]})
        columns = dict(outputs="level", controls="pump")
        record = dlx.training.sysid.from_frame(frame, dt=0.1, **columns)
        record.outputs
        ```

        ```text
        Array([[0.],
               [1.],
               [3.]], dtype=float32)
        ```
    """
    where = "sysid.from_frame: frame"
    if not hasattr(frame, "columns") and not isinstance(frame, Mapping):
        raise ValueError(
            f"{where} must be a data frame or a dictionary of columns, got "
            f"{shortened(frame)}."
        )
    names = [str(name) for name in getattr(frame, "columns", frame)]
    columns = {}
    for name in _wanted(outputs, controls, times) + _listed(by):
        _place(name, names, where)
        values = np.asarray(frame[name])
        if values.dtype.kind == "M":
            values = (values - values[0]) / np.timedelta64(1, "s")
        if name != by and values.dtype.kind not in "biuf":
            # A column of objects may still hold numbers alone.
            values = np.array(
                [_number(v, name, f"row {k}", where) for k, v in enumerate(values)]
            )
        columns[name] = values
    return _records(columns, outputs, controls, times, dt, by, hold, allow_gaps)


def _listed(names: Names | None) -> list[str]:
    return [] if names is None else [names] if isinstance(names, str) else list(names)


def _wanted(outputs: Names, controls: Names, times: str | None) -> list[str]:
    return _listed(outputs) + _listed(controls) + _listed(times)


def _place(name: str, names: list[str], where: str) -> int:
    if names.count(name) != 1:
        many = f"one column {name!r}" if name in names else f"a column {name!r}"
        raise ValueError(f"{where} must have {many}, got {shortened(names)}.")
    return names.index(name)


def _number(entry: Any, name: str, row: str, where: str) -> float:
    try:
        return float(entry)
    except (TypeError, ValueError):
        raise ValueError(
            f"{where} must have numbers, got {shortened(entry)} in {row}, column "
            f"{name!r}."
        ) from None


def _records(
    columns: dict[str, np.ndarray],
    outputs: Names,
    controls: Names,
    times: str | None,
    dt: Any,
    by: str | None,
    hold: Hold,
    allow_gaps: bool,
) -> Any:
    y, u = (
        np.stack([np.asarray(columns[name], float) for name in _listed(names)], axis=1)
        for names in (outputs, controls)
    )
    t = None if times is None else np.asarray(columns[times], float)
    make = lambda rows: Record(
        y[rows],
        u[rows],
        dt=dt,
        times=None if t is None else t[rows],
        hold=hold,
        allow_gaps=allow_gaps,
    )
    if by is None:
        return make(slice(None))
    of = columns[by]
    ends = [0, *(np.flatnonzero(of[1:] != of[:-1]) + 1), len(of)]
    return [make(slice(*pair)) for pair in zip(ends[:-1], ends[1:], strict=True)]
