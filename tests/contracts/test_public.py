"""Every public name is documented: in its docstring, argument by argument, with an
example that runs; and on a page of the site."""

import importlib
import inspect
import pkgutil
import re
import textwrap
from pathlib import Path

import diffrax
import equinox as eqx
import pytest
from examples import check_output, output_of
from helpers import has_compiler

import delucax as dlx


def _packages():
    names = [m.name for m in pkgutil.iter_modules(dlx.__path__)]
    public = [name for name in names if not name.startswith("_")]
    public.append("training.sysid")
    return [dlx, *(importlib.import_module(f"delucax.{name}") for name in public)]


def _members():
    """`(qualified name, object)`, each object once, under its shortest name."""
    found = {}
    for package in _packages():
        names = set(vars(package)) | set(package.__dir__())
        for name in sorted(names):
            if name.startswith("_"):
                continue
            value = getattr(package, name)
            if inspect.ismodule(value):
                continue
            found.setdefault(id(value), (f"{package.__name__}.{name}", value))
    return sorted(found.values(), key=lambda item: item[0])


MEMBERS = [m for m in _members() if not m[0].endswith(".annotations")]
CALLABLES = [(n, v) for n, v in MEMBERS if inspect.isclass(v) or inspect.isroutine(v)]
IDS = [name for name, _ in CALLABLES]
DOCS = Path(__file__).parents[2] / "docs" / "api"


def _arguments(value):
    try:
        parameters = inspect.signature(value).parameters.values()
    except (TypeError, ValueError):
        return []
    return [p.name for p in parameters if p.name not in ("self", "cls")]


def _unnamed(value, doc):
    return [a for a in _arguments(value) if not re.search(rf"`\**{a}`", doc)]


def _is_marker(value):
    """Enumerations, and tuples of results whose fields are described one by one."""
    return value is dlx.RESULTS


@pytest.mark.parametrize("name, value", CALLABLES, ids=IDS)
def test_docstring_names_every_argument(name, value):
    doc = inspect.getdoc(value) or ""
    assert len(doc.split()) >= 5, f"{name} has no docstring"
    if inspect.isclass(value) and inspect.isabstract(value) or _is_marker(value):
        return
    missing = _unnamed(value, doc)
    assert not missing, f"{name}: the docstring does not name {missing}"


def test_modules_print_their_values():
    """`__repr__ = shown` belongs in the first class of a family."""
    for name, value in CALLABLES:
        is_module = inspect.isclass(value) and issubclass(value, eqx.Module)
        if is_module and not issubclass(value, diffrax.AbstractSolver):
            assert value.__repr__ is not eqx.Module.__repr__, name


@pytest.mark.parametrize("name, value", CALLABLES, ids=IDS)
def test_methods_are_documented(name, value):
    if not inspect.isclass(value):
        return
    for attribute, member in inspect.getmembers(value):
        if attribute.startswith("_") or inspect.isclass(member):
            continue
        owner = getattr(member, "__module__", "") or ""
        is_property = isinstance(member, property)
        if not (is_property or inspect.isroutine(member)):
            continue
        if not is_property and not owner.startswith("delucax"):
            continue
        doc = inspect.getdoc(member) or ""
        if not doc and not is_property:
            doc = _inherited(value, attribute)
        elif not doc:
            doc = _inherited(value, attribute)
        assert doc, f"{name}.{attribute} has no docstring"
        if not is_property:
            missing = [a for a in _unnamed(member, doc) if a not in ("args", "kwargs")]
            assert not missing, f"{name}.{attribute}: does not name {missing}"


def _inherited(cls, attribute):
    """The docstring of the abstract method that this one implements."""
    for base in cls.__mro__:
        member = vars(base).get(attribute)
        doc = getattr(member, "__doc__", None)
        if doc:
            return inspect.cleandoc(doc)
    return ""


def _examples(doc):
    """The code of each example, and the output that is printed right under it."""
    block = r"^( *)```python\n(.*?)^\1```(?:\n\s*\1```text\n(.*?)^\1```)?"
    examples = re.findall(block, doc, re.DOTALL | re.MULTILINE)
    return [(textwrap.dedent(code), printed) for _, code, printed in examples]


@pytest.mark.parametrize(
    "name, value",
    [pytest.param(*case, id=id) for case, id in zip(CALLABLES, IDS, strict=True)],
)
def test_example_runs(name, value, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    if _is_marker(value) or value is dlx.studies.demo:  # a test of the demo runs it
        return
    examples = _examples(inspect.getdoc(value) or "")
    owner = {"delucax.environments.Step": dlx.Environment}.get(name)
    if owner is not None:  # what a method returns is shown where it is returned
        examples = _examples(inspect.getdoc(owner) or "")
    assert examples, f"{name} has no example"
    if not has_compiler and any("export.load" in code for code, _ in examples):
        pytest.skip("no C compiler is there")
    for code, printed in examples:
        output = output_of(code, {"__name__": "example"}, name)
        if printed:
            check_output(output, printed)


@pytest.mark.parametrize("name", [name for name, _ in MEMBERS])
def test_name_is_on_the_site(name):
    pages = "\n".join(page.read_text() for page in sorted(DOCS.rglob("*.md")))
    assert re.search(
        rf"^ *(:::|##+) +`?{re.escape(name)}`?\s*$", pages, re.MULTILINE
    ), f"{name} is on no page of docs/api"
