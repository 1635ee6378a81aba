"""What the build of the site needs beyond its plugins, named as a hook in `mkdocs.yml`.

Arithmatex marks the equations of pages, docstrings and notebooks; latex2mathml turns
each into MathML here, which browsers show by themselves. The site therefore needs
neither JavaScript for its mathematics nor a network, and the sources stay plain `$...$`
and `$$...$$`. An equation that cannot be converted is a warning, hence an error in a
strict build.

The page of claims is written from the ledger, and the tables of names in the reference
from the docstrings. The version of the package stands in the header. A
figure of a notebook is described by the `alt` of its cell's metadata.
"""

import html
import importlib.metadata
import importlib.util
import inspect
import json
import logging
import pkgutil
import posixpath
import re
import sys
import tomllib
import types
import unicodedata
from collections.abc import Iterable
from typing import Any

import claims  # pyright: ignore[reportMissingImports]
from latex2mathml.converter import convert


_log = logging.getLogger("mkdocs.plugins.docs_hooks")

_EQUATION = re.compile(r'<(span|div) class="arithmatex">(.*?)</\1>', re.DOTALL)

# A class without an `__init__` of its own shows that of `object`.
_NO_INIT = re.compile(r"<p>Initialize self\.\s+See help\(type\(self\)\)[^<]*</p>")

# Cells of a notebook, figures that nothing describes, and links to other sources.
_FIGURE = re.compile(
    r'id="cell-id=([^"]*)"|'
    r'<img(?: alt="No description[^"]*")?(?=[\s>])(?![^>]*\salt=)'
)
_LINK = re.compile(r'href="([^":#]+\.(?:md|ipynb))(#[^"]*)?"')

# mkdocs-jupyter offers MathJax from the network to every page; nothing is left for it.
_MATHJAX = re.compile(r"<script data-mkdocs-jupyter-mathjax=.*?</script>", re.DOTALL)

# What latex2mathml knows by another name, or sets better under it.
_SPELLINGS = [
    (re.compile(r"\\(begin|end)\{(align|aligned|gather|split)\}"), r"\\\1{align*}"),
    (re.compile(r"\\operatorname\*?\{arg(?:\\[,;: ]|\s|~)*(min|max)\}"), r"\\arg\1"),
    (re.compile(r"\\operatorname\*"), r"\\operatorname"),
    (re.compile(r"\\mathrm\{([A-Za-z])\}"), r"{\\mathrm \1}"),
]

# It takes some relations and brackets for letters.
_LETTER = re.compile(r"<mi>(&#x[0-9A-F]+;)</mi>")

# An equation in a line of text is not broken. With more symbols than this it may be
# wider than a phone, and the style sheet lets it scroll there.
_SYMBOL, _NARROW = re.compile(r"<m[ino][ >]"), 20


def _stand_in_for_stable_baselines3() -> None:
    """The reference imports what it documents. One class extends another of
    Stable-Baselines3, which brings PyTorch; for its docstring an empty class will do.
    """
    if importlib.util.find_spec("stable_baselines3") is None:
        names = ("", ".common", ".common.vec_env")
        modules = [types.ModuleType(f"stable_baselines3{name}") for name in names]
        modules[-1].VecEnv = type("VecEnv", (), {})
        sys.modules.update({module.__name__: module for module in modules})


_stand_in_for_stable_baselines3()


def to_mathml(latex: str, display: bool) -> str:
    """The MathML of an equation, raising `ValueError` where some of it is unknown."""
    for pattern, replacement in _SPELLINGS:
        latex = pattern.sub(replacement, latex)
    mathml = convert(latex, display="block" if display else "inline")
    unknown = re.search(r"\\[A-Za-z]+", mathml)
    if unknown is not None:
        raise ValueError(f"unknown command {unknown.group()}")
    if not display and len(_SYMBOL.findall(mathml)) > _NARROW:
        mathml = mathml.replace("<math ", '<math class="delucax-wide" ', 1)
    return _LETTER.sub(_symbol, mathml)


def _symbol(match: re.Match[str]) -> str:
    kind = unicodedata.category(html.unescape(match.group(1)))
    return f"<mo>{match.group(1)}</mo>" if kind[0] in "PS" else match.group()


def on_config(config: Any, /, **_: Any) -> Any:
    """What the templates show, which is known only to the package."""
    config.extra["release"] = importlib.metadata.version("delucax")
    return config


def on_nav(nav: Any, /, **_: Any) -> Any:
    """Make `api/qp.md` the index of the section whose other pages are in `api/qp/`."""
    sections = list(nav.items)
    while sections:
        children = sections.pop().children or []
        sections += children
        pages = [child for child in children if child.is_page]
        for page in pages[1:]:
            if pages[0].url != "./" and page.url.startswith(pages[0].url):
                pages[0].file.name = "index"  # its address is known by now
    return nav


