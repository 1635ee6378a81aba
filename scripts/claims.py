"""Check that each number of README, docs and notebooks is what was measured.

`docs/claims.toml` says for each number which command makes it and where it stands in
the committed results. `python scripts/claims.py` fails where

- a page has a number with a unit, with "times" or with "%", one "of" another, that of a
  slope, ratio, residual or speed-up, a table a cell that is a number, or a block of
  text one that the code before it printed, and nothing in the ledger covers it (the
  output right under a block that runs is compared by `tests/test_docs.py` instead);
- a number is not that of the results, at the digits that are printed;
- the results were made by an older minor version of delucax than this one;
- an entry is not on its page, or its command, test or results file does not exist;
- one quantity has two numbers, or two names.

The ledger has four kinds of entries. A `claim` is a piece of a page in which `{}` is
a number, and `values` say where these are in `results`; where a test proves the claim,
`test` names it in place of `results`, and `true` lists what must be true in these. A
`table` is the one that follows the text `after`, or begins with it; `columns` has for
each column where its numbers are, with `{}` for the first cell of the row, or for what
`rows` has in its place, and `{2}` for the second. What is `given` was chosen, or is
somebody else's number; a number that a claim spells out, instead of `{}`, is given too.

A `quantity` has a `name`, its `command`, its `results` and its one `value` in these. A
claim states it by `@NAME` among its values. What README states is a quantity, and is
stated on another page too, where a reader finds how it was measured; and what two pages
state is a quantity. Each sentence that states one has all of its `words`, which are
regular expressions (a row of a table: itself or in its head), so that a baseline has
one name everywhere. No sentence that has these words may give another measured number,
except that of another quantity or a given one, and no cell of a table whose row and
column have them. So a number that is measured a second time, by whatever command, is
refused.

Of a notebook only the Markdown is read: an output is what the run shows. A message
gives the line of a page, but the cell of a notebook, where cells of code count too.

A place in the results is written `[<= ][TAKE of ]STEP > STEP > ...[ * FACTOR]`. A step
is the key of an object, the number of a member of a list, or `KEY=VALUE & KEY=VALUE`:
those members that have these values. TAKE (`first`, `min`, `max`, `sum`, `median`,
`mean`, `iqm`, `count`) makes one number of several. With `<=` the number may be less
than is printed, with `>=` more. A number stands for itself.
"""

import json
import math
import operator
import re
import statistics
import sys
import tomllib
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any


ROOT = Path(__file__).parents[1]
LEDGER = "docs/claims.toml"
FRONT = "README.md"
_CELL_END = "\n\f\n"

_NUMBER = r"[-+−]?(?:\d{1,3}(?:,\d{3})+|\d+)(?:\.\d+)?(?:e[-+]?\d+)?"
_WORD = r"\b(?:two|three|four|five|six|seven|eight|nine|ten|twenty|a hundred)"
_UNIT = (
    r"times|x\b|%|(?:ns|us|µs|ms|s|min|h|[kMG]B|cmH2O|seconds?|minutes?|hours?|"
    r"(?:nano|micro|milli)seconds?|bytes)\b"
)
_MEASURED = re.compile(
    rf"(?<![\w.\[-]){_NUMBER}\s?(?:{_UNIT})|"
    rf"{_WORD}\s(?:times|seconds|minutes|hours|milliseconds|microseconds)\b|"
    rf"(?<![\w.\[-]){_NUMBER}\s(?:out\s)?of\s(?:all\s|the\s)?{_NUMBER}|"
    rf"\b(?:slope|ratio|residual|speed-?up)s?\s(?:[a-z]+\s){{0,2}}{_NUMBER}"
)
_NUMERIC_CELL = re.compile(rf"[*<>=~≤≥ ]*{_NUMBER}")
_ROW = re.compile(r"^\|.*\|[ ]*$", re.MULTILINE)
_HEAD = re.compile(r"^\|.*\|[ ]*\n\|[ :|-]+\|[ ]*$", re.MULTILINE)
_FENCED = re.compile(
    r"^(?:<!-- (?P<mark>raises|notest|elsewhere)[^\n]*-->\n)?"
    r"```(?P<language>\w*)[^\n]*\n(?P<code>.*?)^```$",
    re.MULTILINE | re.DOTALL,
)
# What no reader takes for a statement: code, comments, equations, addresses.
_SILENT = [
    re.compile(r"^( *)```[^`]*?^\1``` *$", re.MULTILINE),
    re.compile(r"<!--.*?-->", re.DOTALL),
    re.compile(r"`[^`\n]*`|\$[^$\f]*\$|\]\([^)\n]*\)|\{ *width[^}]*\}"),
]


