"""The ledger of claims catches what it is there for, and finds nothing in this tree."""

import collections
import importlib
import importlib.util
import json
import re
import tomllib
from pathlib import Path

import numpy as np
import pytest
from helpers import once


pytestmark = once

ROOT = Path(__file__).parents[1]
_spec = importlib.util.spec_from_file_location("claims", ROOT / "scripts/claims.py")
assert _spec is not None and _spec.loader is not None
claims = importlib.util.module_from_spec(_spec)
_spec.loader.exec_module(claims)

PAGE = """# A library

It is 12.3 times as fast, with 1.5 MB. Seeds take three seconds, as chosen.

Results:

| task | cost | result |
|---|---|---|
| `a` | 18,000 (17,000 to 18,900) | good |
| `b` | 0.25 (0.2 to 0.3) | - |

`10 times` in code is nothing, and so is version 3.11.
"""

LEDGER = """
[[claim]]
page = "docs/page.md"
text = "It is {} times as fast, with {} MB."
command = "python -m benchmarks.speed"
results = "benchmarks/results/speed.json"
values = ["rows > name=ours & kind=x > ratio", "max of rows > bytes * 1e-6"]

[[table]]
page = "docs/page.md"
after = "Results:"
command = "python -m benchmarks.speed"
results = "benchmarks/results/speed.json"
columns = [
    "",
    ["tasks > {} > cost", "tasks > {} > low", "tasks > {} > high"],
    "tasks > {} > result",
]

[[given]]
page = "docs/page.md"
texts = ["Seeds take three seconds"]
"""

RESULTS = {
    "machine": {"versions": {"delucax": "0.2.1"}},
    "rows": [
        {"name": "ours", "kind": "x", "ratio": 12.34, "bytes": 9e5},
        {"name": "ours", "kind": "y", "ratio": 1.0, "bytes": 1.52e6},
        {"name": "ours", "kind": "z", "ratio": 7.654321987},
    ],
    "tasks": {
        "a": {"cost": 17953.0, "low": 17044.0, "high": 18851.0, "result": "good"},
        "b": {"cost": 0.2512, "low": 0.21, "high": 0.296, "result": None},
    },
}


@pytest.fixture
def tree(tmp_path):
    """A small tree that is in order."""
    (tmp_path / "docs").mkdir()
    (tmp_path / "benchmarks/results").mkdir(parents=True)
    (tmp_path / "README.md").write_text("# A library\n")
    (tmp_path / "docs/page.md").write_text(PAGE)
    (tmp_path / "docs/claims.toml").write_text(LEDGER)
    (tmp_path / "benchmarks/speed.py").write_text("")
    (tmp_path / "benchmarks/results/speed.json").write_text(json.dumps(RESULTS))
    (tmp_path / "pyproject.toml").write_text('[project]\nversion = "0.2.0"\n')
    (tmp_path / "Makefile").write_text("all:\n")
    return tmp_path


def change(path, old, new):
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new))


def test_a_tree_in_order(tree):
    assert claims.problems(tree) == []


@pytest.mark.parametrize(
    "old, new, said",
    [
        ("12.3 times", "12.4 times", "docs/page.md:3: '12.4', but"),
        ("12.3 times", "12.30 times", "docs/page.md:3: '12.30', but"),
        ("1.5 MB", "1.6 MB", "docs/page.md:3: '1.6', but"),
        ("18,000", "17,900", "docs/page.md:9: '17,900', but"),
        ("0.2 to 0.3", "0.2 to 0.4", "docs/page.md:10: '0.4', but"),
        ("| good |", "| bad |", "docs/page.md:9: 'bad', but"),
        ("| - |", "| 7 |", "docs/page.md:10: '7', but"),
        ("0.2 to 0.3)", "0.2 to 0.3, 9)", "docs/page.md:10: 3 places"),
        ("| `b` |", "| `c` |", "docs/page.md:10: '0.25', but"),
        ("as chosen.", "as chosen, and half of 5 ms.", "docs/page.md:3: '5 ms' is not"),
        ("as chosen.", "as chosen, 20% more.", "docs/page.md:3: '20%' is not"),
        ("as chosen.", "as chosen, ten times more.", "docs/page.md:3: 'ten times' is"),
        ("as chosen.", "as chosen, 14 of 15 seeds.", "docs/page.md:3: '14 of 15' is"),
        (
            "as chosen.",
            "as chosen, a slope of 0.4.",
            "docs/page.md:3: 'slope of 0.4' is",
        ),
        ("as fast", "as quick", "docs/page.md: no 'It is {}"),
        ("as chosen.", "as chosen.\n\n| | x |\n|---|---|\n| a | 4 |\n", "'4' is not"),
    ],
)
def test_a_page_that_is_wrong(tree, old, new, said):
    change(tree / "docs/page.md", old, new)
    assert any(said in line for line in claims.problems(tree))


