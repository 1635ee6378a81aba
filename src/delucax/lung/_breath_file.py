"""Reads and writes breaths as comma-separated values, like a public data set."""

import array
import csv
import math
import os
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np

from .._check import as_path, check_count, check_positive
from ._breaths import Breaths
from ._waveform import LENGTH


COLUMNS = ("id", "breath_id", "R", "C", "time_step", "u_in", "u_out", "pressure")
RESISTANCES = (5.0, 20.0, 50.0)
COMPLIANCES = (10.0, 20.0, 50.0)
_WHERE = "read_breaths"


def read_breaths(
    path: str | os.PathLike,
    *,
    length: int = LENGTH,
    dt: Any = None,
    resistances: Sequence[float] = RESISTANCES,
    compliances: Sequence[float] = COMPLIANCES,
) -> Breaths:
    """Read recorded breaths from a file, and keep only their inspirations.

    The file has the columns of the "Ventilator Pressure Prediction" data set: `id`,
    `breath_id`, `R` [cmH2O s/L], `C` [mL/cmH2O], `time_step` [s], `u_in` (0 to 100 %),
    `u_out` (0 or 1) and `pressure` [cmH2O], in any order. All rows of a breath must
    follow each other in the file. The inspiration of a breath ends at the first row
    with `u_out` equal to 1. The time steps in the file are uneven, so each inspiration
    is resampled with the constant step `dt`: the pressure is interpolated linearly, and
    each control is held until the next row.

    Numbers may be quoted and blank lines are ignored. Comments are not allowed.

    **Arguments:**

    - `path`: the file.
    - `length`: the number of samples per inspiration, 29 by default.
    - `dt`: the time between samples [s], by default the median of the time steps in the
        file.
    - `resistances`, `compliances`: the values that `R` and `C` may have; 5, 20, 50 and
        10, 20, 50 by default.

    **Returns:** a [`delucax.lung.Breaths`][] with the resistance and compliance of each
        breath.

    **Raises:** `ValueError` if a column is missing, a value is not a finite number,
        `u_in` is out of its bounds, `R`, `C` or `u_out` has a value that is not
        allowed, `R` or `C` changes within a breath, time does not increase, or a breath
        is too short. The message of the error names the column and the row. Rows are
        counted like the lines in an editor: the header is row 1, and blank lines count.
        `OSError` if the file cannot be read.

    Source: Google Brain, 2021 (the data set); Suo, Agarwal, Xia, Chen, Ghai, Yu, Gradu,
    Singh, Zhang, Minasyan, LaChance, Zajdel, Schottdorf, Cohen and Hazan, 2021.

    !!! example

        ```python
        import tempfile
        from pathlib import Path
        import jax.numpy as jnp
        from delucax import lung

        zeros = jnp.zeros((2, 29))
        lungs = dict(resistance=jnp.full(2, 5.0), compliance=jnp.full(2, 10.0))
        breaths = lung.Breaths(zeros, zeros, zeros + 5, dt=0.03, **lungs)
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "train.csv"
            lung.write_breaths(path, breaths)
            again = lung.read_breaths(path)
        ```
    """
    path = as_path(path, "path", _WHERE)
    length = check_count(length, "length", _WHERE)
    if dt is not None:
        check_positive(dt, "dt", _WHERE)
    table = _table(path)
    allowed = dict(R=resistances, C=compliances, u_out=(0.0, 1.0))
    starts, ends = _breaths(path, table, allowed)
    time = table["time_step"]
    if dt is None:
        steps = np.diff(time)
        steps[starts[1:] - 1] = np.nan  # between one breath and the next
        dt = float(np.nanmedian(steps))
    samples = []
    grid = dt * np.arange(length)
    for start, end in zip(starts, ends, strict=True):
        open_at = np.flatnonzero(table["u_out"][start:end] > 0)
        stop = start + int(np.append(open_at, end - start)[0])
        t = time[start:stop] - time[start]
        # The last sample may be up to half a step after the last row.
        if stop == start or t[-1] + 0.5 * dt < grid[-1]:
            words = (
                f"breath {table['breath_id'][start]:g} has an inspiration of "
                f"{stop - start} rows and {t[-1] if len(t) else 0:.3g} s, too short "
                f"for length = {length} samples of {dt:.3g} s"
            )
            raise _wrong(path, table["line"][start], "u_out", words)
        # The times of a file are rounded.
        held = np.clip(np.searchsorted(t, grid + 0.01 * dt) - 1, 0, None)
        pressure = np.interp(grid, t, table["pressure"][start:stop])
        samples.append((table["u_in"][start:stop][held], pressure))
    u_in, pressure = jnp.asarray(np.array(samples)).swapaxes(0, 1)
    lungs = jnp.asarray(table["R"][starts]), jnp.asarray(table["C"][starts])
    return Breaths(u_in, jnp.zeros_like(u_in), pressure, dt, *lungs)


def _wrong(path: Path, line: Any, column: str, words: str) -> ValueError:
    return ValueError(f"{_WHERE}: '{path}' row {line}, column {column}: {words}.")


