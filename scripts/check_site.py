"""Check the built site, after `make docs`, and the links of the pages beside it. An
argument names another folder of the site.

Every link inside the site leads to a page, and to an anchor of it; every image is there
and has a text for those who do not see it; no two pages share a title; and no line of
code is longer than 88 characters, so that none scrolls (what code prints wraps).

README.md and CONTRIBUTING.md are read in the repository: there a link leads to a file,
and its anchor to a heading, which GitHub names by a rule of its own.
"""

import posixpath
import re
import sys
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote, urlsplit


ROOT = Path(__file__).parents[1]
SITE = ROOT / "site"
WIDTH = 88
BLOCK = re.compile(r"^(`{3,}).*?^\1`*$", re.DOTALL | re.MULTILINE)
CODE = re.compile(r"(`+).+?\1", re.DOTALL)
LINK = re.compile(r"\]\(\s*<?([^)\s>]+)|^\[[^\]]+\]:\s*<?([^\s>]+)", re.MULTILINE)
VOID = {"br", "col", "hr", "img", "input", "link", "meta", "path", "source", "wbr"}


class Page(HTMLParser):
    """What a page names, what it refers to, and what is wrong with it."""

    def __init__(self, path: Path) -> None:
        super().__init__()
        self.anchors, self.links, self.faults = {"", "__codelineno"}, set(), []
        self.title, self._code, self._in = "", None, []
        self.feed(path.read_text(encoding="utf-8"))

    def handle_starttag(self, tag, attrs):
        named = dict(attrs)
        self.anchors |= {named.get("id"), named.get("name") if tag == "a" else None}
        self.links |= {named.get("href"), named.get("src"), named.get("data")} - {None}
        is_shown = tag == "img" and "hidden" not in named
        if is_shown and not (named.get("alt") or "").strip():
            self.faults.append(f"an image without alt: {named.get('src', '')[:60]}")
        if tag not in VOID:
            self._in.append((tag, named.get("class") or ""))
        kinds = " ".join(kind for _, kind in self._in)
        if tag == "pre" and not re.search("jp-OutputArea|language-text", kinds):
            self._code = []

    def handle_data(self, data):
        if self._code is not None:
            self._code.append(data)
        if [tag for tag, _ in self._in[-2:]] == ["head", "title"]:
            self.title += data.strip()

    def handle_endtag(self, tag):
        while any(tag == open_tag for open_tag, _ in self._in):
            if self._in.pop()[0] == tag:
                break
        if tag == "pre" and self._code is not None:
            for line in "".join(self._code).splitlines():
                if len(line) > WIDTH:
                    self.faults.append(f"{len(line)} characters of code: {line}")
            self._code = None


def faults(site: Path) -> list[str]:
    """What is wrong, one line each."""
    paths = {p.relative_to(site).as_posix(): p for p in site.rglob("*.html")}
    pages = {name: Page(path) for name, path in sorted(paths.items())}
    found, titles = [] if pages else [f"no page in {site}"], {}
    for name, page in pages.items():
        found += [f"{name}: {fault}" for fault in page.faults]
        other = titles.setdefault(page.title.casefold(), name)
        if other != name and name != "404.html":
            found.append(f"{name}: has the title of {other}, {page.title!r}")
        for link in sorted(page.links):
            url = urlsplit(link)
            if url.scheme or url.netloc:
                continue
            base = "" if url.path.startswith("/") else posixpath.dirname(name)
            target = posixpath.normpath(
                posixpath.join(base, unquote(url.path).lstrip("/"))
            )
            target = name if not url.path else target
            if (site / target).is_dir():
                target = posixpath.normpath(posixpath.join(target, "index.html"))
            anchor = unquote(url.fragment)
            if not (site / target).is_file():
                found.append(f"{name}: no page for {link}")
            elif target in pages and anchor not in pages[target].anchors:
                found.append(f"{name}: no anchor for {link}")
    return found


def slugs(markdown: str) -> set[str]:
    """The anchors of a file's headings as GitHub makes them.

    A letter is made small, a space becomes a hyphen, and other signs go. A second
    heading with the same words ends in -1.
    """
    found: list[str] = []
    for heading in re.findall(r"^#{1,6} +(.*)$", BLOCK.sub("", markdown), re.MULTILINE):
        shown = re.sub(r"!?\[([^\]]*)\]\([^)]*\)", r"\1", heading.strip())
        found.append(re.sub(r"[^\w\- ]", "", shown.lower()).replace(" ", "-"))
    return {
        f"{slug}-{found[:i].count(slug)}" if slug in found[:i] else slug
        for i, slug in enumerate(found)
    }


def broken(root: Path, name: str) -> list[str]:
    """The links of a Markdown file of the repository that lead nowhere, a line each."""
    markdown = (root / name).read_text(encoding="utf-8")
    found = []
    for links in LINK.findall(CODE.sub("", BLOCK.sub("", markdown))):
        url = urlsplit("".join(links))
        if url.scheme or url.netloc:
            continue
        target = (root / name).parent / unquote(url.path) if url.path else root / name
        if not target.exists():
            found.append(f"{name}: no file for {url.geturl()}")
        elif url.fragment and target.suffix == ".md":
            if unquote(url.fragment) not in slugs(target.read_text(encoding="utf-8")):
                found.append(f"{name}: no heading for {url.geturl()}")
    return found


if __name__ == "__main__":
    site = Path(sys.argv[1]) if len(sys.argv) > 1 else SITE
    wrong = faults(site) + broken(ROOT, "README.md") + broken(ROOT, "CONTRIBUTING.md")
    print("\n".join(wrong) or "the site is sound")
    sys.exit(bool(wrong))
