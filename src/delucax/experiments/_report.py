"""Pages of results, and of the differences of two results."""

import itertools
import json
import math
import os
from collections import Counter
from typing import Any, NamedTuple

import numpy as np

from .._page import escape, Page
from ._results import Results
from ._statistics import Bootstrap, interquartile_mean, is_number, quantile


# The largest number of panels in a figure, and of cases in a panel.
_PANELS, _CASES = 30, 60


def report(
    results: Results, path: str | os.PathLike, *, title: str = "Results"
) -> None:
    """Write a self-contained HTML page of sortable tables and figures.

    **Arguments:**

    - `results`: from [`delucax.experiments.run`][].
    - `path`: the HTML file to write.
    - `title`: the heading of the page, `"Results"` by default.

    **Raises:** `OSError` if the file cannot be written.

    !!! example

        ```python
        from delucax import experiments

        results = experiments.run(experiments.experiment(lambda: 1.0), progress=False)
        experiments.report(results, "results.html")
        ```
    """
    page_of(results, title).write(path)


def page_of(results: Results, title: str) -> Page:
    """A page with a table of means and a figure for each experiment, the failures, and
    all rows."""
    page = Page(title)
    page.paragraph(_made_with(results), "made")
    for name, part in by_experiment(results).items():
        page.heading(name)
        page.paragraph(_counts(part))
        page.table(*summary(part))
        _add_figures(page, part)
    failed = {row["case"]: row for row in results.failed}
    if failed:
        page.heading("What failed")
    for case, row in failed.items():
        what = escape(f"{case}: {row['error'] or row['status']}")
        page.parts.append(
            f'<details><summary class="bad">{what}</summary>'
            f"<pre>{escape(row['traceback'] or '')}</pre></details>"
        )
    rows = results.flat_rows()
    columns = [name for name in results.all_columns if name != "experiment"]
    page.heading("All rows")
    page.parts.append(f"<details><summary>{len(rows)} rows</summary>")
    page.table(columns, [[row.get(name) for name in columns] for row in rows])
    page.parts.append("</details>")
    return page


def by_experiment(results: Results) -> dict[str, Results]:
    """The results of each experiment, by its name."""
    names = dict.fromkeys(row["experiment"] for row in results.rows)
    return {name: results.where(experiment=name) for name in names}


def summary(results: Results) -> tuple[list[str], list[list]]:
    """The headings and rows of a table of cases: the parameters, and the interquartile
    mean of each result over the seeds, with the quartiles if there are several
    seeds."""
    cases = [[*rows.values()] for rows in _by_case(results).values()]
    firsts = [rows[0] for rows in cases]
    many = any(row["seed"] != results.rows[0]["seed"] for row in results.rows)
    labels = [p for p in results.parameters if any(p in row for row in results.rows)]
    columns: list[tuple[str, list]] = [
        (label, [row.get(label) for row in firsts]) for label in labels or ["case"]
    ]
    if many:
        columns.append(("seeds", [*map(len, cases)]))
    states = [dict.fromkeys(row["status"] for row in rows) for rows in cases]
    columns.append(("status", [*map(", ".join, states)]))
    words = []
    for name in results.metrics:
        values = [_numbers(rows, name) for rows in cases]
        if not any(values):
            if any(isinstance(row.get(name), str) for row in results.rows):
                words.append((name, name))
            continue
        statistics: dict[str, Any] = {name: interquartile_mean}
        if many and any(_varies(rows, name) for rows in cases):
            for k in (25, 75):
                statistics[f"{name} {k}%"] = lambda v, k=k: float(quantile(v, k / 100))
        with np.errstate(invalid="ignore"):
            for heading, of in statistics.items():
                columns.append((heading, [of(v) if v else None for v in values]))
    times = ("compile s", "compile_seconds"), ("run s", "run_seconds")
    for heading, name in (*words, *times):
        columns.append((heading, [row.get(name) for row in firsts]))
    headings, values = zip(*columns, strict=True)
    return list(headings), [list(row) for row in zip(*values, strict=True)]