def _breaths(
    path: Path, table: dict[str, np.ndarray], allowed: dict[str, Sequence[float]]
) -> tuple[np.ndarray, np.ndarray]:
    """Check the rows. Returns the first row of each breath and the row after its last.

    `allowed` holds the values that a column may have.
    """
    number, u_in = table["breath_id"], table["u_in"]
    begins = np.diff(number, prepend=np.nan) != 0
    starts = np.flatnonzero(begins)
    ends = np.append(starts[1:], len(number))
    first = starts[np.unique(number[starts], return_index=True)[1]]
    again = begins & ~np.isin(np.arange(len(number)), first)
    single = begins & np.append(begins[1:], True)
    rise = {n: np.diff(table[n], prepend=0.0) for n in ("time_step", "R", "C")}
    apart = "the rows of a breath must follow each other, but breath {now:g} repeats"
    short = "a breath must have at least 2 rows, got 1 of breath {now:g}"
    later = "must increase within a breath, got {now:g} after {last:g}"
    same = "must be the same for all of breath {breath:g}, got {now:g} after {last:g}"
    checks = []
    for name, values in allowed.items():
        one_of = f"must be one of {', '.join(f'{v:g}' for v in values)}, got {{now:g}}"
        checks.append((name, ~np.isin(table[name], np.asarray(values, float)), one_of))
    checks += [
        ("u_in", (u_in < 0) | (u_in > 100), "must be between 0 and 100, got {now:g}"),
        ("breath_id", again, apart),
        ("breath_id", single, short),
        ("time_step", ~begins & (rise["time_step"] <= 0), later),
        ("R", ~begins & (rise["R"] != 0), same),
        ("C", ~begins & (rise["C"] != 0), same),
    ]
    for name, bad, words in checks:
        if bad.any():
            k = int(np.argmax(bad))
            now, last = table[name][k], table[name][k - 1]
            words = words.format(now=now, last=last, breath=number[k])
            raise _wrong(path, table["line"][k], name, words)
    return starts, ends


def _table(path: Path) -> dict[str, np.ndarray]:
    """The columns by name, as numbers, and the `line` of each row in the file."""
    # Bytes that are not text are rejected later, as values that are not numbers.
    with open(path, newline="", encoding="utf-8-sig", errors="replace") as file:
        reader = csv.reader(file)
        header = [name.strip() for name in next(reader, [])]
        missing = [name for name in COLUMNS if name not in header]
        twice = [name for name in COLUMNS if header.count(name) > 1]
        if twice:
            raise ValueError(
                f"{_WHERE}: '{path}' must have each column once, but repeats "
                f"{', '.join(twice)}."
            )
        if missing:
            raise ValueError(
                f"{_WHERE}: '{path}' row 1: column {', '.join(missing)} is missing; "
                f"there must be {', '.join(COLUMNS)}, got "
                f"{', '.join(header)[:200] or 'nothing'}."
            )
        place = {name: header.index(name) for name in COLUMNS}
        numbers, lines, last = array.array("d"), array.array("q"), reader.line_num
        for row in reader:
            if row:
                lines.append(last + 1)
                numbers.extend(_numbers(path, last + 1, row, place))
            last = reader.line_num
    if not lines:
        raise ValueError(f"{_WHERE}: '{path}' must have rows after its header.")
    columns = np.array(numbers).reshape(-1, len(place)).T
    return dict(zip(place, columns, strict=True), line=np.array(lines))


def _numbers(
    path: Path, line: int, row: list[str], place: dict[str, int]
) -> Iterator[float]:
    """The numbers of a row, in the order of the columns."""
    for name, j in place.items():
        text = row[j] if j < len(row) else ""
        try:
            # Python reads 1_000 as a number, but other readers of the file do not.
            number = np.nan if "_" in text else float(text)
        except ValueError:
            number = np.nan
        if not math.isfinite(number):
            got = f"must be a finite number, got {text!r}"
            raise _wrong(path, line, name, got)
        yield number


def write_breaths(path: str | os.PathLike, breaths: Breaths) -> None:
    """Write breaths to a file that [`delucax.lung.read_breaths`][] can read.

    **Arguments:**

    - `path`: the file to write.
    - `breaths`: a [`delucax.lung.Breaths`][] with resistance and compliance.

    **Raises:** `ValueError` if the resistance or compliance is missing; `OSError` if
    the file cannot be written.

    !!! example

        ```python
        import tempfile
        from pathlib import Path
        import jax.numpy as jnp
        from delucax import lung

        zeros = jnp.zeros((2, 29))
        lungs = dict(resistance=jnp.full(2, 5.0), compliance=jnp.full(2, 10.0))
        breaths = lung.Breaths(zeros, zeros, zeros + 5, dt=0.03, **lungs)
        with tempfile.TemporaryDirectory() as folder:
            lung.write_breaths(Path(folder) / "breaths.csv", breaths)
        ```
    """
    path = as_path(path, "path", "write_breaths")
    if breaths.resistance is None or breaths.compliance is None:
        raise ValueError(
            "write_breaths: breaths must have resistance and compliance, got None."
        )
    count, length = breaths.pressure.shape
    whole = lambda values: np.repeat(np.asarray(values), length)
    of_each = np.arange(1, count + 1), breaths.resistance, breaths.compliance
    columns = [
        np.arange(1, count * length + 1),
        *map(whole, of_each),
        np.tile(float(breaths.dt) * np.arange(length), count),
        *(np.ravel(a) for a in (breaths.u_in, breaths.u_out, breaths.pressure)),
    ]
    form = "%d,%d,%g,%g,%.6f,%.6f,%d,%.6f"
    header = ",".join(COLUMNS)
    np.savetxt(path, np.stack(columns, 1), form, header=header, comments="")