@pytest.mark.parametrize(
    "file, old, new, said",
    [
        (
            "pyproject.toml",
            "0.2.0",
            "0.3.0",
            "made by delucax 0.2.1, and this is 0.3.0",
        ),
        ("docs/claims.toml", "-m benchmarks.speed", "-m benchmarks.sped", "no command"),
        ("docs/claims.toml", "speed.json", "sped.json", "no file"),
        ("docs/claims.toml", "max of rows", "rows", "2 numbers, not one"),
        ("docs/claims.toml", "[[given]]", "[[gifen]]", "unknown kind"),
        ("docs/claims.toml", 'page = "docs/page.md"', 'page = "READ.md"', "no page"),
        ("benchmarks/results/speed.json", "delucax", "jax", "no version of delucax"),
        ("benchmarks/results/speed.json", "12.34", "null", "is None"),
        ("benchmarks/results/speed.json", "12.34", "NaN", "is nan"),
    ],
)
def test_an_origin_that_is_wrong(tree, file, old, new, said):
    change(tree / file, old, new)
    assert any(said in line for line in claims.problems(tree))


def test_the_markdown_of_a_notebook_is_a_page(tree):
    """A number is found by its cell; code and what it prints are not read."""
    printed = {"output_type": "stream", "name": "stdout", "text": "It takes 5 ms."}
    cells = [
        {"cell_type": "markdown", "source": ["# Speed\n", "\n", "It is fast."]},
        {"cell_type": "code", "source": ["# 4 times"], "outputs": [printed]},
        {"cell_type": "markdown", "source": ["In all,\n", "it takes 3 ms."]},
        {"cell_type": "markdown", "source": "A slope of 0.4, a price of $1."},
        {"cell_type": "markdown", "source": "| | x |\n|---|---|\n| a | 7 |\n\nIn $."},
    ]
    (tree / "notebooks").mkdir()
    (tree / "notebooks/speed.ipynb").write_text(json.dumps({"cells": cells}))
    assert claims.problems(tree) == [
        "notebooks/speed.ipynb:cell 5: '7' is not in docs/claims.toml",
        "notebooks/speed.ipynb:cell 3: '3 ms' is not in docs/claims.toml",
        "notebooks/speed.ipynb:cell 4: 'slope of 0.4' is not in docs/claims.toml",
    ]
    page = 'page = "notebooks/speed.ipynb"'
    made = 'command = "python -m benchmarks.speed"\nresults = '
    made += '"benchmarks/results/speed.json"\n'
    ledger = (
        f'{LEDGER}\n[[claim]]\n{page}\ntext = "it takes {{}} ms"\n{made}'
        'values = ["rows > name=ours & kind=y > ratio"]\n'
        f'\n[[given]]\n{page}\ntexts = ["slope of 0.4"]\n'
        f'\n[[table]]\n{page}\nafter = "| a"\n{made}'
    )
    (tree / "docs/claims.toml").write_text(ledger)
    (said,) = claims.problems(tree)
    assert said.startswith("notebooks/speed.ipynb:cell 3: '3', but 'rows > ")


MADE = """
command = "python -m benchmarks.speed"
results = "benchmarks/results/speed.json"
"""
NAMED = f"""
[[quantity]]
name = "speed-up"
words = ["times as fast", "(a|the) loop in C"]{MADE}
value = "rows > name=ours & kind=z > ratio"
"""
STATED = """
[[claim]]
page = "{}"
text = "is {{}} times as fast"
values = ["@speed-up"]
"""


