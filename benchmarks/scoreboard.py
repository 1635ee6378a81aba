"""Every task crossed with the controllers that suit it.

`python -m benchmarks.scoreboard` runs what is missing or changed, writes
`results/scoreboard.jsonl`, and puts the tables into `docs/scoreboard.md` and draws its
picture; with `--table` it only does the latter, with `--fresh` it runs all, and with
`-k "SQP or RTI"` a selection. The column of `synthesise` is from
`python -m benchmarks.policies --part tasks`.
"""

import argparse
import sys
import time
from collections.abc import Callable, Iterable
from pathlib import Path

import jax
import numpy as np

from benchmarks._machine import describe, keep_programs
from benchmarks._page import DOCS, markdown, write_page
from benchmarks._score_picture import draw, score, short
from benchmarks._scores import Board, board_of, COLUMNS, NEAR, PLAN, Spread
from benchmarks._synthesis import STORE as SYNTHESISED
from delucax import experiments
from delucax.experiments import Results
from delucax.studies._scoreboard import scoreboard, TRAINED


STORE = Path(__file__).parent / "results" / "scoreboard.jsonl"
PAGE = DOCS / "scoreboard.md"
PICTURE = PAGE.parent / "assets" / "scoreboard.svg"
# Two processes side by side, as the page says of the times.
WORKERS = 2
BEST = 3
"""Controllers that the short table names for each task."""


def stored(results: Results | None = None) -> Board:
    """The board of what is stored."""
    lines = SYNTHESISED.read_text().splitlines() if SYNTHESISED.exists() else []
    return board_of(results or Results.read(STORE), lines)


def parts(board: Board) -> dict[str, str]:
    """What the page takes from the results, by the names of its marks."""
    return {
        "example of the score": example(board),
        "best of each task": best_table(board),
        "scoreboard": f"{tables(board)}\n{footer()}",
    }


def example(board: Board, plain: str = "van_der_pol", offset: str = "neural") -> str:
    """The score on a task where the cost of the best known is the unit, and on one
    where the saving is."""
    said = []
    for task, method in ((plain, "LQR"), (offset, "MPC")):
        cost = board.cost(task, method)
        assert cost is not None
        said += [_number(x) for x in (board.best(task), cost.middle)]
        said += [_number(board.cost_of_zero(task)), percent(board.excess(task, method))]
    best, cost, _, excess, best_2, cost_2, zero_2, excess_2 = said
    return (
        f"On `{plain}` the best known cost is {best} and LQR costs {cost}, so the "
        f"score of LQR is {excess}. On `{offset}` the best known cost is {best_2} and "
        f"zero control costs {zero_2}. MPC costs {cost_2} on `{offset}`, which looks "
        "nearly perfect. But MPC misses part of what the best known saves against "
        f"zero control, so the score of MPC is {excess_2}.\n"
    )


def best_table(board: Board) -> str:
    """For each task the best controllers, in a table for narrow screens."""
    body = []
    for task in board.names:
        ranked = board.ranked(task)
        (zero,) = (excess for excess, method in ranked if method == "zero")
        ranked = [(e, method) for e, method in ranked if e < zero][:BEST]
        named = [_named(board, task, method, excess) for excess, method in ranked]
        body.append([f"`{task}`", ", ".join(named) or "none better than zero control"])
    return markdown(["task", "best controllers"], body, 2)


def _named(board: Board, task: str, method: str, excess: float) -> str:
    """A controller with its score, and the range of several trainings."""
    cost, said = board.cost(task, method), f"{short(method)} {percent(excess)}"
    if cost is None or cost.count == 1:
        return said
    low, high = (score(board.above(task, end)) for end in (cost.low, cost.high))
    return f"{said} ({low} to {high})"


