"""Every Python block of the pages and of the README runs, page by page.

The blocks of a page share one namespace. A comment `<!-- raises -->` before a block
says that it raises the error that the `text` block after it shows, and `<!-- notest:
why -->`, or `notest` after the language, that it is left out.
"""

import re
from pathlib import Path

import pytest
from helpers import as_a_user, has_compiler


ROOT = Path(__file__).parents[1]
PAGES = sorted([*(ROOT / "docs").glob("*.md"), *ROOT.glob("README.md")])
BLOCK = re.compile(
    r"^(?:<!-- (?P<mark>notest|raises)[^\n]*-->\n)?"
    r"```(?P<language>python|text)(?P<rest>[^\n]*)\n(?P<code>.*?)^```$",
    re.DOTALL | re.MULTILINE,
)


def _blocks(page):
    """`(line, mark, code, message)` of each Python block that is to run."""
    text = page.read_text()
    found = [
        (m, m.group("mark") or m.group("rest").strip()) for m in BLOCK.finditer(text)
    ]
    for i, (match, mark) in enumerate(found):
        if match.group("language") != "python" or mark == "notest":
            continue
        message = None
        if mark == "raises":
            after = found[i + 1][0]
            assert after.group("language") == "text", f"{page.name}: no message shown"
            message = " ".join(after.group("code").split())
        line = text.count("\n", 0, match.start("code"))
        yield line, match.group("code"), message


RUNNABLE = [page for page in PAGES if list(_blocks(page))]


def test_pages_are_found():
    names = {page.name for page in RUNNABLE}
    assert {"index.md", "first_system.md", "gradients.md", "errors.md"} <= names


@pytest.mark.parametrize("page", [pytest.param(p, id=p.name) for p in RUNNABLE])
def test_page_runs(page, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("MPLBACKEND", "agg")
    namespace = {"__name__": "page"}
    if not has_compiler and "export.load" in page.read_text():
        pytest.skip("no C compiler is there")
    for line, code, message in _blocks(page):
        # Padded, so that a traceback names the line of the page.
        compiled = compile("\n" * line + code, str(page), "exec")
        if message is None:
            exec(compiled, namespace)
            continue
        # Not B017: which error it must be is said by the message.
        with as_a_user(), pytest.raises(Exception) as raised:  # noqa: B017
            exec(compiled, namespace)
        shown = f"{raised.type.__name__}: {' '.join(str(raised.value).split())}"
        assert shown == message