def pages(root: Path) -> list[str]:
    """The pages that are held to the ledger."""
    docs = root / "docs"
    found = [root / "README.md", *sorted(docs.glob("*.md"))]
    found += sorted(docs.glob("coming_from/*.md"))
    found += sorted((root / "notebooks").glob("*.ipynb"))
    return [str(path.relative_to(root)) for path in found]


def read(root: Path, page: str) -> str:
    """The text of a page; of a notebook the Markdown, with a mark after each cell."""
    text = (root / page).read_text(encoding="utf-8")
    if page.endswith(".ipynb"):
        cells = json.loads(text)["cells"]
        said = [c["source"] if c["cell_type"] == "markdown" else "" for c in cells]
        text = "".join("".join(source) + _CELL_END for source in said)
    return text


@dataclass
class _Ledger:
    """The entries, and what has been read of them so far."""

    quantities: dict[str, dict] = field(default_factory=dict)
    sources: dict[str, Any] = field(default_factory=dict)
    # By page: where numbers are covered, and by which quantity; "" if they are given.
    covered: dict[str, list[tuple[int, int, str | None]]] = field(default_factory=dict)
    # By the identity of a number: the pages that state it, and how one reads it.
    stated: dict[tuple, dict[str, str]] = field(default_factory=dict)

    def identity(self, results: str, place: str) -> tuple:
        """The same for two places of a file that hold one number."""
        place = re.sub(r"^[<>]= ", "", place)
        value = _look(self.sources.get(results), place)
        telling = isinstance(value, float) and len(repr(value)) > 8
        return results, repr(value) if telling else place

    def named(self, results: str, place: str) -> str | None:
        """The quantity that is at a place, if one is."""
        for name, known in self.quantities.items():
            if results == known["results"]:
                here = self.identity(results, place)
                if here == self.identity(results, known["value"]):
                    return name
        return None


def problems(root: Path = ROOT) -> list[str]:
    """What is wrong, a line each."""
    entries = tomllib.loads((root / LEDGER).read_text(encoding="utf-8"))
    texts = {name: read(root, name) for name in pages(root)}
    ledger = _Ledger(covered={name: [] for name in texts})
    found = []
    for kind in entries:
        if kind not in ("quantity", "claim", "table", "given"):
            found.append(f"{LEDGER}: unknown kind of entry {kind!r}")
    for entry in entries.get("quantity", []):
        found += _origin(root, entry, ledger)
        found += _quantity(entry, ledger)
    for kind, check in (("claim", _claim), ("table", _table), ("given", _given)):
        for entry in entries.get(kind, []):
            page = entry.get("page")
            if page not in texts:
                found.append(f"{LEDGER}: no page {page!r}")
                continue
            if kind != "given":
                found += _origin(root, entry, ledger)
            said = check(texts[page], entry, ledger)
            try:
                found += [f"{page}{line}" for line in said]
            except ValueError as error:
                found.append(str(error))
    for name, text in texts.items():
        covered = ledger.covered[name]
        for start, end in _measured(text):
            if not _is_covered(text, start, end, covered):
                words = " ".join(text[start:end].split())
                found.append(
                    f"{name}:{_line(text, start)}: {words!r} is not in {LEDGER}"
                )
        found += [f"{name}{line}" for line in _words(text, ledger, covered)]
    return found + list(_names(ledger))


def _is_covered(
    text: str, start: int, end: int, covered: Iterable[tuple[int, int, str | None]]
) -> bool:
    """Whether the ledger has each number of a piece, or the whole of it."""
    number = rf"(?<![A-Za-z]){_NUMBER}"  # not the 2 of cmH2O
    numbers = [m.span() for m in re.finditer(number, text[start:end])]
    numbers = [(start + a, start + b) for a, b in numbers] or [(start, end)]
    return all(
        any(a <= first and last <= b for a, b, _ in covered) for first, last in numbers
    )


