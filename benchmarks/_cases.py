"""Cases that are processes of their own, stored row by row.

So the seconds of each have all compilation in them, a run that is cut off goes on where
it was, and one that fails costs no other. A module of cases ends with `answer(case)`.
"""

import json
import os
import subprocess
import sys
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import as_completed, ThreadPoolExecutor
from pathlib import Path
from typing import Any

from benchmarks._machine import describe


RESULTS = Path(__file__).parent / "results"
Row = dict[str, Any]
CORES = os.sched_getaffinity(0) if hasattr(os, "sched_getaffinity") else None
"""Those that this process began with: a benchmark may keep itself on fewer."""


def answer(case: Callable[..., Row]) -> None:
    """Print what a case gives, and on what: the other side of `run`."""
    given = case(**json.loads(sys.argv[1]))
    print(json.dumps(given | {"machine": describe()}))


def stored(store: Path) -> list[Row]:
    """The rows so far."""
    lines = store.read_text().splitlines() if store.exists() else []
    return [json.loads(line) for line in lines]


def forget(store: Path, **which: Any) -> None:
    """Take the rows with these values out of the store."""
    kept = [row for row in stored(store) if not _of(which, [row])]
    store.write_text("".join(json.dumps(row) + "\n" for row in kept))


def run(
    module: str,
    store: Path,
    cases: Iterable[Row],
    said: Callable[[Row], str],
    at_once: int = 1,
    fresh: bool = False,
) -> list[Row]:
    """The rows of these cases, those that are missing run first, and each said. With
    `fresh` all are run again."""
    cases = list(cases)
    for case in cases if fresh else ():
        forget(store, **case)
    rows = stored(store)
    missing = [case for case in cases if not _of(case, rows)]
    with ThreadPoolExecutor(at_once, initializer=_on_all_cores) as pool:
        running = {pool.submit(_row, module, case): case for case in missing}
        for future in as_completed(running):
            name = ", ".join(str(value) for value in running[future].values())
            row = future.result()
            if isinstance(row, str):
                print(f"  {name}: {row}", flush=True)
                continue
            rows.append(row)
            with store.open("a") as file:
                file.write(json.dumps(row) + "\n")
            print(f"  {name}: {said(row)}", flush=True)
    return [row for case in cases for row in _of(case, rows)]


def _of(case: Row, rows: Sequence[Row]) -> list[Row]:
    """The rows of a case: one, or none."""
    return [row for row in rows if all(row.get(k) == v for k, v in case.items())][-1:]


def _on_all_cores() -> None:
    """The cases that this thread starts have all cores, as for a user."""
    if CORES is not None:
        os.sched_setaffinity(0, CORES)


def _row(module: str, case: Row) -> Row | str:
    """The row of a case, or the last words of one that failed."""
    command = [sys.executable, "-m", module, json.dumps(case)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        return (done.stderr.strip().splitlines() or ["it said nothing"])[-1]
    return case | json.loads(done.stdout.splitlines()[-1])
