"""Results as a page, and two of them side by side."""

import html
import io
import json
import math
from collections import Counter
from typing import Any

import numpy as np

from ._results import Results, shown
from ._statistics import Bootstrap, interquartile_mean


_STYLE = """
:root { color-scheme: light dark; --line: #8884; --faint: #888; --bad: #c62828; }
@media (prefers-color-scheme: dark) { :root { --bad: #ef7f7f; } }
body { font: 15px/1.5 system-ui, sans-serif; margin: 0 auto; max-width: 76rem;
       padding: 1rem; }
h1 { font-size: 1.6rem; } h2 { font-size: 1.25rem; margin-top: 2.2rem; }
p.made, caption { color: var(--faint); }
div.wide { overflow-x: auto; }
table { border-collapse: collapse; font-variant-numeric: tabular-nums; }
th, td { border-bottom: 1px solid var(--line); padding: .25rem .7rem;
         text-align: left; white-space: nowrap; }
td.n, th.n { text-align: right; }
th button { all: unset; cursor: pointer; font-weight: 600; }
th button:focus-visible { outline: 2px solid currentColor; }
th[aria-sort=ascending] button::after { content: " \\25B2"; }
th[aria-sort=descending] button::after { content: " \\25BC"; }
.bad { color: var(--bad); }
figure { margin: 1rem 0; background: #fff; display: inline-block; max-width: 100%; }
figure svg, figure img { max-width: 100%; height: auto; display: block; }
pre { overflow-x: auto; font-size: 12px; }
"""

_SCRIPT = """
for (const table of document.querySelectorAll('table.sortable')) {
  const heads = table.tHead.rows[0].cells;
  for (const head of heads) head.firstElementChild.addEventListener('click', () => {
    const up = head.getAttribute('aria-sort') !== 'ascending';
    for (const other of heads) other.removeAttribute('aria-sort');
    head.setAttribute('aria-sort', up ? 'ascending' : 'descending');
    const k = head.cellIndex, body = table.tBodies[0];
    const value = row => row.cells[k].dataset.v ?? row.cells[k].textContent;
    const rows = [...body.rows].sort((a, b) => {
      const x = value(a), y = value(b), d = Number(x) - Number(y);
      const order = x === '' ? (y === '' ? 0 : 1) : y === '' ? -1
        : Number.isNaN(d) ? x.localeCompare(y) : up ? d : -d;
      return Number.isNaN(d) && !up ? -order : order;
    });
    body.append(...rows);
  });
}
"""


def page(results: Results, title: str) -> str:
    """A whole HTML page: a table of means and a figure for each experiment, what
    failed, and every row."""
    parts = [f"<h1>{_safe(title)}</h1>", _made_with(results)]
    for name in dict.fromkeys(row["experiment"] for row in results.rows):
        part = results.where(experiment=name)
        columns, body = summary(part)
        parts.append(f"<h2>{_safe(name)}</h2>")
        parts.append(_counts(part))
        parts.append(_table(columns, body))
        parts += [f"<figure>{figure}</figure>" for figure in _figures(part)]
    failed = {row["case"]: row for row in results.failed}
    if failed:
        parts.append("<h2>What failed</h2>")
    for case, row in failed.items():
        what = _safe(f"{case}: {row['error'] or row['status']}")
        trace = _safe(row["traceback"] or "")
        parts.append(
            f'<details><summary class="bad">{what}</summary>'
            f"<pre>{trace}</pre></details>"
        )
    flat = results._flat()
    full = [n for n in (*results.columns, *results._versions()) if n != "experiment"]
    parts.append(f"<h2>All rows</h2><details><summary>{len(flat)} rows</summary>")
    parts.append(_table(full, [[row.get(n) for n in full] for row in flat]))
    parts.append("</details>")
    return _document(title, parts)


def summary(results: Results) -> tuple[list[str], list[list]]:
    """A row for each case: its parameters, and the interquartile mean of each result
    over the seeds, with the quartiles where there are several."""
    many = any(row["seed"] != results.rows[0]["seed"] for row in results.rows)
    used = [p for p in results.parameters if any(p in row for row in results.rows)]
    numbers = [
        m
        for m in results.metrics
        if any(_number(row.get(m)) is not None for row in results.rows)
    ]
    words = [
        m
        for m in results.metrics
        if m not in numbers and any(isinstance(r.get(m), str) for r in results.rows)
    ]
    columns = [*(used or ["case"]), *(["seeds"] if many else []), "status"]
    spread = {m for m in numbers if many and _varies(results, m)}
    for metric in numbers:
        columns.append(metric)
        columns += [f"{metric} 25%", f"{metric} 75%"] if metric in spread else []
    columns += [*words, "compile s", "run s"]
    groups: dict[str, list[dict[str, Any]]] = {}
    for row in results.rows:
        groups.setdefault(row["case"], []).append(row)
    body = []
    for rows in groups.values():
        first = rows[0]
        status = ", ".join(dict.fromkeys(row["status"] for row in rows))
        line = [first.get(p) for p in (used or ["case"])]
        line += [len(rows)] if many else []
        line.append(status)
        for metric in numbers:
            found = [_number(row.get(metric)) for row in rows]
            values = np.array([v for v in found if v is not None])
            if len(values) == 0:
                line += [None] * (3 if metric in spread else 1)
                continue
            with np.errstate(invalid="ignore"):
                line.append(interquartile_mean(values))
                if metric in spread:
                    line += map(float, np.quantile(values, [0.25, 0.75]))
        line += [first.get(m) for m in words]
        line += [first["compile_seconds"], first["run_seconds"]]
        body.append(line)
    return columns, body


