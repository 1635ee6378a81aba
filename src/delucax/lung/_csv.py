"""The public data set of a ventilator, as a file of comma-separated values."""

import csv
import os
import warnings
from collections.abc import Sequence
from typing import Any

import jax.numpy as jnp
import jax.random as jr
import numpy as np

from .._check import as_path, check_count, check_key, check_positive
from .._typing import PRNGKey
from ._data import Breaths, explore, LENGTH
from ._tasks import double_compartment


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
    """The inspirations of a file with the columns of the "Ventilator Pressure
    Prediction" data set.

    The columns are `id`, `breath_id`, `R` [cmH2O s/L], `C` [mL/cmH2O], `time_step` [s],
    `u_in` [%], `u_out` (0 or 1) and `pressure` [cmH2O], in any order, and the rows of a
    breath follow each other. An inspiration is what is before `u_out` is first 1. As
    the steps of the file are not even, it is sampled anew every `dt`: the pressure
    along a line, the controls held.

    **Arguments:**

    - `path`: the file.
    - `length`: samples an inspiration, 29 by default.
    - `dt`: the time between samples [s]; the median of the file's by default.
    - `resistances`, `compliances`: the values of `R` and `C` that there may be;
        5, 20, 50 and 10, 20, 50 by default.

    **Returns:** a [`delucax.lung.Breaths`][], with the resistance and compliance of
        each.

    **Raises:** `ValueError` that names the row (the line of the file) and the column
        where a column is missing, a value is not a number, `R`, `C` or `u_out` is none
        of those there may be or changes within a breath, time does not go on, or a
        breath is too short; `OSError` if the file cannot be read.

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
    for name, allowed in (
        ("R", resistances),
        ("C", compliances),
        ("u_out", (0.0, 1.0)),
    ):
        bad = ~np.isin(table[name], np.asarray(allowed, float))
        if bad.any():
            row = int(np.argmax(bad))
            known = ", ".join(f"{value:g}" for value in allowed)
            raise ValueError(
                f"{_WHERE}: '{path}' row {row + 2}, column {name}: must be one of "
                f"{known}, got {table[name][row]:g}."
            )
    number, time = table["breath_id"], table["time_step"]
    starts = np.flatnonzero(np.diff(number, prepend=np.nan) != 0)
    ends = np.append(starts[1:], len(number))
    again = _repeated(number[starts])
    if again is not None:
        row = int(starts[again])
        raise ValueError(
            f"{_WHERE}: '{path}' row {row + 2}, column breath_id: the rows of a breath "
            f"must follow each other, but breath {number[row]:g} was before."
        )
    inner = np.ones(len(number), bool)
    inner[starts] = False
    back = inner & (np.diff(time, prepend=0.0) <= 0)
    if back.any():
        row = int(np.argmax(back))
        raise ValueError(
            f"{_WHERE}: '{path}' row {row + 2}, column time_step: must increase within "
            f"a breath, got {time[row]:g} after {time[row - 1]:g}."
        )
    for name in ("R", "C"):
        changed = inner & (np.diff(table[name], prepend=table[name][0]) != 0)
        if changed.any():
            row = int(np.argmax(changed))
            raise ValueError(
                f"{_WHERE}: '{path}' row {row + 2}, column {name}: must be the same "
                f"for all of breath {number[row]:g}, got {table[name][row]:g} after "
                f"{table[name][row - 1]:g}."
            )
    if dt is None:
        dt = float(np.median(np.diff(time)[inner[1:]]))
    kept = {name: [] for name in ("u_in", "pressure", "R", "C")}
    grid = dt * np.arange(length)
    for start, end in zip(starts, ends, strict=True):
        open_at = np.flatnonzero(table["u_out"][start:end] > 0)
        stop = start + (int(open_at[0]) if len(open_at) else end - start)
        t = time[start:stop] - time[start]
        # The last sample may be up to half a step after the last row.
        if stop == start or t[-1] + 0.5 * dt < grid[-1]:
            raise ValueError(
                f"{_WHERE}: '{path}' row {start + 2}, column u_out: breath "
                f"{number[start]:g} has an inspiration of {stop - start} rows and "
                f"{t[-1] if len(t) else 0:.3g} s, too short for length = {length} "
                f"samples of {dt:.3g} s."
            )
        rows = slice(start, stop)
        held = np.clip(np.searchsorted(t, grid + 1e-9) - 1, 0, None)
        kept["u_in"].append(table["u_in"][rows][held])
        kept["pressure"].append(np.interp(grid, t, table["pressure"][rows]))
        kept["R"].append(table["R"][start])
        kept["C"].append(table["C"][start])
    columns = {name: jnp.asarray(np.array(values)) for name, values in kept.items()}
    return Breaths(
        columns["u_in"],
        jnp.zeros_like(columns["u_in"]),
        columns["pressure"],
        dt,
        columns["R"],
        columns["C"],
    )


def _repeated(numbers: np.ndarray) -> int | None:
    """The first place at which a number is there for the second time."""
    _, first = np.unique(numbers, return_index=True)
    rest = np.setdiff1d(np.arange(len(numbers)), first)
    return int(rest[0]) if len(rest) else None


def _table(path: Any) -> dict[str, np.ndarray]:
    """The columns that are used, as numbers."""
    with open(path, newline="") as file:
        header = [name.strip() for name in next(csv.reader(file), [])]
        missing = [name for name in COLUMNS if name not in header]
        if missing:
            raise ValueError(
                f"{_WHERE}: '{path}' row 1: column {', '.join(missing)} is missing; "
                f"there must be {', '.join(COLUMNS)}, got "
                f"{', '.join(header) or 'nothing'}."
            )
        place = {name: header.index(name) for name in COLUMNS[1:]}
        columns = list(place.values())
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # that there are no rows
                rows = np.loadtxt(file, delimiter=",", usecols=columns, ndmin=2)
        except ValueError:
            rows = None
    if rows is not None and rows.size:
        bad = ~np.isfinite(rows)
        if not bad.any():
            return dict(zip(place, rows.T, strict=True))
    raise _first_bad_value(path, place)


def _first_bad_value(path: Any, place: dict[str, int]) -> ValueError:
    with open(path, newline="") as file:
        rows = csv.reader(file)
        next(rows)
        for line, row in enumerate(rows, start=2):
            for name, i in place.items():
                text = row[i] if i < len(row) else ""
                try:
                    fine = np.isfinite(float(text))
                except ValueError:
                    fine = False
                if not fine:
                    return ValueError(
                        f"{_WHERE}: '{path}' row {line}, column {name}: must be a "
                        f"finite number, got {text!r}."
                    )
    return ValueError(f"{_WHERE}: '{path}' must have rows after its header.")


def write_breaths(path: str | os.PathLike, breaths: Breaths) -> None:
    """Write breaths with the columns that [`delucax.lung.read_breaths`][] reads.

    **Arguments:**

    - `path`: the file to write.
    - `breaths`: a [`delucax.lung.Breaths`][] with resistance and compliance.

    **Raises:** `ValueError` without those; `OSError` if the file cannot be written.

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
    whole = lambda values: np.repeat(np.asarray(values), length)  # noqa: E731
    columns = [
        np.arange(1, count * length + 1),
        whole(np.arange(1, count + 1)),
        whole(breaths.resistance),
        whole(breaths.compliance),
        np.tile(float(breaths.dt) * np.arange(length), count),
        *(np.ravel(a) for a in (breaths.u_in, breaths.u_out, breaths.pressure)),
    ]
    formats = ["%d", "%d", "%g", "%g", "%.6f", "%.6f", "%d", "%.6f"]
    header = ",".join(COLUMNS)
    np.savetxt(
        path,
        np.stack(columns, 1),
        fmt=formats,
        delimiter=",",
        header=header,
        comments="",
    )


