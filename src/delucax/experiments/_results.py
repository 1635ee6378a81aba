"""A table of results, and what to make of it."""

import csv
import dataclasses
import io
import json
import math
import os
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from .._check import as_path
from .._extras import extra
from ._store import Store


_OF_A_CASE = (
    *("error", "traceback", "compile_seconds", "run_seconds"),
    *("device", "hash"),
)
_MADE_WITH = ("date", "commit", "dirty", "dtype")
# Columns that differ between two runs of the same thing.
TIMES = ("compile_seconds", "run_seconds", "date")


@dataclasses.dataclass(frozen=True)
class Results:
    """The results of experiments, a row for each case and seed.

    A row holds `experiment`, `case`, the parameters, `seed`, `status` (`"passed"`,
    `"failed"`, `"failed as expected"`, `"passed unexpectedly"`; `"skipped"`, which is
    not stored), what the function returned (a single number under the name `value`),
    `error`, `traceback`, `compile_seconds` and `run_seconds` (of the case, all its
    seeds together), and what it was made with: `date`, `commit`, `dirty`, `dtype`,
    `device`, `versions`, `hash`.

    **Arguments:**

    - `rows`: dictionaries.
    - `metrics`: the names of what the functions returned.
    - `parameters`: the names of the parameters.

    !!! example

        ```python
        from delucax.experiments import experiment

        @experiment.parametrize("x", [1.0, 2.0])
        @experiment.seeds(2)
        def noisy(x, seed):
            return x + 0.1 * seed

        results = noisy.run(progress=False)
        print(results.export("markdown"))
        ```
    """

    rows: list[dict[str, Any]]
    metrics: tuple[str, ...]
    parameters: tuple[str, ...]

    @classmethod
    def read(cls, path: str | os.PathLike) -> "Results":
        """All that is in a results file.

        **Arguments:**

        - `path`: the file.

        **Raises:** `ValueError` if it is no results file, is damaged, or is of another
        format; `OSError` if it cannot be read.
        """
        path = as_path(path, "path", "Results.read")
        if not path.exists():
            raise FileNotFoundError(f"Results.read: there is no file '{path}'.")
        book = Store(path, "Results.read")
        names = list(dict.fromkeys(name for name, _ in book.cases))
        keys = sorted(book.cases, key=lambda k: (names.index(k[0]), _order(book, k)))
        return cls._from(
            book, [(key, sorted(book.cases[key]["seeds"].items())) for key in keys]
        )

    @classmethod
    def _of(cls, book: Store, asked: Iterable) -> "Results":
        """Those of the cases and seeds asked for."""
        found = []
        for case, seeds in asked:
            key = case.experiment, case.id
            if case.mark("skip"):
                record = dict.fromkeys(_OF_A_CASE) | {"values": {}, "status": "skipped"}
                record |= {"parameters": case.shown, "hash": case.hash}
                found.append((key, [(seed, (record, 0)) for seed in seeds]))
            else:
                stored = book.cases[key]["seeds"]
                found.append((key, [(seed, stored[seed]) for seed in seeds]))
        return cls._from(book, found)

    @classmethod
    def _from(cls, book: Store, asked: list) -> "Results":
        rows: list[dict[str, Any]] = []
        metrics: dict[str, None] = {}
        parameters: dict[str, None] = {}
        for key, seeds in asked:
            for seed, (record, place) in seeds:
                values = {name: v[place] for name, v in record["values"].items()}
                metrics |= dict.fromkeys(values)
                parameters |= dict.fromkeys(record["parameters"])
                run = book.runs.get(record.get("run"), {})
                row = {
                    "experiment": key[0],
                    "case": key[1],
                    **record["parameters"],
                    "seed": seed,
                    "status": record["status"],
                    **values,
                    **{name: record[name] for name in _OF_A_CASE},
                    **{name: run.get(name) for name in _MADE_WITH},
                    "versions": run.get("versions", {}),
                }
                rows.append(row)
        return cls(rows, tuple(metrics), tuple(parameters))

    @property
    def failed(self) -> list[dict[str, Any]]:
        """The rows of cases that failed, or passed though they were not to."""
        bad = ("failed", "passed unexpectedly")
        return [row for row in self.rows if row["status"] in bad]

    @property
    def columns(self) -> tuple[str, ...]:
        """The names of the columns, each once."""
        last = [
            *("error", "compile_seconds", "run_seconds"),
            *("device", "hash", *_MADE_WITH),
        ]
        middle = ("seed", "status", *self.metrics)
        return ("experiment", "case", *self.parameters, *middle, *last)

    @property
    def table(self) -> Any:
        """The rows as a `pandas.DataFrame`, versions spread over columns."""
        pd = extra("pandas", "tables")
        frame = pd.DataFrame(self._flat(), columns=[*self.columns, *self._versions()])
        return frame

    def where(self, **values: Any) -> "Results":
        """The rows that have these values.

        **Arguments:**

        - `**values`: by the name of the column.

        **Raises:** `ValueError` if there is no such column.
        """
        known = {*self.columns, *self._versions(), "traceback", "versions"}
        self._check_columns(values, known, "Results.where")
        rows = [
            row
            for row in self.rows
            if all(row.get(name) == value for name, value in values.items())
        ]
        return dataclasses.replace(self, rows=rows)

    def export(
        self,
        to: str | os.PathLike,
        *,
        columns: Sequence[str] | None = None,
        digits: int = 4,
    ) -> str:
        """Write the rows to a file, or show them as text.

        **Arguments:**

        - `to`: a file that ends in `.csv`, `.parquet`, `.md` or `.tex`; or `"csv"`,
            `"markdown"` or `"latex"`, for the text alone.
        - `columns`: which; by default all in CSV and Parquet, and otherwise the
            parameters, the seed, the status and what was returned.
        - `digits`: significant ones of numbers in Markdown and LaTeX, 4 by default.

        **Returns:** the text; empty for Parquet.

        **Raises:** `ValueError` on another ending or an unknown column; `OSError` if
        the file cannot be written.
        """
        kinds = {".csv": "csv", ".parquet": "parquet", ".md": "markdown"}
        kinds[".tex"] = "latex"
        kind = kinds.get(Path(to).suffix)
        if kind is None and to not in ("csv", "markdown", "latex"):
            raise ValueError(
                "Results.export: to must end in .csv, .parquet, .md or .tex, or be "
                f"'csv', 'markdown' or 'latex', got {str(to)!r}."
            )
        form = kind or str(to)
        if columns is None:
            short = (*self.parameters, "seed", "status", *self.metrics)
            many = {row["experiment"] for row in self.rows}
            short = ("experiment", *short) if len(many) > 1 else short
            full = (*self.columns, *self._versions())
            columns = full if form in ("csv", "parquet") else short
        flat = self._flat()
        known = {*self.columns, *self._versions()}
        self._check_columns(columns, known, "Results.export")
        if form == "parquet":
            pd, _ = extra("pandas", "experiments"), extra("pyarrow", "experiments")
            kept = {
                name: _one_kind([row.get(name) for row in flat]) for name in columns
            }
            pd.DataFrame(kept).to_parquet(to, index=False)
            return ""
        body = [[row.get(name) for name in columns] for row in flat]
        text = _text(form, list(columns), body, digits)
        if kind is not None:
            Path(to).write_text(text, encoding="utf-8")
        return text

    def report(self, path: str | os.PathLike, *, title: str = "Results") -> None:
        """Write a page of sortable tables and figures that needs nothing beside it.

        **Arguments:**

        - `path`: the HTML file to write.
        - `title`: its heading.

        **Raises:** `OSError` if it cannot be written.
        """
        from ._report import page

        Path(path).write_text(page(self, title), encoding="utf-8")

    def _check_columns(self, names: Iterable[str], known: set, where: str) -> None:
        unknown = [name for name in names if name not in known]
        if unknown:
            raise ValueError(
                f"{where}: there is no column {unknown[0]!r}; there are "
                f"{', '.join(self.columns)}."
            )

    def _versions(self) -> tuple[str, ...]:
        return tuple(
            dict.fromkeys(name for row in self.rows for name in row["versions"])
        )

    def _flat(self) -> list[dict[str, Any]]:
        """The rows with versions spread out, and arrays as JSON."""
        found = []
        for row in self.rows:
            flat = {name: value for name, value in row.items() if name != "versions"}
            for name in self.metrics:
                if isinstance(flat.get(name), list):
                    flat[name] = json.dumps(flat[name])
            found.append({**flat, **row["versions"]})
        return found