def _varies(results: Results, metric: str) -> bool:
    """Whether it differs between the seeds of a case."""
    seen: dict[str, Any] = {}
    for row in results.rows:
        value = row.get(metric)
        if value is not None and seen.setdefault(row["case"], value) != value:
            return True
    return False


def diff(first: Results, second: Results, *, resamples: int = 2000) -> dict[str, Any]:
    """What differs from the first to the second.

    `changed`: rows of experiment, case, metric, interquartile means of both over the
    common seeds, the difference with a paired 95% interval, and the seeds; `same`, how
    many cases agree to the last bit; `only_first`, `only_second`, `status`: names.
    """
    a, b = _by_case(first), _by_case(second)
    changed, status, same = [], [], 0
    draw = Bootstrap(resamples=resamples)
    for key in a:
        if key not in b:
            continue
        common = [seed for seed in a[key] if seed in b[key]]
        states = [{x[key][s]["status"] for s in common} for x in (a, b)]
        if states[0] != states[1]:
            shown_states = [", ".join(sorted(s)) for s in states]
            status.append([*key, *shown_states])
        moved = False
        for metric in dict.fromkeys((*first.metrics, *second.metrics)):
            pairs = [(a[key][s].get(metric), b[key][s].get(metric)) for s in common]
            if all(_equal(x, y) for x, y in pairs):
                continue
            moved = True
            numbers = [(_number(x), _number(y)) for x, y in pairs]
            kept = [n for n in numbers if n[0] is not None and n[1] is not None]
            line: list[Any] = [*key, metric]
            if kept:
                array = np.array(kept, np.float64)
                with np.errstate(invalid="ignore"):
                    difference = draw.two([array[:, ::-1]], False)
                means = interquartile_mean(array, axis=0)
                line += [float(means[0]), float(means[1]), *difference, len(kept)]
            else:
                line += [None, None, None, None, None, 0]
            changed.append(line)
        same += not moved and states[0] == states[1]
    return {
        "changed": changed,
        "status": status,
        "same": same,
        "only_first": [key for key in a if key not in b],
        "only_second": [key for key in b if key not in a],
    }


DIFF_COLUMNS = [
    *("experiment", "case", "result", "first", "second"),
    *("second - first", "low", "high", "seeds"),
]


def diff_page(found: dict[str, Any], names: tuple[str, str]) -> str:
    """What [`diff`] found as an HTML page."""
    title = f"{names[1]} against {names[0]}"
    parts = [f"<h1>{_safe(title)}</h1>", f"<p>{found['same']} cases are the same.</p>"]
    parts.append(f"<h2>{len(found['changed'])} results differ</h2>")
    parts.append(_table(DIFF_COLUMNS, found["changed"]))
    if found["status"]:
        parts.append("<h2>Another status</h2>")
        parts.append(_table(["experiment", "case", *names], found["status"]))
    for name, key in zip(names, ("only_first", "only_second"), strict=True):
        if found[key]:
            parts.append(f"<h2>Only in {_safe(name)}</h2>")
            rows = [list(entry) for entry in found[key]]
            parts.append(_table(["experiment", "case"], rows))
    return _document(title, parts)


def _by_case(results: Results) -> dict[tuple[str, str], dict[int, dict[str, Any]]]:
    found: dict[tuple[str, str], dict[int, dict[str, Any]]] = {}
    for row in results.rows:
        found.setdefault((row["experiment"], row["case"]), {})[row["seed"]] = row
    return found


def _equal(a: Any, b: Any) -> bool:
    return json.dumps(a) == json.dumps(b)


def _number(value: Any) -> float | None:
    return float(value) if isinstance(value, bool | int | float) else None


