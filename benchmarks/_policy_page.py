"""The tables of `docs/policy_results.md` that come from `results/policies.json`."""

import json
import math
from pathlib import Path
from typing import Any

from benchmarks._ablation import ALL, cell, WITHOUT
from benchmarks._page import DOCS, markdown, write_page
from benchmarks._synthesis import hard


PAGE = DOCS / "policy_results.md"
LAWS = {
    "zero": "no control",
    "LQR": "nominal LQR",
    "LQR of each plant": "LQR of each plant",
    "LQR of each plant, cart let run": "LQR of each plant, weights of the cart / 100",
    "MPC of each plant": "MPC of each plant",
    "MPC of each plant, 80 steps": "MPC of each plant, 80 steps",
    "plan of each plant": "plan of each plant",
    "synthesise": "`synthesise`",
    "network": "nominal LQR + network",
    "memory": "nominal LQR + memory",
}


def write(results: Path) -> None:
    """Put the tables into the page."""
    content = json.loads(results.read_text())
    tables = {
        "tasks": tasks(content["tasks"]["rows"]),
        "parts of the search": parts(content["ablation"]["rows"]),
        "family": family(content["family"]["rows"]),
        "rivals": rivals(content["rivals"]["rows"]),
    }
    write_page(PAGE, tables)


def tasks(rows: list[dict[str, Any]]) -> str:
    """A row for each task: the usual ones, the harder ones, those with events."""
    head = [
        "task",
        "policy",
        "above the best, %",
        "worst seed, %",
        "against the scoreboard, %",
    ]
    kinds = ["usual", "hard", "events"]
    body = [
        [f"`{row['task']}`", row["policy"]]
        + [percent(row[k]) for k in ("above best", "worst seed", "beside all")]
        for row in sorted(rows, key=lambda row: (kinds.index(row["kind"]), row["task"]))
    ]
    assert sum(row["kind"] == "hard" for row in rows) == len(hard())
    return markdown(head, body, 2)


def parts(rows: list[dict[str, Any]]) -> str:
    """A row for each task, a column for each part that is left out."""
    named = {ALL: "whole search"}
    columns = [name for name in WITHOUT if name in rows[0]]
    body = [
        [f"`{row['task']}`", *(cell(row, name, percent) for name in columns)]
        for row in rows
    ]
    return markdown(["task", *(named.get(n, n) for n in columns)], body, 1)


def family(rows: list[dict[str, Any]]) -> str:
    """A row for each law."""
    by_law = {row["law"]: row for row in rows}
    head = ["law", "fails, %", "worst seed, %", "above MPC, points", "median cost"]
    body = []
    for law, name in LAWS.items():
        row = by_law.get(law)
        if row is None:
            continue
        more = f"{number(row['above MPC'])} ± {number(row['+-'])}"
        more = "-" if law == "MPC of each plant" else more
        numbers = [number(row[k]) for k in ("fails, %", "worst seed")]
        body.append([name, *numbers, more, number(row["median cost"])])
    return markdown(head, body, 1)


def rivals(rows: list[dict[str, Any]]) -> str:
    """A row for each task and method."""
    apart = "`synthesise` less the method, range over pairs of seeds"
    body = []
    for row in rows:
        ends = f"[{number(row['low'])}, {number(row['high'])}]"
        less = f"{number(row['ours less theirs'])} {ends}"
        is_ours = row["method"] == "synthesise"
        costs = [str(row["seeds"]), number(row["cost"]), number(row["worst seed"])]
        body.append([row["task"], row["method"], *costs, "-" if is_ours else less])
    return markdown(["task", "method", "seeds", "cost", "worst seed", apart], body, 2)


def percent(share: float | None) -> str:
    """A share in percent, or a dash."""
    if share is None or math.isnan(share):
        return "-"
    return number(100 * share)


def number(value: float) -> str:
    """With one decimal, and above 1,000 with four digits and commas."""
    if abs(value) < 1000:
        return f"{value:.1f}"
    return f"{float(f'{value:.4g}'):,.0f}"