@pytest.fixture
def stated(tree):
    """README and another page state one quantity, under its name."""
    said = "It is 7.65 times as fast as a loop in C."
    (tree / "README.md").write_text(f"# A library\n\n{said}\n")
    (tree / "docs/speed.md").write_text(f"# Speed\n\n{said}\n")
    ledger = (
        LEDGER + NAMED + STATED.format("README.md") + STATED.format("docs/speed.md")
    )
    (tree / "docs/claims.toml").write_text(ledger)
    return tree


def add(tree, text, entry):
    """A page with `text`, and its entry in the ledger."""
    (tree / "docs/late.md").write_text(f"# Later\n\n{text}\n")
    with open(tree / "docs/claims.toml", "a") as file:
        file.write(entry.replace("PAGE", 'page = "docs/late.md"'))


def test_a_quantity_with_a_name(stated):
    assert claims.problems(stated) == []


def test_a_quantity_rounds_to_fewer_digits(stated):
    change(stated / "README.md", "7.65", "7.7")
    assert claims.problems(stated) == []


@pytest.mark.parametrize(
    "file, old, new, said",
    [
        ("README.md", "7.65", "12.4", "README.md:3: '12.4', but 'rows"),
        ("README.md", "a loop in C", "fast code", "'7.65' is 'speed-up', without"),
        ("docs/speed.md", "a loop in C", "another", "'7.65' is 'speed-up', without"),
        ("docs/claims.toml", '["@speed-up"]', '["@speed"]', "no quantity 'speed'"),
        ("docs/claims.toml", 'words = ["times as fast", ', "words = [] # ", "no words"),
    ],
)
def test_a_quantity_that_is_wrong(stated, file, old, new, said):
    text = (stated / file).read_text()
    assert old in text
    (stated / file).write_text(text.replace(old, new, 1))
    assert any(said in line for line in claims.problems(stated))


def test_what_readme_states_has_a_name(stated):
    place = 'values = ["rows > name=ours & kind=z > ratio"]'
    change(stated / "docs/claims.toml", 'values = ["@speed-up"]', MADE + place)
    found = claims.problems(stated)
    assert "README.md:3: '7.65' is no quantity with a name" in found


def test_what_readme_states_stands_on_another_page(stated):
    (stated / "docs/speed.md").write_text("# Speed\n")
    ledger = LEDGER + NAMED + STATED.format("README.md")
    (stated / "docs/claims.toml").write_text(ledger)
    assert claims.problems(stated) == [
        "docs/claims.toml: no page but README.md states 'speed-up'"
    ]
    # A cell of a table will do, and so will another way to the same number.
    (stated / "docs/speed.md").write_text("| | ratio |\n|---|---|\n| ours | 7.654 |\n")
    table = f"""
[[table]]
page = "docs/speed.md"
after = "| | ratio"{MADE}
columns = ["", "first of rows > name={{}} & kind=z > ratio"]
"""
    (stated / "docs/claims.toml").write_text(ledger + table)
    assert claims.problems(stated) == []


@pytest.mark.parametrize("place", ["kind=z", "name=ours & kind=z"])
def test_what_two_pages_state_has_a_name(tree, place):
    """However its place is written."""
    here, there = "rows > 2 > ratio", f"rows > {place} > ratio"
    entry = '[[claim]]\nPAGE\ntext = "takes {} times"'
    (tree / "docs/speed.md").write_text("It takes 7.65 times as long.\n")
    first = entry.replace("PAGE", 'page = "docs/speed.md"')
    add(tree, "It takes 7.65 times as long.", f'{first}{MADE}values = ["{here}"]\n')
    add(tree, "It takes 7.65 times as long.", f'{entry}{MADE}values = ["{there}"]\n')
    assert claims.problems(tree) == [
        f"docs/claims.toml: {here!r} of docs/late.md, docs/speed.md needs a name"
    ]


def test_a_claim_uses_the_name(stated):
    entry = f'[[claim]]\nPAGE\ntext = "Fast: {{}} times."{MADE}'
    add(stated, "Fast: 7.65 times.", f'{entry}values = ["rows > kind=z > ratio"]\n')
    assert claims.problems(stated) == [
        "docs/late.md:3: '7.65' is 'speed-up': write '@speed-up'"
    ]