def _quantity(entry: dict, ledger: _Ledger) -> Iterator[str]:
    name = entry["name"]
    if name in ledger.quantities:
        yield f"{LEDGER}: two quantities {name!r}"
    if not entry.get("words"):
        yield f"{LEDGER}: the quantity {name!r} has no words"
    other = ledger.named(entry["results"], entry["value"])
    if other not in (None, name):
        yield f"{LEDGER}: {name!r} and {other!r} are one quantity"
    ledger.quantities[name] = entry


def _names(ledger: _Ledger) -> Iterator[str]:
    """What is stated without a name, and what README alone states."""
    known = {
        ledger.identity(entry["results"], entry["value"]): name
        for name, entry in ledger.quantities.items()
    }
    for identity, where in ledger.stated.items():
        if identity not in known and len(where) > 1:
            place = next(iter(where.values()))
            yield f"{LEDGER}: {place!r} of {', '.join(sorted(where))} needs a name"
    for identity, name in known.items():
        where = set(ledger.stated.get(identity, {}))
        if not where:
            yield f"{LEDGER}: no page states {name!r}"
        elif where == {FRONT}:
            yield f"{LEDGER}: no page but {FRONT} states {name!r}"


def _words(
    text: str, ledger: _Ledger, covered: list[tuple[int, int, str | None]]
) -> Iterator[str]:
    """Sentences that lack the words of what they state, or state another number."""
    named = [(start, end, name) for start, end, name in covered if name]
    # What is given is no number of ours.
    stated = [(start, end, name) for start, end, name in covered if name is not None]
    measured = list(_measured(text, cells=False))
    for start, end, said in _sentences(text):
        for a, b, name in named:
            if not start <= a < end:
                continue
            lacking = _lacking(ledger.quantities[name], said)
            if lacking:
                line = _line(text, a)
                yield f":{line}: {text[a:b]!r} is {name!r}, without {lacking[0]!r}"
        inside = [(a, b) for a, b in measured if start <= a < end]
        unnamed = [s for s in inside if not _is_covered(text, *s, stated)]
        for name, entry in ledger.quantities.items():
            if unnamed and not _lacking(entry, said):
                a, b = unnamed[0]
                piece = " ".join(text[a:b].split())
                yield f":{_line(text, a)}: {piece!r} beside the words of {name!r}"


def _sentences(text: str) -> Iterator[tuple[int, int, str]]:
    """Where the sentences and the rows of a page are, and their words: those of a row
    with the head of its table."""
    head, last = "", -1
    for block in re.finditer(r"(?:[^\n\f]*\S[^\n\f]*\n?)+", text):
        begin, rows = block.start(), list(_ROW.finditer(text, *block.span()))
        for row in rows:
            if row.start() > last + 1:
                head = row.group()
            last = row.end()
            yield *row.span(), _spaced(f"{head} {row.group()}")
        if rows:
            continue
        for stop in re.finditer(
            r"[.!?:](?=\s+[A-Z`*\[(]|\s*$)|\n\s*[-*] |\Z", block.group()
        ):
            end = block.start() + stop.end()
            if text[begin:end].strip():
                yield begin, end, _spaced(text[begin:end])
            begin = end


def _lacking(quantity: dict, said: str) -> list[str]:
    """The words of a quantity that are not there."""
    find = lambda word: re.search(word, said, re.IGNORECASE)
    return [word for word in quantity["words"] if not find(word)]


def _spaced(text: str) -> str:
    return " ".join(text.split())


def _measured(text: str, *, cells: bool = True) -> Iterator[tuple[int, int]]:
    """Where the measured numbers of a page are; without `cells`, those with a unit."""
    plain = text
    for silent in _SILENT:
        plain = silent.sub(lambda m: re.sub(r"[^\n|]", " ", m.group()), plain)
    plain = _HEAD.sub(lambda m: re.sub(r"[^\n|]", " ", m.group()), plain)
    for row in _ROW.finditer(plain) if cells else ():
        for cell in re.finditer(r"[^|]+", row.group()):
            if _NUMERIC_CELL.match(cell.group()):
                start = row.start() + cell.start()
                for number in re.finditer(_NUMBER, cell.group()):
                    yield start + number.start(), start + number.end()
    for match in _MEASURED.finditer(plain):
        yield match.span()
    for start, end in _printed(text) if cells else ():
        for number in re.finditer(rf"(?<![\w.]){_NUMBER}", text[start:end]):
            yield start + number.start(), start + number.end()