def on_page_markdown(markdown: str, /, *, page: Any, **more: Any) -> str:
    """Put the ledger of claims into its page, and tables of names into the reference;
    and name what a search for a page should find it by.
    """
    source = page.file.src_uri
    words = more["config"].extra.get("keywords", {}).get(source)
    if words:
        page.meta.setdefault("tags", words)
    package, *inner = source.removeprefix("api/").removesuffix(".md").split("/")
    if source.startswith("api/") and package != "index":
        heading = markdown.lstrip("# ").split("\n", 1)[0]
        page.meta.setdefault("title", heading if inner else f"delucax.{package}")

    def names(match: re.Match[str]) -> str:
        other = more["files"].get_file_from_path(f"api/{match.group(1)}")
        return table_of_names(other.content_string if other else markdown, package)

    markdown = re.sub(r"<!-- names(?:: (\S+))? -->", names, markdown)
    mark = "<!-- ledger -->"
    return markdown.replace(mark, ledger()) if mark in markdown else markdown


def table_of_names(markdown: str, package: str) -> str:
    """The names that a page of the reference documents, with their first sentences."""
    lines = ["| name | |", "|---|---|"]
    for name in re.findall(r"^::: (\S+)", markdown, re.MULTILINE):
        value = pkgutil.resolve_name(name)
        is_documented = inspect.isclass(value) or callable(value)
        doc = (inspect.getdoc(value) or "") if is_documented else ""
        said = " ".join(doc.split("\n\n")[0].split())
        said = re.split(r"(?<=[^.]{3}[.:]) ", said)[0].rstrip(".,:;")
        short = name.removeprefix("delucax.").removeprefix(f"{package}.")
        lines.append(f"| [`{short}`][{name}] | {said.replace('|', chr(92) + '|')} |")
    return "\n".join(lines)


def ledger() -> str:
    """What is measured, page by page, as Markdown."""
    root = claims.ROOT
    entries = tomllib.loads((root / claims.LEDGER).read_text(encoding="utf-8"))
    named = {f"@{entry['name']}": entry for entry in entries["quantity"]}
    found: dict[str, list[str]] = {}
    for entry in [*entries["claim"], *entries["table"]]:
        text = claims.read(root, entry["page"])
        match = claims.pattern(entry.get("text", entry.get("after"))).search(text)
        said = " ".join(match.group().split()).strip("| ") if match else ""
        said = re.sub(r"[`*]", "", said).replace("|", ": ")
        said = said if "text" in entry else f"the table after “{said}”"
        origins = [entry, *(named[v] for v in entry.get("values", []) if v in named)]
        made = _each(o.get("command", o.get("test")) for o in origins)
        file = _each(o.get("results") for o in origins)
        found.setdefault(entry["page"], []).append(f"| {said} | {made} | {file} |\n")
    head = "| | made by | stands in |\n|---|---|---|\n"
    return "\n".join(
        f"## {page.removeprefix('docs/')}\n\n{head}{''.join(lines)}"
        for page, lines in found.items()
    )


def _each(names: Iterable[str | None]) -> str:
    """Each name once, as code."""
    return ", ".join(f"`{name}`" for name in dict.fromkeys(names) if name)


def on_page_content(html_text: str, /, *, page: Any, files: Any, **_: Any) -> str:
    """Replace every marked equation of a page, and drop what says nothing."""
    if page.file.src_uri.endswith(".ipynb"):
        html_text = described(linked(html_text, page.file, files), page.file)

    def render(match: re.Match[str]) -> str:
        source = html.unescape(match.group(2)).strip()
        latex = re.sub(r"^\\[(\[]|\\[)\]]$", "", source).strip()
        try:
            return to_mathml(latex, display=match.group(1) == "div")
        except Exception as error:
            reason = f"{type(error).__name__}: {error}"
            _log.warning("%s: no MathML for %s (%s)", page.file.src_uri, latex, reason)
            return match.group()

    return _EQUATION.sub(render, _NO_INIT.sub("", html_text))


def linked(html_text: str, file: Any, files: Any) -> str:
    """A notebook whose links to pages and notebooks lead to what they have become."""

    def lead(match: re.Match[str]) -> str:
        path = posixpath.join(posixpath.dirname(file.src_uri), match.group(1))
        target = files.get_file_from_path(posixpath.normpath(path))
        if target is None:
            _log.warning("%s: no page for %s", file.src_uri, match.group(1))
            return match.group()
        return f'href="{target.url_relative_to(file)}{match.group(2) or ""}"'

    return _LINK.sub(lead, html_text)


def described(html_text: str, file: Any) -> str:
    """A notebook whose figures are described by the `alt` of their cells' metadata."""
    with open(file.abs_src_path, encoding="utf-8") as notebook:
        cells = json.load(notebook)["cells"]
    alts = {cell.get("id"): cell["metadata"].get("alt") for cell in cells}
    cell = ""

    def describe(match: re.Match[str]) -> str:
        nonlocal cell
        if match.group(1) is not None:
            cell = match.group(1)
            return match.group()
        if not alts.get(cell):
            where = f"{file.src_uri}: the figure of cell {cell}"
            _log.warning("%s needs a description, as alt of the cell's metadata", where)
            return match.group()
        return f'<img alt="{html.escape(alts[cell])}"'

    return _FIGURE.sub(describe, html_text)


def on_post_page(output: str, /, **_: Any) -> str:
    """Remove the loader of MathJax."""
    return _MATHJAX.sub("", output)