def test_one_quantity_has_one_name(stated):
    with open(stated / "docs/claims.toml", "a") as file:
        file.write(NAMED.replace('"speed-up"', '"ratio"'))
    found = claims.problems(stated)
    assert "docs/claims.toml: 'ratio' and 'speed-up' are one quantity" in found
    assert not any("two quantities" in line for line in found)
    with open(stated / "docs/claims.toml", "a") as file:
        file.write(NAMED)
    found = claims.problems(stated)
    assert "docs/claims.toml: two quantities 'speed-up'" in found


@pytest.mark.parametrize(
    "text, entry",
    [
        # by another benchmark
        (
            "It is 14.1 times as fast as a loop in C.",
            '[[claim]]\nPAGE\ntext = "is {} times"\n'
            'command = "python -m benchmarks.speed"\n'
            'results = "benchmarks/results/again.json"\nvalues = ["ratio"]\n',
        ),
        # as a string of a study, which a test compares with what is stored
        (
            "| it | |\n|---|---|\n| times as fast as the loop in C | 14.1 times |",
            '[[table]]\nPAGE\nafter = "| it"\ntest = "benchmarks/speed.py::test_it"\n',
        ),
        # as a bare number in a cell
        (
            "| | a loop in C |\n|---|---|\n| times as fast | 14.1 |",
            '[[table]]\nPAGE\nafter = "| |"\ncommand = "python -m benchmarks.speed"\n'
            'results = "benchmarks/results/again.json"\ncolumns = ["", "ratio"]\n',
        ),
    ],
)
def test_what_is_measured_a_second_time(stated, text, entry):
    again = {"versions": {"delucax": "0.2.0"}, "ratio": 14.1}
    (stated / "benchmarks/results/again.json").write_text(json.dumps(again))
    (stated / "benchmarks/speed.py").write_text("def test_it():\n    pass\n")
    add(stated, text, entry)
    (said,) = claims.problems(stated)
    assert said.startswith("docs/late.md:")
    assert said.endswith("beside the words of 'speed-up'")


def test_somebody_elses_number_may_stand_beside_the_words(stated):
    given = '[[given]]\nPAGE\ntexts = ["10 times as fast"]\n'
    add(stated, "They say 10 times as fast as a loop in C.", given)
    assert claims.problems(stated) == []


def test_a_number_that_a_claim_spells_out(tree):
    change(tree / "docs/claims.toml", "with {} MB", "with 1.5 MB")
    change(tree / "docs/claims.toml", ', "max of rows > bytes * 1e-6"', "")
    assert claims.problems(tree) == [
        "docs/page.md:3: '1.5 MB' is not in docs/claims.toml"
    ]


def test_what_a_page_shows_of_the_output(tree):
    shown = "```python\nprint(2.5)\n```\n\nprints\n\n```text\n2.5 of x1\n```\n"
    change(tree / "docs/page.md", "Results:", f"{shown}\nResults:")
    assert claims.problems(tree) == [
        "docs/page.md:12: '2.5' is not in docs/claims.toml"
    ]
    # The message of an error is none.
    change(tree / "docs/page.md", "```python", "<!-- raises -->\n```python")
    assert claims.problems(tree) == []


def test_output_right_under_a_block_is_compared_by_the_tests_of_the_pages(tree):
    shown = "```python\nprint(2.5)\n```\n\n```text\n2.5 of x1\n```\n"
    change(tree / "docs/page.md", "Results:", f"{shown}\nResults:")
    assert claims.problems(tree) == []
    # A block that does not run compares nothing.
    change(tree / "docs/page.md", "```python", "<!-- notest: slow -->\n```python")
    (said,) = claims.problems(tree)
    assert said.endswith("'2.5' is not in docs/claims.toml")


def test_a_patch_does_not_make_results_stale(tree):
    change(tree / "pyproject.toml", "0.2.0", "0.2.9")
    assert claims.problems(tree) == []


