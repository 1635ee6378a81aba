"""A page of HTML that needs nothing beside it."""

import base64
import dataclasses
import io
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from .._files import replaced
from ._provenance import device, provenance
from ._tables import as_text, escape


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


@dataclasses.dataclass(frozen=True)
class Page:
    """A report of sortable tables and figures, in an HTML file that needs nothing
    beside it.

    **Arguments:**

    - `title`: its heading.
    - `parts`: pieces of HTML, to which the methods add.

    !!! example

        ```python
        from delucax.experiments import Page

        page = Page("Costs")
        page.table(["controller", "cost"], [["LQR", 1.5], ["zero", 20.0]])
        page.write("costs.html")
        ```
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
        - `kind`: `"made"` shows it faint; plain by default.
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

        - `folder`: where the code lies.
        """
        made = provenance(Path(folder))
        versions = ", ".join(f"{k} {v}" for k, v in made["versions"].items() if v)
        words = made["date"][:10], f"commit {made['commit']}", device(), versions
        self.paragraph("; ".join(words), "made")

    def __str__(self) -> str:
        title, body = escape(self.title), "\n".join(self.parts)
        return (
            '<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8">'
            '<meta name="viewport" content="width=device-width, initial-scale=1">'
            f"<title>{title}</title><style>{_STYLE}</style></head><body>\n"
            f"<h1>{title}</h1>\n{body}"
            f"\n<script>{_SCRIPT}</script></body></html>\n"
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
    from matplotlib import rc_context

    out = io.StringIO()
    with rc_context({"svg.hashsalt": "delucax"}):
        figure.savefig(out, format="svg", metadata={"Date": None})
    return "<svg" + out.getvalue().partition("<svg")[2]
