"""Every Python block of the pages and of the README runs, page by page, except those
marked `notest`, which need what is not there. Blocks `py` are code of other libraries,
which the pages show beside ours.

A `text` block right under a block is what it shows, as under the cell of a notebook. A
comment `<!-- raises -->` before a block says that it raises the error that the `text`
block after it shows; `<!-- elsewhere: file -->` that another test runs it, in another
precision or in part; and `<!-- notest: why -->` that it is left out. A block of C after
`<!-- part of: file -->` is in this file, which the page writes.

The blocks of a page share one namespace. With `--only-outputs` those run that show
something, and those that they need, so that a writer need not wait for the rest.
"""

import ast
import importlib.util
import itertools
import re
import symtable
import warnings
from pathlib import Path
from typing import NamedTuple

import jax
import pytest
from examples import check_output, output_of
from helpers import as_a_user, has_compiler, name_of, pages_of

import delucax as dlx


ROOT = Path(__file__).parents[1]
PAGES = pages_of(ROOT)
BLOCK = re.compile(
    r"^(?:<!-- (?P<mark>notest|elsewhere|raises|part of)(?:: )?(?P<why>[^\n]*?) -->\n)?"
    r"```(?P<language>python|py|text|c)[^\n]*\n(?P<code>.*?)^```$",
    re.DOTALL | re.MULTILINE,
)


class Block(NamedTuple):
    line: int
    code: str
    shown: str | None
    raises: bool


def _blocks(page, language="python"):
    """The blocks of a page in this language that are to run."""
    text = page.read_text()
    blocks = list(BLOCK.finditer(text))
    for block, after in itertools.zip_longest(blocks, blocks[1:]):
        mark = block.group("mark")
        if block.group("language") != language or mark in MARKS:
            continue
        shown = None
        if after is not None and after.group("language") == "text":
            between = text[block.end() : after.start()]
            shown = None if between.strip() else after.group("code")
        raises = mark == "raises"
        assert shown or not raises, f"{page.name}: no message is shown"
        line = text.count("\n", 0, block.start("code"))
        yield Block(line, block.group("code"), shown, raises)


def _names(code):
    """The names that a block takes from others, that it sets, and whose value it may
    change, as in `env.reset()`."""
    taken, made, changed = set(), set(), set()
    for statement in ast.parse(code).body:
        tables = [symtable.symtable(ast.unparse(statement), "block", "exec")]
        for table in tables:
            tables.extend(table.get_children())
        for table, symbol in ((t, s) for t in tables for s in t.get_symbols()):
            is_top, name = table is tables[0], symbol.get_name()
            if symbol.is_referenced() and (is_top or symbol.is_global()):
                taken |= {name} - made
        symbols = tables[0].get_symbols()
        made |= {s.get_name() for s in symbols if s.is_assigned() or s.is_imported()}
        match statement:
            case ast.Expr(ast.Call(ast.Attribute(ast.Name(name)))):
                changed.add(name)
            case ast.Assign([ast.Subscript(ast.Name(name))]):
                changed.add(name)
    return taken, made, changed


def _with_needed(blocks, queue):
    """The blocks in the queue and those that they need, in the order of the page."""
    names = [_names(block.code) for block in blocks]
    queue, found = list(queue), set()
    while queue:
        i = queue.pop()
        found.add(i)
        for name in names[i][0]:
            for k in reversed(range(i)):
                _, made, changed = names[k]
                if name in made | changed and k not in found:
                    queue.append(k)
                if name in made:
                    break
    return [blocks[i] for i in sorted(found)]


MARKS = ("notest", "elsewhere")


RUNNABLE = [page for page in PAGES if list(_blocks(page))]
OF_OTHERS = [page for page in PAGES if list(_blocks(page, "py"))]


def _run(page, blocks):
    namespace = {"__name__": "page"}
    compiles = re.compile(r"export\.load|backend=\"c\"")
    if not has_compiler and any(compiles.search(block.code) for block in blocks):
        pytest.skip("no C compiler is there")
    for line, code, shown, raises in blocks:
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
        check_output(f"{raised.type.__name__}: {raised.value}", shown)


def _check_part(code, text):
    """The text has these lines, with nearly the same numbers."""
    number = r"\d+\.\d+"
    pattern = r"\s*".join(
        f"({number})" if re.fullmatch(number, token) else re.escape(token)
        for token in re.findall(rf"{number}|\w+|\S", code)
    )
    found = re.search(pattern, text)
    assert found, f"{code} is not in\n{text}"
    values = [float(value) for value in re.findall(number, code)]
    assert [float(value) for value in found.groups()] == pytest.approx(values, rel=1e-3)


def test_blocks_that_are_left_out_need_what_is_not_there():
    marks = [m for page in PAGES for m in BLOCK.finditer(page.read_text())]
    why = {kind: [m["why"] for m in marks if m["mark"] == kind] for kind in MARKS}
    assert all(re.match("(needs|takes) ", reason) for reason in why["notest"])
    assert all((ROOT / file).is_file() for file in why["elsewhere"])


def test_pages_are_found():
    names = {name_of(ROOT, page) for page in RUNNABLE}
    assert {"index.md", "first_system.md", "gradients.md"} <= names
    assert {"errors.md", "troubleshooting.md", "coming_from/diffrax.md"} <= names


@pytest.fixture
def in_a_folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("MPLBACKEND", "agg")
    precision = jax.config.jax_enable_x64
    yield
    jax.config.update("jax_enable_x64", precision)


@pytest.mark.parametrize(
    "page", [pytest.param(p, id=name_of(ROOT, p)) for p in RUNNABLE]
)
def test_page_runs(page, in_a_folder, pytestconfig):
    blocks = list(_blocks(page))
    if pytestconfig.getoption("only_outputs"):
        shown = [i for i, block in enumerate(blocks) if block.shown is not None]
        blocks = _with_needed(blocks, shown)
    _run(page, blocks)
    for block in BLOCK.finditer(page.read_text()):
        if block["mark"] == "part of":
            _check_part(block["code"], Path(block["why"]).read_text())


@pytest.mark.parametrize(
    "page", [pytest.param(p, id=name_of(ROOT, p)) for p in OF_OTHERS]
)
def test_code_of_other_libraries_runs(page, in_a_folder, pytestconfig):
    if pytestconfig.getoption("only_outputs"):
        pytest.skip("it shows no outputs")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # theirs are not ours to mend
        _run(page, list(_blocks(page, "py")))


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
