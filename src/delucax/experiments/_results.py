"""The table of results, with filters and export."""

import dataclasses
import json
import os
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from .._check import as_path
from .._extras import extra
from .._files import replaced
from .._page import as_text, FORMS
from ._cases import Case
from ._store import CASE_COLUMNS, FAILED, RUN_COLUMNS, Store


# Columns that differ between two runs of the same case.
TIMES = ("compile_seconds", "run_seconds", "date")


@dataclasses.dataclass(frozen=True)
class Results:
    """The results of experiments, with a row for each case and seed.

    A row is a dictionary with these keys:

    - `experiment`, `case` and `seed`, and the name of each parameter.
    - `status`: `"passed"`, `"failed"`, `"failed as expected"`, `"passed unexpectedly"`,
        or `"skipped"`. Skipped cases are not stored.
    - the name of each result in the dictionary that the function returned, or `value`
        if the function returned a single number.
    - `error` and `traceback`.
    - `compile_seconds` and `run_seconds`: the times to compile and to run the case [s],
        for all its seeds together.
    - `date`, `commit`, `dirty`, `dtype`, `device`, `versions`, `hash`: when, with which
        code and on which device the result was computed.

    **Arguments:**

    - `rows`: the rows, dictionaries.
    - `metrics`: the names of the results that the functions returned.
    - `parameters`: the names of the parameters.

    !!! example

        ```python
        from delucax.experiments import experiment, run

        @experiment.parametrize("x", [1.0, 2.0])
        @experiment.seeds(2)
        def noisy(x, seed):
            return x + 0.1 * seed

        results = run(noisy, progress=False)
        print(results.export("markdown"))
        ```

        ```text
        | x | seed | status | value |
        | ---: | ---: | --- | ---: |
        | 1 | 0 | passed | 1 |
        | 1 | 1 | passed | 1.1 |
        | 2 | 0 | passed | 2 |
        | 2 | 1 | passed | 2.1 |
        ```
    """

    rows: list[dict[str, Any]]
    metrics: tuple[str, ...]
    parameters: tuple[str, ...]

    @classmethod
    def read(cls, path: str | os.PathLike) -> "Results":
        """Read all results of a file.

        **Arguments:**

        - `path`: the file.

        **Raises:** `ValueError` if it is not a results file, is damaged, or has another
        format; `OSError` if it cannot be read.
        """
        path = as_path(path, "path", "Results.read")
        if not path.exists():
            raise FileNotFoundError(f"Results.read: there is no file '{path}'.")
        store = Store(path, "Results.read")
        names = list(dict.fromkeys(name for name, _ in store.cases))
        order = lambda key: (names.index(key[0]), store.cases[key]["order"])
        ordered = (store.cases[key]["seeds"] for key in sorted(store.cases, key=order))
        return cls._from(store, [seeds[s] for seeds in ordered for s in sorted(seeds)])

    @classmethod
    def _of(
        cls, store: Store, asked: Iterable[tuple[Case, tuple[int, ...]]]
    ) -> "Results":
        """The results of the given cases and seeds."""
        records = []
        for case, seeds in asked:
            stored = store.stored(case.key, case.hash)
            if case.mark("skip"):
                skipped = dict.fromkeys(CASE_COLUMNS) | case.described
                skipped |= {"values": {}, "status": "skipped"}
                stored = {seed: {**skipped, "seed": seed} for seed in seeds}
            records += [stored[seed] for seed in seeds]
        return cls._from(store, records)

    @classmethod
    def _from(cls, store: Store, records: list[dict[str, Any]]) -> "Results":
        rows: list[dict[str, Any]] = []
        metrics: dict[str, None] = {}
        parameters: dict[str, None] = {}
        for record in records:
            metrics |= dict.fromkeys(record["values"])
            parameters |= dict.fromkeys(record["parameters"])
            run = store.runs.get(record.get("run", -1), {})
            of = lambda *names, record=record: {name: record[name] for name in names}
            row = of("experiment", "case") | record["parameters"]
            row |= of("seed", "status") | record["values"] | of(*CASE_COLUMNS)
            row |= {name: run.get(name) for name in RUN_COLUMNS}
            rows.append(row | {"versions": run.get("versions", {})})
        return cls(rows, tuple(metrics), tuple(parameters))

    @property
    def failed(self) -> list[dict[str, Any]]:
        """The rows of cases that failed or passed unexpectedly."""
        return [row for row in self.rows if row["status"] in FAILED]

    @property
    def columns(self) -> tuple[str, ...]:
        """The names of the columns, each once."""
        middle = ("seed", "status", *self.metrics)
        last = [name for name in CASE_COLUMNS if name != "traceback"]
        return ("experiment", "case", *self.parameters, *middle, *last, *RUN_COLUMNS)

    @property
    def table(self) -> Any:
        """The rows as a `pandas.DataFrame`, with a column for each version."""
        pd = extra("pandas", "tables")
        return pd.DataFrame(self.flat_rows(), columns=list(self.all_columns))

    def where(self, **values: Any) -> "Results":
        """The rows that have these values.

        **Arguments:**

        - `**values`: the value that each named column must have.

        **Raises:** `ValueError` if a column does not exist.
        """
        self._check_columns(values, "Results.where", ("traceback", "versions"))
        holds = lambda row: all(row.get(name) == v for name, v in values.items())
        return dataclasses.replace(self, rows=[*filter(holds, self.rows)])

    def export(
        self,
        to: str | os.PathLike,
        *,
        columns: Sequence[str] | None = None,
        digits: int = 4,
    ) -> str:
        """Write the rows to a file, or return them as text.

        **Arguments:**

        - `to`: a file that ends in `.csv`, `.parquet`, `.md` or `.tex`; or `"csv"`,
            `"markdown"` or `"latex"`, to get only the text.
        - `columns`: the names of the columns. By default all columns for CSV and
            Parquet. For Markdown and LaTeX, the default columns are the parameters, the
            seed, the status and the results of the function.
        - `digits`: the number of significant digits in Markdown and LaTeX, 4 by
            default.

        **Returns:** the text; empty for Parquet.

        **Raises:** `ValueError` if the file has another ending or a column is unknown;
        `OSError` if the file cannot be written.
        """
        ending = FORMS.get(Path(to).suffix)
        if ending is None and to not in ("csv", "markdown", "latex"):
            raise ValueError(
                "Results.export: to must end in .csv, .parquet, .md or .tex, or be "
                f"'csv', 'markdown' or 'latex', got {str(to)!r}."
            )
        form = ending or str(to)
        if columns is None:
            several = len({row["experiment"] for row in self.rows}) > 1
            short = (*self.parameters, "seed", "status", *self.metrics)
            short = ("experiment", *short) if several else short
            columns = self.all_columns if form in ("csv", "parquet") else short
        self._check_columns(columns, "Results.export")
        body = [[row.get(name) for name in columns] for row in self.flat_rows()]
        if form == "parquet":
            pd, _ = extra("pandas", "experiments"), extra("pyarrow", "experiments")
            kept = {n: _of_one_type([*v]) for n, *v in zip(columns, *body, strict=True)}
            pd.DataFrame(kept).to_parquet(to, index=False)
            return ""
        text = as_text(form, list(columns), body, digits)
        if ending is not None:
            with replaced(Path(to)) as file:
                file.write(text.encode())
        return text

    def _check_columns(
        self, names: Iterable[str], where: str, more: tuple[str, ...] = ()
    ) -> None:
        known = {*self.all_columns, *more}
        for name in names:
            if name not in known:
                raise ValueError(
                    f"{where}: there is no column {name!r}; there are "
                    f"{', '.join(self.columns)}."
                )

    @property
    def all_columns(self) -> tuple[str, ...]:
        """The names of the columns, and then the names of the version columns."""
        versions = [name for row in self.rows for name in row["versions"]]
        return (*self.columns, *dict.fromkeys(versions))

    def flat_rows(self) -> list[dict[str, Any]]:
        """The rows with a column for each version, and arrays as JSON."""
        flat = []
        for row in self.rows:
            values = {name: value for name, value in row.items() if name != "versions"}
            for name in self.metrics:
                if isinstance(values.get(name), list):
                    values[name] = json.dumps(values[name])
            flat.append({**values, **row["versions"]})
        return flat


def _of_one_type(column: list) -> list:
    """A column whose values have one type, which Parquet needs: text if they differ."""
    types = {type(value) for value in column if value is not None}
    if len(types) < 2 or types == {int, float}:
        return column
    return [value if value is None else str(value) for value in column]
