"""Every Python block of the pages and of the README runs, page by page, except those
marked `notest`.

The blocks of a page share one namespace. A `text` block right under one is what it
shows, as under the cell of a notebook. A comment `<!-- raises -->` before a block says
that it raises the error that the `text` block after it shows, and `<!-- notest: why
-->`, or `notest` after the language, that it is left out.
"""

import importlib.util
import itertools
import re
from pathlib import Path

import pytest
from examples import check_output, output_of
from helpers import as_a_user, has_compiler, name_of, pages_of

import delucax as dlx


ROOT = Path(__file__).parents[1]
PAGES = pages_of(ROOT)
BLOCK = re.compile(
    r"^(?:<!-- (?P<mark>notest|raises)[^\n]*-->\n)?"
    r"```(?P<language>python|text)(?P<rest>[^\n]*)\n(?P<code>.*?)^```$",
    re.DOTALL | re.MULTILINE,
)


def _blocks(page):
    """`(line, code, shown, raises)` of each Python block that is to run."""
    text = page.read_text()
    line_of = lambda match: text.count("\n", 0, match.start("code"))
    blocks = list(BLOCK.finditer(text))
    for block, after in itertools.zip_longest(blocks, blocks[1:]):
        mark = block.group("mark") or block.group("rest").strip()
        if block.group("language") != "python" or mark == "notest":
            continue
        shown = None
        if after is not None and after.group("language") == "text":
            between = text[block.end() : after.start()]
            shown = None if between.strip() else after.group("code")
        raises = mark == "raises"
        assert shown or not raises, f"{page.name}: no message is shown"
        yield line_of(block), block.group("code"), shown, raises


RUNNABLE = [page for page in PAGES if list(_blocks(page))]


def test_pages_are_found():
    names = {name_of(ROOT, page) for page in RUNNABLE}
    assert {"index.md", "first_system.md", "gradients.md"} <= names
    assert {"errors.md", "troubleshooting.md", "coming_from/diffrax.md"} <= names


@pytest.mark.parametrize(
    "page", [pytest.param(p, id=name_of(ROOT, p)) for p in RUNNABLE]
)
def test_page_runs(page, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("MPLBACKEND", "agg")
    namespace = {"__name__": "page"}
    if not has_compiler and "export.load" in page.read_text():
        pytest.skip("no C compiler is there")
    for line, code, shown, raises in _blocks(page):
        # Padded, so that a traceback names the line of the page.
        code = "\n" * line + code
        if not raises:
            output = output_of(code, namespace, str(page))
            if shown is not None:
                check_output(output, shown)
            continue
        # Not B017: which error it must be is said by the message.
        with as_a_user(), pytest.raises(Exception) as raised:  # noqa: B017
            exec(compile(code, str(page), "exec"), namespace)
        message = f"{raised.type.__name__}: {raised.value}"
        assert message.split() == shown.split()


def test_wheels_have_the_name_of_this_version():
    texts = [(ROOT / "README.md").read_text(), *(p.read_text() for p in PAGES)]
    named = {n for text in texts for n in re.findall(r"delucax-([\d.]+)-py3", text)}
    assert named == {dlx.__version__}


def test_every_status_is_explained():
    text = (ROOT / "docs" / "errors.md").read_text()
    missing = [name for name in dlx.RESULTS._name_to_item if f"`{name}`" not in text]
    assert not missing


def test_layers_are_drawn_as_they_are():
    path = ROOT / "docs" / "figures" / "layers.py"
    spec = importlib.util.spec_from_file_location("layers", path)
    layers = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(layers)
    assert layers.PICTURE.read_text() == layers.picture(layers.settings())