def tables(board: Board) -> str:
    """How often each method is near the best known, scores, costs and speed."""
    made = ["## How often a method is good\n", how_often(board)]
    made.append(
        "## Score\n\nThe table shows how much more each controller costs than the best "
        "known, in percent. The score 0 is the best.\n"
    )
    made += [_by_task(board, board.methods, board.excess, score)]
    single = [m for m in TRAINED for t in board.names if board.trainings(t, m) == 1]
    once = " A cost without brackets is from a single training." if single else ""
    made.append(
        "## Cost\n\nThe tables show the cost of an episode, as the mean "
        "over 8 initial states. If a controller was trained several times, the cost is "
        "the median of the trainings, with the lowest and the highest cost in brackets."
        f"{once}\n"
    )
    for name, family in _families(board):
        show = lambda spread: _spread(spread) if spread else ""
        made.append(f"### {name}: cost\n")
        made.append(_by_task(board, family, board.cost, show, best=True))
    made.append(
        "## Time\n\nThe tables show the microseconds per step for each member of a "
        "batch of 8, for the plant and the controller together. Two processes ran at "
        "the same time, on the two threads of one core.\n"
    )
    timed = {method for _, method in board.speeds}
    for name, family in _families(board):
        family = [method for method in family if method in timed]
        took = lambda task, method: board.speeds.get((task, method))
        show = lambda speed: _number(speed, 3) if speed else ""
        made += [f"### {name}: time\n", _by_task(board, family, took, show)]
    return "\n".join(made)


def how_often(board: Board) -> str:
    """On how many tasks each method is how near."""
    body = []
    for method in board.methods:
        each = [e for t in board.names if (e := board.excess(t, method)) is not None]
        counts = [sum(e <= limit for e in each) for limit in (0.01, NEAR, 0.25)]
        row = [short(method), len(each), *counts, percent(float(np.median(each)))]
        body.append([*map(str, row)])
    near = [f"within {limit}%" for limit in (1, round(100 * NEAR), 25)]
    return markdown(["", "tasks", *near, "median"], body, 1)


def _families(board: Board) -> Iterable[tuple[str, list[str]]]:
    for name, family in COLUMNS.items():
        yield name, [method for method in family if method in board.methods]


def _by_task(
    board: Board,
    methods: Iterable[str],
    of: Callable,
    show: Callable,
    best: bool = False,
) -> str:
    """A table with a row for each task that one of the methods suits, and with `best`
    the plan and the best known at its end."""
    body = []
    for task in board.names:
        values = [of(task, method) for method in methods]
        if all(value is None for value in values):
            continue
        row = [f"`{task}`", *map(show, values)]
        if best:
            row += [_plan(board, task), _number(board.best(task))]
        body.append(row)
    ends = ["plan", "best known"] if best else []
    return markdown(["task", *map(short, methods), *ends], body, 1)


def _plan(board: Board, task: str) -> str:
    cost = board.cost(task, PLAN)
    if cost is None:
        return ""
    mark = " (clairvoyant)" if task in board.disturbed else ""
    return f"{_number(cost.middle)}{mark}"


def percent(excess: float | None) -> str:
    """With its sign and unit, for sentences."""
    assert excess is not None
    said = score(excess)
    return said if said == "diverges" else f"{said}%" if said[0] == ">" else f"+{said}%"


def footer() -> str:
    """What it was measured with; not all on one machine."""
    machine = describe()
    version = machine["versions"]
    return (
        f"Float32, on CPUs of several machines, delucax {version['delucax']}, JAX "
        f"{version['jax']}."
    )


def _spread(cost: Spread) -> str:
    middle, low, high = map(_number, cost[:3])
    return middle if cost.count == 1 else f"{middle} ({low} to {high})"


def _number(value: float, digits: int = 4) -> str:
    if not np.isfinite(value):
        return "diverges"
    return f"{value:.{digits}g}" if abs(value) < 1e5 else f"{value:.1e}"


def main(arguments: list[str] | None = None) -> int:
    """Run what is missing and write the page."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.scoreboard")
    parser.add_argument("--table", action="store_true", help="from what is stored")
    parser.add_argument("--fresh", action="store_true", help="run all again")
    parser.add_argument("-k", default="", metavar="CASES", help="a selection")
    options = parser.parse_args(arguments)
    keep_programs()
    begin = time.perf_counter()
    if not options.table:
        experiments.run(
            scoreboard,
            store=STORE,
            workers=WORKERS,
            select=options.k,
            fresh=options.fresh,
        )
    # With what was stored before.
    results = Results.read(STORE)
    for row in {row["case"]: row for row in results.failed}.values():
        print(f"FAILED {row['case']}: {row['error'].splitlines()[0]}", file=sys.stderr)
    board = stored(results)
    made = parts(board)
    print("\n".join(made.values()))
    write_page(PAGE, made)
    draw(board, PICTURE)
    print(f"{time.perf_counter() - begin:.0f} s on {jax.devices()[0].device_kind}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