def _printed(text: str) -> Iterator[tuple[int, int]]:
    """Where a page shows what the code before prints, and no test compares it. An error
    is no number, and `tests/test_docs.py` compares what is right under a block."""
    shows, before = None, 0
    for block in _FENCED.finditer(text):
        is_right_under = shows == "runs" and not text[before : block.start()].strip()
        if block["language"] == "text" and shows and not is_right_under:
            yield block.span("code")
        shows, before = None, block.end()
        if block["language"] == "python" and block["mark"] != "raises":
            shows = block["mark"] or "runs"


def _claim(text: str, entry: dict, ledger: _Ledger) -> Iterator[str]:
    covered = ledger.covered[entry["page"]]
    match = pattern(entry["text"]).search(text)
    if match is None:
        yield f": no {entry['text']!r}"
        return
    if "values" not in entry:
        covered.append((*match.span(), None))
        return
    for place in entry.get("true", []):
        if _look(ledger.sources[entry["results"]], place) is not True:
            yield f": {entry['text']!r} needs {place!r} to be true"
    values = entry["values"]
    if len(values) != len(match.groups()):
        yield f": {len(values)} values for {entry['text']!r}"
        return
    for k, place in enumerate(values, 1):
        name, results = None, entry.get("results", "")
        line = _line(text, match.start(k))
        if place.startswith("@"):
            name = place[1:]
            if name not in ledger.quantities:
                yield f":{line}: no quantity {name!r}"
                continue
            results = ledger.quantities[name]["results"]
            place = ledger.quantities[name]["value"]
        elif entry["page"] == FRONT:
            yield f":{line}: {match.group(k)!r} is no quantity with a name"
        elif (known := ledger.named(results, place)) is not None:
            yield f":{line}: {match.group(k)!r} is {known!r}: write '@{known}'"
        covered.append((*match.span(k), name))
        _state(entry["page"], results, place, ledger)
        said = _differs(match.group(k), ledger.sources.get(results), place)
        if said:
            yield f":{line}: {said}"


def _state(page: str, results: str, place: str, ledger: _Ledger) -> None:
    """Note that a page states what is at a place."""
    if not re.fullmatch(_NUMBER, place):
        where = ledger.stated.setdefault(ledger.identity(results, place), {})
        where.setdefault(page, place)


def _table(text: str, entry: dict, ledger: _Ledger) -> Iterator[str]:
    covered = ledger.covered[entry["page"]]
    source = ledger.sources.get(entry.get("results", ""))
    found = pattern(entry["after"]).search(text)
    start = found.end() if found else len(text)
    line = text.rfind("\n", 0, start) + 1
    rows = list(_ROW.finditer(text, line if text[line:].startswith("|") else start))
    if not rows:
        yield f": no table after {entry['after']!r}"
        return
    last, head = rows[0].start(), _cells(rows[0].group())
    for number, row in enumerate(rows):
        if text[last : row.start()].strip(" \n") or row.start() - last > 1:
            break
        last = row.end()
        covered.append((*row.span(), None))
        if number < 2:
            continue
        line = _line(text, row.start())
        cells = _cells(row.group())
        if "columns" not in entry:
            continue
        if len(cells) != len(entry["columns"]):
            yield f":{line}: {len(entry['columns'])} columns in {LEDGER}"
            continue
        label = re.sub(r"[`*]", "", cells[0])
        label = entry.get("rows", {}).get(label, label)
        for title, cell, places in zip(head, cells, entry["columns"], strict=True):
            names = {"{}": label, "{2}": cells[1]}
            places = [places] if isinstance(places, str) else places
            places = [_filled(place, names) for place in places if place]
            is_number = lambda place: isinstance(_look(source, place), int | float)
            places_of_numbers = [place for place in places if is_number(place)]
            for place in places_of_numbers:
                _state(entry["page"], entry["results"], place, ledger)
            for name in _other(f"{title} {cells[0]}", entry, places_of_numbers, ledger):
                yield f":{line}: {cell!r} beside the words of {name!r}"
            for said in _cell(cell, places, source):
                yield f":{line}: {said}"


def _other(
    words: str, entry: dict, places: list[str], ledger: _Ledger
) -> Iterator[str]:
    """The quantities whose words a cell has, and which it does not state."""
    here = {ledger.identity(entry["results"], place) for place in places}
    for name, known in ledger.quantities.items():
        if here and not _lacking(known, words):
            if ledger.identity(known["results"], known["value"]) not in here:
                yield name