def write_example(
    path: str | os.PathLike,
    breaths: int = 20,
    *,
    key: PRNGKey,
    length: int = 80,
    scale: Any = 0.5,
) -> None:
    """Write a file of that kind, made by exploring the nine lungs of the task
    `lung/double_compartment`.

    **Arguments:**

    - `path`: the file to write.
    - `breaths`: of each lung, 20 by default.
    - `key`: a random key.
    - `length`: rows a breath, 80 by default, with the expiratory phase.
    - `scale`: of the PID gains that are drawn, 0.5 by default.

    **Raises:** `OSError` if the file cannot be written.

    !!! example

        ```python
        import tempfile
        from pathlib import Path
        import jax
        from delucax import lung

        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "train.csv"
            lung.write_example(path, 1, key=jax.random.key(0), length=2)
        ```
    """
    check_key(key, "write_example")
    lungs = [(R, C) for R in RESISTANCES for C in COMPLIANCES]
    parts = [
        explore(
            double_compartment(R, C),
            breaths,
            key=own,
            length=length,
            scale=scale,
            resistance=R,
            compliance=C,
        )
        for (R, C), own in zip(lungs, jr.split(key, len(lungs)), strict=True)
    ]
    joined = [
        jnp.concatenate([getattr(part, name) for part in parts])
        for name in ("u_in", "u_out", "pressure")
    ]
    known = {
        name: jnp.concatenate([getattr(part, name) for part in parts])
        for name in ("resistance", "compliance")
    }
    write_breaths(path, Breaths(*joined, dt=parts[0].dt, **known))
