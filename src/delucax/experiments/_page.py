"""A page of HTML that needs nothing beside it."""

import base64
import dataclasses
import io
import os
import string
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from .._files import replaced
from ._provenance import device, provenance
from ._tables import as_text, escape


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
    from matplotlib import rc_context

    out = io.StringIO()
    with rc_context({"svg.hashsalt": "delucax"}):
        figure.savefig(out, format="svg", metadata={"Date": None})
    return "<svg" + out.getvalue().partition("<svg")[2]