def _figures(results: Results) -> list[str]:
    """Each numeric result over the cases, as SVG, a panel for each value of the first
    of several parameters; none without Matplotlib."""
    try:
        from matplotlib import rc_context
        from matplotlib.figure import Figure
    except ImportError:
        return []
    first = results.rows[0]["case"]
    used = [p for p in results.parameters if p in results.where(case=first).rows[0]]
    panels: dict[str, dict[str, list[float]]] = {}
    found = []
    for metric in results.metrics:
        panels.clear()
        for row in results.rows:
            value = _number(row.get(metric))
            if value is None or not math.isfinite(value):
                continue
            label = row["case"].partition("[")[2][:-1] or row["case"]
            title = str(row[used[0]]) if len(used) > 1 else ""
            if title:
                label = label.removeprefix(f"{title}-")
            panels.setdefault(title, {}).setdefault(label, []).append(value)
        shown_panels = dict(list(panels.items())[:_MOST])
        if not any(len(cases) > 1 for cases in shown_panels.values()):
            continue
        wide = min(3, len(shown_panels))
        high = -(-len(shown_panels) // wide)
        longest = max(len(cases) for cases in shown_panels.values())
        size = (3.4 * wide if wide > 1 else 8, high * (0.9 + 0.24 * min(longest, 60)))
        with rc_context({"svg.hashsalt": "delucax", "svg.fonttype": "none"}):
            figure = Figure(figsize=size, layout="constrained")
            grid = figure.subplots(high, wide, squeeze=False).ravel()
            for axes, (title, cases) in zip(grid, shown_panels.items(), strict=False):
                _panel(axes, title, cases)
            for axes in grid[len(shown_panels) :]:
                axes.set_axis_off()
            figure.supxlabel(
                f"{metric} (dot: interquartile mean; bar: quartiles)", fontsize=9
            )
            out = io.StringIO()
            figure.savefig(out, format="svg", metadata={"Date": None})
        found.append("<svg" + out.getvalue().partition("<svg")[2])
    return found


_MOST = 30


def _panel(axes: Any, title: str, cases: dict[str, list[float]]) -> None:
    labels = list(cases)[:60]
    for k, label in enumerate(labels):
        values, place = cases[label], len(labels) - 1 - k
        axes.plot(values, [place] * len(values), "|", color="0.6")
        low, high = np.quantile(values, [0.25, 0.75])
        axes.plot([low, high], [place, place], color="C0", lw=3, alpha=0.5)
        axes.plot(interquartile_mean(values), place, "o", color="C0", ms=4)
    flat = [value for label in labels for value in cases[label]]
    if min(flat) > 0 and max(flat) > 100 * min(flat):
        axes.set_xscale("log")
    else:
        axes.ticklabel_format(axis="x", scilimits=(-3, 4))
    axes.set_yticks(range(len(labels)), labels[::-1], fontsize=8)
    axes.tick_params(axis="x", labelsize=8)
    axes.set_ylim(-0.7, len(labels) - 0.3)
    axes.set_title(title, fontsize=10)
    axes.grid(axis="x", alpha=0.3)


def _made_with(results: Results) -> str:
    rows = results.rows
    seen = lambda name: sorted({str(r[name]) for r in rows if r.get(name) is not None})
    versions = {f"{k} {v}" for row in rows for k, v in row["versions"].items() if v}
    commits = [commit[:10] for commit in seen("commit")]
    days = sorted({date[:10] for date in seen("date")})
    dirty = " (with changes)" if any(row["dirty"] for row in rows) else ""
    parts = [
        f"Commit {', '.join(commits)}{dirty}" if commits else "No commit",
        ", ".join(seen("dtype")),
        ", ".join(seen("device")),
        ", ".join(sorted(versions)),
        " to ".join(dict.fromkeys([*days[:1], *days[-1:]])),
    ]
    return f'<p class="made">{_safe(". ".join(p for p in parts if p))}.</p>'


def _counts(results: Results) -> str:
    cases = {row["case"]: row["status"] for row in results.rows}
    counts = Counter(cases.values())
    text = ", ".join(f"{count} {status}" for status, count in sorted(counts.items()))
    return f"<p>{len(cases)} cases: {text}.</p>"


def _table(columns: list[str], body: list[list]) -> str:
    right = [
        any(isinstance(row[k], int | float) for row in body)
        for k in range(len(columns))
    ]
    head = "".join(
        f"<th{' class=n' if r else ''}><button>{_safe(c)}</button></th>"
        for c, r in zip(columns, right, strict=True)
    )
    lines = []
    for row in body:
        cells = []
        for value, r in zip(row, right, strict=True):
            text = shown(value)
            text = text if len(text) <= 80 else text[:79] + "…"
            kind = " class=n" if r else " class=bad" if value == "failed" else ""
            exact = f' data-v="{_sorted_as(value)}"' if isinstance(value, float) else ""
            cells.append(f"<td{kind}{exact}>{_safe(text)}</td>")
        lines.append(f"<tr>{''.join(cells)}</tr>")
    return (
        f'<div class="wide"><table class="sortable"><thead><tr>{head}</tr></thead>'
        f"<tbody>{''.join(lines)}</tbody></table></div>"
    )


def _sorted_as(value: float) -> str:
    """The number as JavaScript reads it; one that is none comes last."""
    return json.dumps(value).replace("NaN", "")


def _document(title: str, parts: list[str]) -> str:
    return (
        '<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>{_safe(title)}</title><style>{_STYLE}</style></head><body>\n"
        + "\n".join(parts)
        + f"\n<script>{_SCRIPT}</script></body></html>\n"
    )


def _safe(text: Any) -> str:
    return html.escape(str(text))
