"""A table as text: CSV, Markdown, LaTeX or HTML."""

import csv
import html
import io
import json
import math
from collections.abc import Sequence
from typing import Any


FORMS = {".csv": "csv", ".parquet": "parquet", ".md": "markdown", ".tex": "latex"}
"""The forms of a table by the ending of its file."""

_LATEX = str.maketrans(
    {
        "\\": r"\textbackslash{}",
        **{c: "\\" + c for c in "&%$#_{}"},
        "~": r"\textasciitilde{}",
        "^": r"\textasciicircum{}",
        "\n": " ",
    }
)


def as_text(
    form: str, columns: Sequence[str], rows: Sequence[Sequence], digits: int = 4
) -> str:
    """The rows of a table in one of the forms `csv`, `markdown`, `latex` and `html`."""
    if form == "csv":
        out = io.StringIO()
        csv.writer(out, lineterminator="\n").writerows([columns, *rows])
        return out.getvalue()
    is_number = [
        any(isinstance(row[k], int | float) for row in rows)
        for k in range(len(columns))
    ]
    if form == "html":
        return _html(columns, rows, is_number)
    cells = [[shown(value, digits) for value in row] for row in rows]
    if form == "markdown":
        rule = ["---:" if number else "---" for number in is_number]
        escaped = [[c.replace("|", "\\|").replace("\n", " ") for c in r] for r in cells]
        lines = [columns, rule, *escaped]
        return "".join("| " + " | ".join(line) + " |\n" for line in lines)
    spec = "".join("r" if number else "l" for number in is_number)
    head, *body = (
        " & ".join(cell.translate(_LATEX) for cell in line) + " \\\\\n"
        for line in (columns, *cells)
    )
    return (
        f"\\begin{{tabular}}{{{spec}}}\n\\toprule\n{head}\\midrule\n"
        f"{''.join(body)}\\bottomrule\n\\end{{tabular}}\n"
    )


def _html(columns: Sequence[str], rows: Sequence[Sequence], is_number: list) -> str:
    head = "".join(
        f"<th{' class=n' if number else ''}><button>{escape(name)}</button></th>"
        for name, number in zip(columns, is_number, strict=True)
    )
    lines = []
    for row in rows:
        cells = []
        for value, number in zip(row, is_number, strict=True):
            text = shown(value)
            text = text if len(text) <= 80 else text[:79] + "…"
            kind = " class=n" if number else " class=bad" if value == "failed" else ""
            exact = f' data-v="{_sort_key(value)}"' if isinstance(value, float) else ""
            cells.append(f"<td{kind}{exact}>{escape(text)}</td>")
        lines.append(f"<tr>{''.join(cells)}</tr>")
    return (
        f'<div class="wide"><table class="sortable"><thead><tr>{head}</tr></thead>'
        f"<tbody>{''.join(lines)}</tbody></table></div>"
    )


def _sort_key(value: float) -> str:
    """The number as JavaScript reads it; NaN is empty, and sorts last."""
    return json.dumps(value).replace("NaN", "")


def shown(value: Any, digits: int = 4) -> str:
    """A value as a table shows it."""
    if value is None:
        return ""
    if isinstance(value, float) and math.isfinite(value):
        return f"{value:.{digits}g}"
    return str(value)


def escape(text: Any) -> str:
    """A text as HTML shows it."""
    return html.escape(str(text))