def test_a_claim_that_a_test_proves(tree):
    change(tree / "docs/page.md", "as chosen.", "as chosen. It takes 3 ms.")
    proven = '\n[[claim]]\npage = "docs/page.md"\ntext = "It takes {} ms."\ntest = '
    ledger = tree / "docs/claims.toml"
    ledger.write_text(LEDGER + proven + '"tests/test_speed.py::test_speed"\n')
    assert any("no test" in line for line in claims.problems(tree))
    (tree / "tests").mkdir()
    (tree / "tests/test_speed.py").write_text("def test_speed():\n    pass\n")
    assert claims.problems(tree) == []


def test_lines_of_cases(tree):
    """What was run again counts as it was last, and so does the version it ran with."""
    runs = [
        {"kind": "run", "run": run, "versions": {"delucax": version}}
        for run, version in enumerate(["0.1.0", "0.2.0"])
    ]
    cases = [
        {"kind": "case", "run": run, "case": "a", "values": {"cost": cost}}
        for run, cost in enumerate([[1.0, 1.0], [2.0, 4.0]])
    ]
    lines = [{"format": "x"}, *runs[:1], *cases[:1], *runs[1:], *cases[1:]]
    store = tree / "benchmarks/results/store.jsonl"
    store.write_text("\n".join(map(json.dumps, lines)))
    change(tree / "docs/page.md", "as chosen.", "as chosen. A run costs 3 s.")
    ledger = LEDGER + (
        '\n[[claim]]\npage = "docs/page.md"\ntext = "A run costs {} s."\n'
        'command = "python -m benchmarks.speed"\n'
        'results = "benchmarks/results/store.jsonl"\n'
        'values = ["mean of case=a > values > cost"]\n'
    )
    (tree / "docs/claims.toml").write_text(ledger)
    assert claims.problems(tree) == []
    store.write_text("\n".join(map(json.dumps, lines[:3])))
    found = claims.problems(tree)
    assert any("'3', but" in line for line in found)
    assert any("made by delucax 0.1.0" in line for line in found)


@pytest.mark.parametrize(
    "printed, half",
    [
        ("7", 0.5),
        ("0.40", 0.005),
        ("247", 0.5),
        ("200", 5),
        ("18,000", 500),
        ("18,010", 5),
        ("-4e-16", 5e-17),
        ("3.1e+09", 5e7),
    ],
)
def test_digits(printed, half):
    assert claims._half_a_digit(printed) == pytest.approx(half)


def test_this_tree():
    assert claims.problems() == []


def test_no_entry_of_this_tree_would_let_another_number_pass():
    entries = tomllib.loads((ROOT / "docs/claims.toml").read_text())
    ledger = claims._Ledger(covered=collections.defaultdict(list))
    for entry in entries["quantity"]:
        assert not list(claims._origin(ROOT, entry, ledger))
        assert not list(claims._quantity(entry, ledger))
    for entry in entries["claim"]:
        if "values" not in entry:
            continue
        assert not list(claims._origin(ROOT, entry, ledger))
        text = claims.read(ROOT, entry["page"])
        match = claims.pattern(entry["text"]).search(text)
        for k, place in enumerate(entry["values"], 1):
            if place.startswith("@"):
                place = ledger.quantities[place[1:]]["value"]
            if place.startswith(("<=", ">=")):
                continue
            printed = match.group(k).replace(",", "").replace("−", "-")
            mantissa, _, power = printed.partition("e")
            decimals = len(mantissa.partition(".")[2])
            wrong = float(printed) + 4 * claims._half_a_digit(printed)
            wrong = f"{wrong:.{decimals}{'e' if power else 'f'}}"
            altered = text[: match.start(k)] + wrong + text[match.end(k) :]
            said = list(claims._claim(altered, entry, ledger))
            assert any(repr(wrong) in line for line in said), entry["text"]


def test_the_systems_of_the_exam():
    """README says which they are, and counts them."""
    stored = json.loads((ROOT / "benchmarks/results/riccati_exam.json").read_text())
    kinds = collections.Counter(r["system"].split()[0] for r in stored["systems"])
    assert kinds == {"CAREX": 20, "DAREX": 15, "user": 4}
    results = collections.Counter(row["result"] for row in stored["systems"])
    assert results == {"stabilising": 38, "on the boundary": 1}
    assert sum(not row["SciPy"] < 1 for row in stored["systems"]) == 1  # it raises
    for page in ("README.md", "docs/benchmarks.md"):
        said = " ".join((ROOT / page).read_text().split())
        assert re.search(
            r"39 systems\W+35 of .{0,16}CAREX and DAREX\W+(and )?4 that", said
        )