def _cells(row: str) -> list[str]:
    return [cell.strip() for cell in row.strip(" ")[1:-1].split("|")]


def _filled(place: str, names: dict[str, str]) -> str:
    for mark, name in names.items():
        place = place.replace(mark, name)
    return place


def _cell(cell: str, places: list[str], source: Any) -> Iterator[str]:
    """Compare the numbers, or the text, of one cell."""
    printed = re.findall(_NUMBER, cell)
    if not places:
        return
    if len(places) == 1 and (not printed or isinstance(_look(source, places[0]), str)):
        value = _look(source, places[0])
        missing = value is None or (isinstance(value, float) and not value < math.inf)
        same = value in cell if isinstance(value, str) else missing
        if not same:
            yield f"{cell!r}, but {places[0]!r} is {value!r}"
        return
    if len(printed) > len(places):
        yield f"{len(places)} places in the ledger for {cell!r}"
        return
    for number, place in zip(printed, places, strict=False):
        said = _differs(number, source, place)
        if said:
            yield said


def _given(text: str, entry: dict, ledger: _Ledger) -> Iterator[str]:
    for part in entry["texts"]:
        matches = list(pattern(part).finditer(text))
        if not matches:
            yield f": no {part!r}"
        ledger.covered[entry["page"]] += [(*match.span(), "") for match in matches]


def _origin(root: Path, entry: dict, ledger: _Ledger) -> Iterator[str]:
    """Check the command or the test, and read the results."""
    sources = ledger.sources
    what = entry.get("text") or entry.get("after") or entry.get("name")
    values = entry.get("values")
    if values and "results" not in entry and all(v.startswith("@") for v in values):
        return
    if "test" in entry:
        path, _, name = entry["test"].partition("::")
        file = root / path
        if not file.is_file() or f"def {name}(" not in file.read_text(encoding="utf-8"):
            yield f"{LEDGER}: no test {entry['test']!r}"
    if not _is_command(root, entry.get("command", "")) and "test" not in entry:
        yield f"{LEDGER}: {what!r} has no command that is there"
    name = entry.get("results")
    if name is None:
        if "test" not in entry:
            yield f"{LEDGER}: {what!r} has neither results nor a test"
        return
    if name in sources:
        return
    file = root / name
    if not file.is_file():
        yield f"{LEDGER}: no file {name!r}"
        sources[name] = None
        return
    content = file.read_text(encoding="utf-8")
    if name.endswith(".jsonl"):
        lines = [json.loads(line) for line in content.splitlines()]
        # A case that was run again counts as it was last.
        cases = {line["case"]: line for line in lines if line.get("kind") == "case"}
        runs = {line["run"]: line for line in lines if line.get("kind") == "run"}
        used = {case["run"] for case in cases.values()}
        sources[name] = [*cases.values(), *(runs[run] for run in sorted(used))]
    else:
        sources[name] = json.loads(content)
    project = tomllib.loads((root / "pyproject.toml").read_text(encoding="utf-8"))
    now = project["project"]["version"]
    made = set(_versions(sources[name]))
    if not made:
        yield f"{name}: no version of delucax"
    for version in sorted(made):
        if _minor(version) < _minor(now):
            yield f"{name}: made by delucax {version}, and this is {now}"


def _is_command(root: Path, command: str) -> bool:
    words = command.split()
    if words[:2] == ["python", "-m"] and len(words) > 2:
        path = root.joinpath(*words[2].split("."))
        if words[2] == "delucax":
            return (root / "src" / "delucax" / "__main__.py").is_file()
        return path.with_suffix(".py").is_file() or (path / "__main__.py").is_file()
    if words[:1] == ["make"] and len(words) > 1:
        makefile = (root / "Makefile").read_text(encoding="utf-8")
        return (
            re.search(rf"^{re.escape(words[1])}:", makefile, re.MULTILINE) is not None
        )
    return words[:1] == ["python"] and len(words) > 1 and (root / words[1]).is_file()


def _versions(content: Any) -> Iterator[str]:
    if isinstance(content, dict):
        versions = content.get("versions")
        if isinstance(versions, dict) and versions.get("delucax"):
            yield versions["delucax"]
        content = list(content.values())
    if isinstance(content, list):
        for value in content:
            yield from _versions(value)


