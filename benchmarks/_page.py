"""Parts of a page that come from the results, between marks."""

from pathlib import Path


DOCS = Path(__file__).parents[1] / "docs"


def write_page(page: Path, made: dict[str, str]) -> None:
    """Put each part between its marks.

    The part `x` is between the lines `<!-- x -->` and `<!-- end of x -->`.
    """
    text = page.read_text(encoding="utf-8")
    for name, part in made.items():
        begin, end = f"<!-- {name} -->\n", f"<!-- end of {name} -->"
        before, found, rest = text.partition(begin)
        _, ended, after = rest.partition(end)
        if not found or not ended:
            raise ValueError(f"write_page: {page.name} has no marks of {name!r}.")
        text = f"{before}{begin}\n{part}\n{end}{after}"
    page.write_text(text, encoding="utf-8")


def markdown(head: list[str], body: list[list[str]], left: int) -> str:
    """A table whose first `left` columns are text, and the others numbers."""
    rule = ["---" if k < left else "---:" for k in range(len(head))]
    lines = [" | ".join(line) for line in (head, rule, *body)]
    return "".join(f"| {line} |\n" for line in lines)