def _one_kind(column: list) -> list:
    """A column as it is if a file of typed columns can hold it, or as text."""
    kinds = {type(value) for value in column if value is not None}
    if len(kinds) < 2 or kinds == {int, float}:
        return column
    return [value if value is None else str(value) for value in column]


def _order(book: Store, key: tuple[str, str]) -> tuple:
    return book.cases[key]["order"]


def _text(form: str, columns: list[str], body: list[list], digits: int) -> str:
    if form == "csv":
        out = io.StringIO()
        writer = csv.writer(out, lineterminator="\n")
        writer.writerow(columns)
        writer.writerows(body)
        return out.getvalue()
    cells = [[shown(value, digits) for value in row] for row in body]
    right = [
        any(isinstance(row[k], int | float) for row in body)
        for k in range(len(columns))
    ]
    if form == "markdown":
        rule = ["---:" if r else "---" for r in right]
        escaped = [[c.replace("|", "\\|").replace("\n", " ") for c in r] for r in cells]
        lines = [columns, rule, *escaped]
        return "".join("| " + " | ".join(line) + " |\n" for line in lines)
    spec = "".join("r" if r else "l" for r in right)
    head = " & ".join(_latex(name) for name in columns)
    rows = "".join(" & ".join(_latex(c) for c in row) + " \\\\\n" for row in cells)
    return (
        f"\\begin{{tabular}}{{{spec}}}\n\\toprule\n{head} \\\\\n\\midrule\n"
        f"{rows}\\bottomrule\n\\end{{tabular}}\n"
    )


def shown(value: Any, digits: int = 4) -> str:
    """A value as a table shows it."""
    if value is None:
        return ""
    if isinstance(value, bool) or not isinstance(value, float):
        return str(value)
    if not math.isfinite(value):
        return str(value)
    return f"{value:.{digits}g}"


_ESCAPES = str.maketrans(
    {
        "\\": r"\textbackslash{}",
        **{c: "\\" + c for c in "&%$#_{}"},
        "~": r"\textasciitilde{}",
        "^": r"\textasciicircum{}",
        "\n": " ",
    }
)


def _latex(text: str) -> str:
    return text.translate(_ESCAPES)
