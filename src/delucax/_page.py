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
"""The formats of a table by the suffix of its file."""

_NAMED = {"\\": "backslash", "~": "asciitilde", "^": "asciicircum"}
_LATEX = str.maketrans({c: "\\" + c for c in "&%$#_{}"} | {"\n": " "})
_LATEX |= str.maketrans({c: f"\\text{name}{{}}" for c, name in _NAMED.items()})


def as_text(
    form: str, columns: Sequence[str], rows: Sequence[Sequence], digits: int = 4
) -> str:
    """A table as text in one of the formats `csv`, `markdown`, `latex` and `html`."""
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
    """The number as JavaScript reads it. NaN is empty, and so sorts last."""
    return json.dumps(value).replace("NaN", "")


def shown(value: Any, digits: int = 4) -> str:
    """A value as a table shows it."""
    if value is None:
        return ""
    if isinstance(value, float) and math.isfinite(value):
        return f"{value:.{digits}g}"
    return str(value)


def escape(text: Any) -> str:
    """A text with the special characters of HTML escaped."""
    return html.escape(str(text))


@dataclasses.dataclass(frozen=True)
class Page:
    """A self-contained HTML page of sortable tables and figures.

    **Arguments:**

    - `title`: the heading of the page.
    - `parts`: pieces of HTML, to which the methods append; none by default.
    """

    title: str
    parts: list[str] = dataclasses.field(default_factory=list)

    def heading(self, text: str, level: int = 2) -> None:
        """Add a heading.

        **Arguments:**

        - `text`: the text of the heading.
        - `level`: the level of the heading, 2 by default; the title has level 1.
        """
        self.parts.append(f"<h{level}>{escape(text)}</h{level}>")

    def paragraph(self, text: str, kind: str = "") -> None:
        """Add a paragraph.

        **Arguments:**

        - `text`: the text of the paragraph.
        - `kind`: its CSS class, none by default; `"made"` is faint.
        """
        attribute = f' class="{kind}"' if kind else ""
        self.parts.append(f"<p{attribute}>{escape(text)}</p>")

    def table(self, columns: Sequence[str], rows: Sequence[Sequence]) -> None:
        """Add a table, which sorts by a click on the heading of a column.

        **Arguments:**

        - `columns`: the headings of the columns.
        - `rows`: the values of each row.
        """
        self.parts.append(as_text("html", columns, rows))

    def figure(self, figure: Any) -> None:
        """Add a figure.

        **Arguments:**

        - `figure`: a Matplotlib figure, or the path of an image.
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
        """Add a line with the date, the commit, the device and the versions.

        **Arguments:**

        - `folder`: the folder of the source, to look up the commit.
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
        """Write the page to a file.

        **Arguments:**

        - `path`: the HTML file to write.

        **Raises:** `OSError` if the file cannot be written.
        """
        with replaced(Path(path)) as file:
            file.write(str(self).encode())


def _svg(figure: Any) -> str:
    """The figure as SVG. The same figure gives the same text, because there is no date
    and a fixed salt makes the names."""
    out = io.StringIO()
    with extra("matplotlib", "plot").rc_context({"svg.hashsalt": "delucax"}):
        figure.savefig(out, format="svg", metadata={"Date": None})
    return "<svg" + out.getvalue().partition("<svg")[2]