def test_ventilator(monkeypatch):
    """The tables of the page are those of what is stored."""
    monkeypatch.syspath_prepend(str(ROOT))
    made = importlib.import_module("benchmarks._ventilator_page")
    stored = ROOT / "benchmarks/results/ventilator.json"
    page = (ROOT / "docs/ventilator_results.md").read_text()
    for table in made.tables(json.loads(stored.read_text())).values():
        assert table in page


def test_paper(monkeypatch):
    """The table of the page is that of what is stored."""
    monkeypatch.syspath_prepend(str(ROOT))
    made = importlib.import_module("benchmarks.paper")
    stored = json.loads(made.RESULTS.read_text())
    assert made.table(stored["claims"]) in made.PAGE.read_text()
    # What the page leaves to other commands, they find as well.
    elsewhere = [row for row in stored["claims"] if "](" in made.table([row])]
    chain, *lungs = elsewhere
    assert chain["study"] == "wall-clock" and len(lungs) == 5
    wall = json.loads((ROOT / "benchmarks/results/wall_clock.json").read_text())
    assert chain["holds"] == (wall["ratio of the means"] > 1000)
    lung = json.loads((ROOT / "benchmarks/results/ventilator.json").read_text())
    kept = [value <= lung["limits"][name] for name, value in lung["measured"].items()]
    assert all(kept) and all(row["holds"] for row in lungs)


def test_identification_exam(monkeypatch):
    """The page is that of what is stored."""
    monkeypatch.syspath_prepend(str(ROOT))
    made = importlib.import_module("benchmarks._identified.page")
    results = ROOT / "benchmarks/results/identification.json"
    assert made.written(results) == made.PAGE.read_text()


def test_scoreboard(monkeypatch):
    """The page is that of what is stored, nothing is better than the best known, and
    what the summary says is so."""
    monkeypatch.syspath_prepend(str(ROOT))
    made = importlib.import_module("benchmarks.scoreboard")
    board, page = made.stored(), (ROOT / "docs/scoreboard.md").read_text()
    assert made.example(board) in page and made.best_table(board) in page
    assert made.tables(board) in page
    # `synthesise` is timed nowhere, so the tables of times have no column of it.
    assert "synthesise" not in made.tables(board).partition("## Time")[2]
    tasks = board.names
    pairs = [(task, method) for task in tasks for method in board.methods]
    scores = [e for pair in pairs if (e := board.excess(*pair)) is not None]
    assert len(tasks) >= 31 and len(scores) > 450 and min(scores) == 0
    # A policy that beats all on every start is the best known, by a line of its own.
    own = {"task": "pendulum", "scoreboard": [1.0] * 8}
    beaten = made.board_of(made.Results.read(made.STORE), [json.dumps(own)])
    assert beaten.best("pendulum") == 1.0 < board.best("pendulum")
    assert beaten.excess("pendulum", "synthesise") == 0

    of = lambda task: [m for _, m in board.ranked(task) if m != "synthesise"]
    assert all(of(task)[0] == "GRU" for task in board.tasks["lungs"])
    assert of("pendulum")[0] == of("acrobot")[0] == "MPC"
    mpc = [e for task in tasks if (e := board.excess(task, "MPC")) is not None]
    assert sum(e <= 0.05 for e in mpc) > len(mpc) / 2
    for task in ("cartpole", "compass_gait"):
        floor = board.excess(task, "zero")
        assert board.excess(task, "MPC") >= floor
        assert max(board.excess(task, name) for name in ("CEM", "MPPI")) < floor / 2
    for task in ("mountain_car", "mountain_car_discrete"):
        assert board.excess(task, of(task)[0]) > 0.4


