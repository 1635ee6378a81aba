"""`python -m benchmarks.paper`: the studies of the Deluca paper, as the docs show them.

Runs `python -m delucax reproduce all` into a folder, and writes
`benchmarks/results/paper.json`, the table of `docs/paper.md` and its figures. A folder
that holds all claims already is taken as it is; `--page` writes the table from what is
stored.
"""

import argparse
import csv
import json
import shutil
from pathlib import Path
from typing import Any

from benchmarks._machine import compile_anew, describe
from delucax import studies
from delucax.studies.paper._reproduce import STUDIES


RESULTS = Path(__file__).parent / "results" / "paper.json"
DOCS = Path(__file__).parents[1] / "docs"
PAGE, FIGURES = DOCS / "paper.md", DOCS / "assets" / "paper"
# By study and by the end of the claim: what another benchmark measures with more seeds
# or runs. The page has one number for a thing, and it stands there.
ELSEWHERE = {
    ("wall-clock", "in one chain"): (
        "[the wall-clock table](benchmarks.md#the-wall-clock-table-of-the-deluca-paper)"
    ),
    ("ventilator", ""): "[with 20 seeds](ventilator_results.md#limits)",
}
BEGIN, END = "<!-- table: claims -->\n", "<!-- end: claims -->"


def table(claims: list[dict[str, Any]]) -> str:
    """The claims, as Markdown."""
    lines = ["| study | claim | measured | holds |", "|---|---|---|---|"]
    for row in claims:
        cells = row["study"], row["claim"], _measured(row)
        words = " | ".join(cell.replace("|", "\\|") for cell in cells)
        lines.append(f"| {words} | {'yes' if row['holds'] else '**no**'} |")
    return "\n".join(lines) + "\n"


def _measured(row: dict[str, Any]) -> str:
    for (study, end), place in ELSEWHERE.items():
        if row["study"] == study and row["claim"].endswith(end):
            return place
    return row["measured"]


def read(path: Path) -> list[dict[str, Any]]:
    """The claims of a folder, none if there is no such file."""
    if not path.exists():
        return []
    with open(path, newline="") as file:
        return [row | {"holds": row["holds"] == "True"} for row in csv.DictReader(file)]


def write_page(claims: list[dict[str, Any]]) -> None:
    """Put the table between its marks."""
    before, _, rest = PAGE.read_text(encoding="utf-8").partition(BEGIN)
    _, _, after = rest.partition(END)
    text = f"{before}{BEGIN}\n{table(claims)}\n{END}{after}"
    PAGE.write_text(text, encoding="utf-8")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--out", default="build/paper", help="folder of the studies")
    parser.add_argument("--study", choices=STUDIES, help="one study alone, again")
    parser.add_argument("--page", action="store_true", help="from what is stored")
    options = parser.parse_args()
    if not options.page:
        compile_anew()
        out = Path(options.out)
        rows = read(out / "claims.csv")
        if {row["study"] for row in rows} != set(STUDIES):
            rows = studies.reproduce("all", out)
        elif options.study is not None:
            again = studies.reproduce(options.study, out / "again")
            rows = [row for row in rows if row["study"] != options.study] + again
            rows.sort(key=lambda row: list(STUDIES).index(row["study"]))
        content = {"machine": describe(), "claims": rows}
        RESULTS.write_text(json.dumps(content, indent=1) + "\n")
        FIGURES.mkdir(parents=True, exist_ok=True)
        for figure in out.glob("*.png"):
            shutil.copy(figure, FIGURES / figure.name)
    write_page(json.loads(RESULTS.read_text())["claims"])


if __name__ == "__main__":
    main()
