"""Tables as text, and self-contained HTML pages."""

import base64
import csv
import dataclasses
import html
import io
import json
import math
import os
import string
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from ._extras import extra
from ._files import replaced
from ._provenance import device, provenance


FORMS = {".csv": "csv", ".parquet": "parquet", ".md": "markdown", ".tex": "latex"}
"""The forms of a table by the ending of its file."""

_NAMED = {"\\": "backslash", "~": "asciitilde", "^": "asciicircum"}
_LATEX = str.maketrans({c: "\\" + c for c in "&%$#_{}"} | {"\n": " "})
_LATEX |= str.maketrans({c: f"\\text{name}{{}}" for c, name in _NAMED.items()})


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


@dataclasses.dataclass(frozen=True)
class Page:
    """A self-contained HTML page of sortable tables and figures.

    **Arguments:**

    - `title`: its heading.
    - `parts`: pieces of HTML, to which the methods add.
    """

    title: str
    parts: list[str] = dataclasses.field(default_factory=list)

    def heading(self, text: str, level: int = 2) -> None:
        """Add a heading.

        **Arguments:**

        - `text`: what it says.
        - `level`: 2 by default, as 1 is the title.
        """
        self.parts.append(f"<h{level}>{escape(text)}</h{level}>")

    def paragraph(self, text: str, kind: str = "") -> None:
        """Add a paragraph.

        **Arguments:**

        - `text`: what it says.
        - `kind`: its CSS class; `"made"` is faint.
        """
        attribute = f' class="{kind}"' if kind else ""
        self.parts.append(f"<p{attribute}>{escape(text)}</p>")

    def table(self, columns: Sequence[str], rows: Sequence[Sequence]) -> None:
        """Add a table, which a click on a heading sorts.

        **Arguments:**

        - `columns`: the headings.
        - `rows`: of each the values.
        """
        self.parts.append(as_text("html", columns, rows))

    def figure(self, figure: Any) -> None:
        """Add a figure.

        **Arguments:**

        - `figure`: one of Matplotlib, or the path of an image.
        """
        if isinstance(figure, Path):
            content = base64.b64encode(figure.read_bytes()).decode()
            kind = figure.suffix.removeprefix(".")
            source = f"data:image/{kind};base64,{content}"
            drawn = f'<img src="{source}" alt="{escape(figure.stem)}">'
        else:
            drawn = _svg(figure)
        self.parts.append(f"<figure>{drawn}</figure>")

    def provenance(self, folder: str | os.PathLike) -> None:
        """Add what it was made with: the date, the commit, the device, the versions.

        **Arguments:**

        - `folder`: of the source, for the commit.
        """
        made = provenance(Path(folder))
        versions = ", ".join(f"{k} {v}" for k, v in made["versions"].items() if v)
        words = made["date"][:10], f"commit {made['commit']}", device(), versions
        self.paragraph("; ".join(words), "made")

    def __str__(self) -> str:
        template = Path(__file__).with_name("page.html").read_text("utf-8")
        return string.Template(template).substitute(
            title=escape(self.title), body="\n".join(self.parts)
        )

    def write(self, path: str | os.PathLike) -> None:
        """Write it to a file.

        **Arguments:**

        - `path`: the HTML file to write.

        **Raises:** `OSError` if it cannot be written.
        """
        with replaced(Path(path)) as file:
            file.write(str(self).encode())


def _svg(figure: Any) -> str:
    """The same text for the same figure: without a date, with names that a fixed salt
    makes."""
    out = io.StringIO()
    with extra("matplotlib", "plot").rc_context({"svg.hashsalt": "delucax"}):
        figure.savefig(out, format="svg", metadata={"Date": None})
    return "<svg" + out.getvalue().partition("<svg")[2]