def test_the_score_of_the_scoreboard(monkeypatch):
    """Relative cost where the floor is far, the share of a saving where it is near."""
    monkeypatch.syspath_prepend(str(ROOT))
    made = importlib.import_module("benchmarks._scores")

    def excess(zero, cost, best):
        costs = {"zero": zero, "MPC": cost, "plan": best}
        rows = {("task", name): np.full((1, 8), c) for name, c in costs.items()}
        return made.Board(rows, {}).excess("task", "MPC")

    assert np.isclose(excess(1000.0, 103.0, 100.0), 0.03)
    assert np.isclose(excess(110.0, 103.0, 100.0), 0.3)
    # No jump where the best known saves a hundredth, or as much as it costs.
    for edge in (101.0, 200.0):
        below, above = (excess(edge + off, 103.0, 100.0) for off in (-1e-6, 1e-6))
        assert np.isclose(below, above, rtol=1e-4)
    # Rewards; what zero control does as well; and a best known of zero.
    assert np.isclose(excess(0.0, -40.0, -100.0), 0.6)
    assert np.isclose(excess(100.1, 103.0, 100.0), 3.0)
    assert np.isclose(excess(4.0, 1.0, 0.0), 0.25)
    assert excess(np.inf, np.inf, 100.0) == excess(0.0, 3.0, 0.0) == np.inf
    assert excess(np.inf, np.inf, np.inf) == np.inf and excess(0.0, 0.0, 0.0) == 0

    # With disturbances, the best single controller and not the luck of each draw.
    draws = np.array([[1.0, 3.0, 3.0, 1.0]]), np.array([[3.0, 1.0, 1.0, 4.0]])
    costs = {("task", name): c for name, c in zip(("zero", "LQR"), draws, strict=True)}
    costs["task", "plan"] = np.zeros((1, 4))
    assert made.Board(costs, {}).best("task") == 0
    board = made.Board(costs, {}, frozenset({"task"}))
    assert board.best("task") == board.cost("task", "zero").middle == 2
    # Of trainings the middle one.
    costs["task", "MLP"] = np.array([[4.0] * 4, [3.0] * 4, [np.inf] * 4])
    assert made.Board(costs, {}).cost("task", "MLP") == (4.0, 3.0, np.inf, 3)


def test_no_address_of_a_repository_is_invented():
    """delucax is installed from a checkout until it has an address."""
    kinds = ["*.md", "*.cff", "*.toml", "*.yml", "docs/**/*.md", "notebooks/*.ipynb"]
    files = [path for kind in kinds for path in ROOT.glob(kind)]
    files += [*ROOT.glob("src/**/*.py"), *ROOT.glob("docs/figures/*.py")]
    invented = re.compile(r"git clone|://[^\s\"')]*delucax|git@")
    found = [path for path in files if invented.search(path.read_text("utf-8"))]
    assert len(files) > 100 and found == []


def test_ratios_are_those_of_the_times_beside_them():
    results = ROOT / "benchmarks/results"
    pendulum = json.loads((results / "pendulum.json").read_text())
    best = {
        (row["part"], row["case"], row["contender"]): row["best ns/step"]
        for row in pendulum["timings"]
    }
    ratios = {row["ratio"]: row["measured"] for row in pendulum["ratios"]}
    for where, case, what in (
        ("chain", "one chain", "chain"),
        ("batch", "1024 lanes", "1024 lanes"),
    ):
        for kept in ("trajectory", "cost"):
            time = lambda name: best[where, f"gym, {kept}, {case}", name]  # noqa: B023, E731
            ratio = ratios[f"{what}, {kept}: delucax / by hand, jnp"]
            assert ratio == pytest.approx(time("delucax") / time("raw lax.scan"))
    tasks = json.loads((results / "environments.json").read_text())
    for row in tasks["raw"]:
        for what in ("chain, trajectory", "chain, cost", "1024 lanes"):
            ratio = row[f"{what}: ns"] / row[f"{what}: raw ns"]
            assert row[f"{what}: ratio"] == pytest.approx(ratio)
    wall = json.loads((results / "wall_clock.json").read_text())
    us, ns = (float(row["time a step"].split()[0]) for row in wall["rows"])
    assert wall["ratio of the means"] == pytest.approx(1e3 * us / ns, rel=1e-3)
