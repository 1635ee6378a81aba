"""`python -m benchmarks.compilation`: how long the first answer takes, and why.

Each case of `_first_answers.py` runs in a process of its own, as a user would: with
default flags and, unless `--x64`, in single precision. Imports are timed apart, and no
compiled program is taken from disk. Prints the wait, the seconds that JAX traced,
lowered and compiled, the number of programs and the operations in them, beside the
peers; with `--cache` also the wait of a second process that finds the programs of the
first on disk, and how many it did not find. Writes
`benchmarks/results/compilation.json`.
"""

import argparse
import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from benchmarks._first_answers import CASES


OUT = Path(__file__).parent / "results" / "compilation.json"
# What a second process may wait, and what of that for XLA, as parts of the first's.
WAIT, COMPILED = 0.6, 0.2
STAGES = {
    "/jax/core/compile/jaxpr_trace_duration": "trace",
    "/jax/core/compile/jaxpr_to_mlir_module_duration": "lower",
    "/jax/core/compile/backend_compile_duration": "compile",
}


def operations(jaxpr: Any) -> int:
    """The operations of a program, those of nested ones included."""
    import jax

    total = 0
    for equation in jaxpr.eqns:
        total += 1
        for value in equation.params.values():
            for leaf in jax.tree.leaves(value, is_leaf=lambda v: hasattr(v, "eqns")):
                inner = getattr(leaf, "jaxpr", leaf)
                if hasattr(inner, "eqns"):
                    total += operations(inner)
    return total


def answer(name: str) -> dict[str, Any]:
    """Run one case in this process."""
    start = time.perf_counter()
    thunks = CASES[name].prepare()
    if "delucax" in sys.modules:
        # The core is imported at first use, which is timed apart.
        from delucax import make, math, rollout, simulate  # noqa: F401
    row: dict[str, Any] = {"case": name, "prepare": time.perf_counter() - start}
    spent = dict.fromkeys(STAGES.values(), 0.0)
    programs = on_disk = 0
    if "jax" in sys.modules:
        import jax

        def heard(event: str, seconds: float, **_: Any) -> None:
            nonlocal programs
            if event in STAGES:
                spent[STAGES[event]] += seconds
                programs += STAGES[event] == "compile"

        def hit(event: str, **_: Any) -> None:
            nonlocal on_disk
            on_disk += event == "/jax/compilation_cache/cache_hits"

        jax.monitoring.register_event_duration_secs_listener(heard)
        jax.monitoring.register_event_listener(hit)
        wait = jax.block_until_ready
    else:
        wait = lambda value: value
    waits = []
    for k, thunk in enumerate(thunks):
        start = time.perf_counter()
        wait(thunk())
        waits.append(time.perf_counter() - start)
        if k == 0:
            row |= {"first": waits[0], **spent, "programs": programs}
            row["on disk"] = on_disk
    start = time.perf_counter()
    wait(thunks[0]())
    row["again"] = time.perf_counter() - start
    if waits[1:]:
        row["further"] = max(waits[1:])
    if "equinox" in sys.modules and "delucax" in sys.modules:
        import equinox as eqx

        try:
            jaxpr = eqx.filter_make_jaxpr(thunks[0])()[0]
            row["operations"] = operations(jaxpr.jaxpr)
        except Exception:  # not to be traced, as what reads numbers
            row["operations"] = None
    return row


def in_a_process(name: str, **variables: str) -> dict[str, Any]:
    """Run one case in a fresh process."""
    command = [sys.executable, "-m", "benchmarks.compilation", "--answer", name]
    environment = os.environ | variables
    run = subprocess.run(command, env=environment, capture_output=True, text=True)
    if run.returncode:
        return {"case": name, "error": run.stderr.strip().splitlines()[-1:]}
    return json.loads(run.stdout.strip().splitlines()[-1])