def _numbers(rows: list[dict[str, Any]], metric: str) -> list[float]:
    """The values of a result that are numbers."""
    return [float(v) for v in (row.get(metric) for row in rows) if is_number(v)]


def _varies(rows: list[dict[str, Any]], metric: str) -> bool:
    """Whether a result differs between the seeds of a case."""
    values = [row[metric] for row in rows if row.get(metric) is not None]
    return any(value != values[0] for value in values)


class Difference(NamedTuple):
    """Differences of two results.

    - `changed`: rows of `DIFFERENCES`.
    - `status`: rows of experiment, case, and the status in both.
    - `same`: the number of cases that agree to the last bit.
    - `only`: the cases, as (experiment, case), that only the first holds, and those
        that only the second holds. A case without a common seed is in both lists.
    """

    changed: list[list]
    status: list[list]
    same: int
    only: tuple[list[tuple[str, str]], list[tuple[str, str]]]

    def page(self, names: tuple[str, str]) -> Page:
        """A page of the differences of results with these names."""
        page = Page(f"{names[1]} against {names[0]}")
        page.paragraph(f"{self.same} cases are the same.")
        page.heading(f"{len(self.changed)} results differ")
        page.table(DIFFERENCES, self.changed)
        if self.status:
            page.heading("Another status")
            page.table(["experiment", "case", *names], self.status)
        for name, cases in zip(names, self.only, strict=True):
            if cases:
                page.heading(f"Only in {name}")
                page.table(["experiment", "case"], cases)
        return page


DIFFERENCES = [
    *("experiment", "case", "result", "first", "second"),
    *("second - first", "low", "high", "seeds"),
]


def diff(first: Results, second: Results) -> Difference:
    """Compare two results.

    For each value that differs, this gives the interquartile means over the common
    seeds, and their difference with a paired 95% interval.
    """
    a, b = _by_case(first), _by_case(second)
    changed, status, same = [], [], 0
    common = dict.fromkeys(k for k in a if a[k].keys() & b.get(k, {}).keys())
    for key in common:
        seeds = [seed for seed in a[key] if seed in b[key]]
        states = [{rows[key][s]["status"] for s in seeds} for rows in (a, b)]
        if states[0] != states[1]:
            status.append([*key, *(", ".join(sorted(s)) for s in states)])
        is_same = states[0] == states[1]
        for metric in dict.fromkeys((*first.metrics, *second.metrics)):
            pairs = [(a[key][s].get(metric), b[key][s].get(metric)) for s in seeds]
            # As text, so that NaN equals itself and 1 is not 1.0.
            if all(json.dumps(x) == json.dumps(y) for x, y in pairs):
                continue
            is_same = False
            kept = [pair for pair in pairs if all(map(is_number, pair))]
            line: list[Any] = [*key, metric, *[None] * 5, len(kept)]
            if kept:
                array = np.array(kept, np.float64)
                with np.errstate(invalid="ignore"):
                    difference = Bootstrap().paired([array[:, ::-1]])
                line[3:8] = *interquartile_mean(array, axis=0).tolist(), *difference
            changed.append(line)
        same += is_same
    first_only, second_only = ([k for k in rows if k not in common] for rows in (a, b))
    return Difference(changed, status, same, (first_only, second_only))


def _by_case(results: Results) -> dict[tuple[str, str], dict[int, dict[str, Any]]]:
    cases: dict[tuple[str, str], dict[int, dict[str, Any]]] = {}
    for row in results.rows:
        cases.setdefault((row["experiment"], row["case"]), {})[row["seed"]] = row
    return cases