def _minor(version: str) -> tuple[int, int]:
    major, minor = version.split(".")[:2]
    return int(major), int(minor)


def _look(source: Any, place: str) -> Any:
    """What stands at a place of the results; `None` where nothing does."""
    if re.fullmatch(_NUMBER, place):
        return float(place)
    takes = "|".join(_TAKES)
    parts = re.fullmatch(rf"(?:({takes}) of )?(.*?)(?: \* ([-\d.e+]+))?", place)
    assert parts is not None
    take, path, factor = parts.groups()
    found = [source]
    for step in path.split(" > "):
        pairs = [pair.partition("=") for pair in step.split(" & ")]
        wanted = [(key, text) for key, _, text in pairs]
        following = []
        for value in found:
            if isinstance(value, list) and all(text for _, text in wanted):
                members = [m for m in value if isinstance(m, dict)]
                following += [m for m in members if _has(m, wanted)]
            elif isinstance(value, list) and step.isdigit():
                following += value[int(step) : int(step) + 1]
            elif isinstance(value, list):
                following += [m[step] for m in value if _holds(m, step)]
            elif _holds(value, step):
                following.append(value[step])
        found = following
    if take is not None:
        spread = [v for f in found for v in (f if isinstance(f, list) else [f])]
        spread = [v for v in spread if v is not None and v == v]
        found = [_TAKES[take](spread)] if spread else []
    if len(found) > 1:
        raise ValueError(f"{LEDGER}: {place!r} is {len(found)} numbers, not one.")
    value = found[0] if found else None
    if isinstance(value, int | float) and factor is not None:
        return value * float(factor)
    return value


def _holds(value: Any, key: str) -> bool:
    return isinstance(value, dict) and key in value


def _has(member: dict, wanted: list[tuple[str, str]]) -> bool:
    """Whether a member has these values; `a.b` is the key `b` of what `a` holds."""
    for key, text in wanted:
        value: Any = member
        for part in [key] if key in member else key.split("."):
            value = value.get(part) if isinstance(value, dict) else None
        if str(value) != text:
            return False
    return True


def _interquartile_mean(values: list[float]) -> float:
    cut = len(values) // 4
    return statistics.fmean(sorted(values)[cut : len(values) - cut])


_TAKES = {
    "first": operator.itemgetter(0),
    "min": min,
    "max": max,
    "sum": sum,
    "median": statistics.median,
    "mean": statistics.fmean,
    "iqm": _interquartile_mean,
    "count": len,
}


def _differs(printed: str, source: Any, place: str) -> str | None:
    """How a number that is printed differs from that of the results, if it does."""
    bound = place[:2] if place[:3] in ("<= ", ">= ") else ""
    value = _look(source, place.removeprefix(bound).lstrip())
    if not isinstance(value, int | float) or not math.isfinite(value):
        return f"{printed!r}, but {place!r} is {value!r}"
    number = float(printed.replace(",", "").replace("−", "-"))
    if abs(number - value) <= _half_a_digit(printed) * (1 + 1e-6):
        return None
    if (bound == "<=" and value < number) or (bound == ">=" and value > number):
        return None
    return f"{printed!r}, but {place!r} is {value:.6g}"


def _half_a_digit(printed: str) -> float:
    """Half of the last digit that is printed.

    Zeros at the end of a whole number are digits from the second one on: 18,000 may be
    17,953, and 200 not 247.
    """
    mantissa, _, power = printed.replace(",", "").lstrip("+-−").partition("e")
    _, _, decimals = mantissa.partition(".")
    if decimals:
        last = -len(decimals)
    else:
        zeros = len(mantissa) - len(mantissa.rstrip("0"))
        last = min(zeros, max(len(mantissa) - 2, 0))
    return 0.5 * 10.0 ** (last + int(power or 0))


def pattern(text: str) -> re.Pattern[str]:
    """A piece of a page, wherever its lines break; `{}` is a number."""
    words = [re.escape(word).replace(r"\{\}", f"({_NUMBER})") for word in text.split()]
    return re.compile(r"\s+".join(words))


def _line(text: str, at: int) -> str:
    if _CELL_END in text:
        return f"cell {text.count(_CELL_END, 0, at) + 1}"
    return str(text.count("\n", 0, at) + 1)


if __name__ == "__main__":
    wrong = problems()
    print("\n".join(wrong) or "every measured number has its origin")
    sys.exit(bool(wrong))