def median(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """Of the numbers of several runs."""
    good = [row for row in rows if "error" not in row]
    if not good:
        return rows[0]
    number = lambda value: isinstance(value, float)
    return {
        key: statistics.median(row[key] for row in good) if number(value) else value
        for key, value in good[0].items()
    }


def import_times(rounds: int) -> list[dict[str, Any]]:
    """Seconds of the imports, in turns."""
    # The core, as names are imported at first use.
    statements = {
        "import delucax": "from delucax import make, math, rollout, simulate",
        "import diffrax, optax, lineax": "import diffrax, optax, lineax",
    }
    taken: dict[str, list[float]] = {name: [] for name in statements}
    # Installed packages have their bytecode. The first round writes what is missing.
    variables = {k: v for k, v in os.environ.items() if k != "PYTHONDONTWRITEBYTECODE"}
    for _ in range(rounds + 1):
        for name, statement in statements.items():
            code = (
                "import time; t = time.perf_counter(); "
                f"{statement}; print(time.perf_counter() - t)"
            )
            command = [sys.executable, "-c", code]
            run = subprocess.run(command, env=variables, capture_output=True)
            taken[name].append(float(run.stdout))
    return [
        {"case": name, "first": statistics.median(seconds[1:])}
        for name, seconds in taken.items()
    ]


COLUMNS = (
    "first trace lower compile further again programs operations limit peer ratio"
).split()


def print_line(*cells: str) -> None:
    """Print a line at once, also where the output is no terminal."""
    name, *rest = cells
    print(f"{name:44s}" + "".join(f"{cell:>11s}" for cell in rest), flush=True)


def show(row: dict[str, Any]) -> None:
    """Print a row."""
    if "error" in row:
        print_line(row["case"], f" {row['error']}")
        return
    cells = map(row.get, COLUMNS)
    number = lambda c: f"{c:.3f}" if isinstance(c, float) else str(c)
    print_line(row["case"], *("" if c is None else number(c) for c in cells))


def with_cache(name: str, variables: dict[str, str], rounds: int) -> dict[str, Any]:
    """The waits of a process that finds nothing on disk, and of the one after it."""
    pairs = []
    for _ in range(rounds):
        with tempfile.TemporaryDirectory() as folder:
            kept = variables | {
                "JAX_ENABLE_COMPILATION_CACHE": "true",
                "JAX_COMPILATION_CACHE_DIR": folder,
                "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",
            }
            pairs.append([in_a_process(name, **kept) for _ in range(2)])
    before, after = (median(list(rows)) for rows in zip(*pairs, strict=True))
    if "error" in before or "error" in after:
        return {}
    return {
        "cache": {
            "wait": [before["first"], after["first"]],
            "compile": [before["compile"], after["compile"]],
            "not found": after["programs"] - after["on disk"],
        }
    }


def show_cache(row: dict[str, Any]) -> None:
    """Print a row of the waits without and with programs on disk."""
    if cache := row.get("cache"):
        cells = []
        for before, after in (cache["wait"], cache["compile"]):
            cells += [before, after, after / before]
        shown = (f"{cell:.3f}" for cell in cells)
        print_line(row["case"], *shown, str(cache["not found"]))


def main() -> None:
    """Run, print and write."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.compilation")
    parser.add_argument("--answer", help=argparse.SUPPRESS)
    parser.add_argument("--cases", nargs="*", help="only those that contain a word")
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--x64", action="store_true", help="in double precision")
    parser.add_argument("--cache", action="store_true", help="a second process, too")
    parser.add_argument("--out", help="file to write")
    options = parser.parse_args()
    if options.out and Path(options.out).is_dir():
        parser.error(f"--out must be a file, got the folder {options.out}.")
    if options.answer:
        print(json.dumps(answer(options.answer)))
        return
    chosen = [
        name
        for name in CASES
        if not options.cases or any(word in name for word in options.cases)
    ]
    # A peer comes before the first case that is compared with it.
    pairs = ((CASES[name].peer, name) for name in chosen)
    names = [name for name in dict.fromkeys(sum(pairs, ())) if name in chosen]
    variables = {
        "JAX_ENABLE_X64": "1" if options.x64 else "0",
        "JAX_ENABLE_COMPILATION_CACHE": "false",
    }
    print_line("case", *COLUMNS)
    rows = [] if options.cases else import_times(2 * options.rounds + 1)
    for row in rows:
        show(row)
    measured: dict[str, dict[str, Any]] = {}
    for name in names:
        runs = [in_a_process(name, **variables) for _ in range(options.rounds)]
        row, case = median(runs), CASES[name]
        row["limit"] = case.limit
        peer = measured.get(case.peer or "", {})
        if "first" in row and "first" in peer:
            row["peer"], row["ratio"] = peer["first"], row["first"] / peer["first"]
        measured[name] = row
        show(row)
    rows += measured.values()
    if options.cache:
        print("\nA second process, with the programs of the first on disk: limits are")
        print(f"{WAIT} of the wait, and {COMPILED} of what XLA took")
        print_line("case", *"wait then ratio compile then ratio not-found".split())
        for name, row in measured.items():
            if row.get("programs"):
                row |= with_cache(name, variables, options.rounds)
                show_cache(row)
    if options.out or not options.cases:
        from benchmarks._machine import describe

        out = Path(options.out or OUT)
        content = {"machine": describe(), "x64": options.x64, "cases": rows}
        out.write_text(json.dumps(content, indent=1) + "\n")
        print(f"\nwritten: {out}")


if __name__ == "__main__":
    main()