def _add_figures(page: Page, results: Results) -> None:
    """Add a figure of each numeric result over the cases, unless Matplotlib is missing.
    If there are several parameters, each value of the first one has a panel."""
    try:
        from matplotlib import rc_context
        from matplotlib.figure import Figure
    except ImportError:
        return
    first = results.rows[0]
    used = [name for name in results.parameters if name in first]
    for metric in results.metrics:
        panels: dict[str, dict[str, list[float]]] = {}
        for row in results.rows:
            value = row.get(metric)
            if not is_number(value):
                continue
            label = row["case"].partition("[")[2][:-1] or row["case"]
            title = str(row[used[0]]) if len(used) > 1 else ""
            label = label.removeprefix(f"{title}-") if title else label
            panels.setdefault(title, {}).setdefault(label, []).append(float(value))
        panels = dict(itertools.islice(panels.items(), _PANELS))
        most = max(map(len, panels.values()), default=0)
        if most < 2:
            continue
        wide = min(3, len(panels))
        high = -(-len(panels) // wide)
        size = (3.4 * wide if wide > 1 else 8, high * (0.9 + 0.24 * min(most, _CASES)))
        with rc_context({"svg.fonttype": "none"}):
            figure = Figure(figsize=size, layout="constrained")
            grid = figure.subplots(high, wide, squeeze=False).ravel()
            for axes, (title, cases) in zip(grid, panels.items(), strict=False):
                _panel(axes, title, cases)
            for axes in grid[len(panels) :]:
                axes.set_axis_off()
            words = f"{metric} (dot: interquartile mean; bar: quartiles)"
            figure.supxlabel(words, fontsize=9)
            page.figure(figure)


def _panel(axes: Any, title: str, cases: dict[str, list[float]]) -> None:
    """Draw the values of each case. A case with values that are not finite says how
    many, because they have no place in the panel."""
    labels, flat = [], []
    for label, values in [*cases.items()][:_CASES]:
        place, finite = -len(labels), [v for v in values if math.isfinite(v)]
        axes.plot(finite, [place] * len(finite), "|", color="0.6")
        with np.errstate(invalid="ignore"):
            low, high = quantile(values, [0.25, 0.75])
            middle = interquartile_mean(values)
        axes.plot([low, high], [place, place], color="C0", lw=3, alpha=0.5)
        axes.plot(middle, place, "o", color="C0", ms=4)
        missing = len(values) - len(finite)
        labels.append(f"{label} ({missing} not finite)" if missing else label)
        flat += finite
    if flat and min(flat) > 0 and max(flat) > 100 * min(flat):
        axes.set_xscale("log")
    else:
        axes.ticklabel_format(axis="x", scilimits=(-3, 4))
    axes.set_yticks(range(0, -len(labels), -1), labels, fontsize=8)
    axes.tick_params(axis="x", labelsize=8)
    axes.set_ylim(0.3 - len(labels), 0.7)
    axes.set_title(title, fontsize=10)
    axes.grid(axis="x", alpha=0.3)


def _made_with(results: Results) -> str:
    rows = results.rows

    def values(name: str) -> list[str]:
        return sorted({str(r[name]) for r in rows if r.get(name) is not None})

    versions = {f"{k} {v}" for row in rows for k, v in row["versions"].items() if v}
    commits = [commit[:10] for commit in values("commit")]
    days = sorted({date[:10] for date in values("date")})
    dirty = " (with changes)" if any(row["dirty"] for row in rows) else ""
    parts = [
        f"Commit {', '.join(commits)}{dirty}" if commits else "No commit",
        ", ".join(values("dtype")),
        ", ".join(values("device")),
        ", ".join(sorted(versions)),
        " to ".join(dict.fromkeys([*days[:1], *days[-1:]])),
    ]
    return f"{'. '.join(part for part in parts if part)}."


def _counts(results: Results) -> str:
    cases = {row["case"]: row["status"] for row in results.rows}
    counts = sorted(Counter(cases.values()).items())
    text = ", ".join(f"{count} {status}" for status, count in counts)
    return f"{len(cases)} cases: {text}."
