"""`python -m benchmarks.environments`: the named tasks against a raw scan, gymnax and
Gymnasium, in one run.

Prints three tables and writes `benchmarks/results/environments.json`, of which
`--table` prints those of `docs/benchmarks.md`, and the same pinned to one core in
`pinned/`. The pendulum has a command of its own,
`benchmarks.pendulum`:

- the whole of delucax against a raw `lax.scan` of the task's own vector field;
- the tasks that gymnax has too, one after the other and as a batch, in the same rounds;
- the tasks in Gymnasium's interface, one step and a step of a batch.
"""

import argparse
import json
from pathlib import Path
from typing import Any

import pandas as pd

from benchmarks import _adapter, _tasks
from benchmarks._machine import compile_anew, describe, run_in_settings
from benchmarks._peers import gymnax_peer
from benchmarks._problem import Episodes
from benchmarks._timing import Contender, Missing, race, Timing


OUT = Path(__file__).parent / "results" / "environments.json"
LANES = 1024
# The starts are the same, and so is the arithmetic but for rounding.
TOLERANCE = 1e-3


def timed(found: list[Contender | Missing], rounds: int) -> dict[str, Timing]:
    """Race those who can take part."""
    ready = [entry for entry in found if isinstance(entry, Contender)]
    return {timing.name: timing for timing in race(ready, rounds=rounds)}


def episodes(name: str, chain_steps: int, batch_steps: int) -> list[Episodes]:
    """A chain of whole episodes with all kept, one with the cost, and a batch."""
    horizon = _tasks.task(name).horizon
    count = max(1, chain_steps // horizon)
    return [
        Episodes(name, horizon, count, kept="trajectory"),
        Episodes(name, horizon, count),
        Episodes(name, min(horizon, batch_steps), LANES, batched=True),
    ]


def against_peers(
    names: list[str], chain_steps: int, batch_steps: int, rounds: int
) -> tuple[list[dict[str, Any]], list[dict[str, Any]]]:
    """Nanoseconds a step of ours and of the raw scan, and how many times as long; and
    how many times as long gymnax takes, where it has the task, for the cost alone."""
    raw_rows, gymnax_rows = [], []
    for name in names:
        gap = _tasks.disagreement(name)
        assert gap < TOLERANCE, f"{name}: the two differ by {gap:.1e}."
        row: dict[str, Any] = {"task": name}
        beside: dict[str, Any] = {"task": name}
        for case in episodes(name, chain_steps, batch_steps):
            found: list[Contender | Missing] = [*_tasks.contenders(case)]
            if case.kept == "cost":
                found += [
                    gymnax_peer.episodes(case, stepping="step"),
                    gymnax_peer.episodes(case, stepping="step_env"),
                ]
            t = timed(found, rounds)
            what = f"{LANES} lanes" if case.batched else f"chain, {case.kept}"
            ours, raw = t.pop(_tasks.OURS), t.pop(_tasks.RAW)
            row[f"{what}: ns"] = ours.best
            row[f"{what}: raw ns"] = raw.best
            row[f"{what}: ratio"] = ours.ratio(raw)
            what = f"{LANES} lanes" if case.batched else "chain"
            for peer, timing in t.items():
                beside[f"{what}: {peer} ns"] = timing.best
                beside[f"{what}: {peer} / delucax"] = timing.ratio(ours)
            for entry in found if name in gymnax_peer.TASKS else ():
                if isinstance(entry, Missing):
                    beside[f"{what}: {entry.name}"] = entry.reason
        raw_rows.append(row)
        print(_line(row), flush=True)
        if len(beside) > 1:
            gymnax_rows.append(beside)
            print(_line(beside), flush=True)
    return raw_rows, gymnax_rows


def against_gymnasium(
    ids: list[str], steps: int, rounds: int
) -> tuple[list[dict[str, Any]], list[dict[str, Any]]]:
    """Microseconds of one `step`, and of one of a batch."""
    one, many = [], []
    for name in ids:
        t = timed(list(_adapter.single(name, steps)), rounds)
        ours, theirs = t[_adapter.OURS], t[_adapter.THEIRS]
        row: dict[str, Any] = {"id": name}
        row |= {f"{who}: us": timing.best / 1e3 for who, timing in t.items()}
        row["delucax / Gymnasium"] = ours.ratio(theirs)
        one.append(row)
        print(_line(row), flush=True)
        found = _adapter.vector(name, LANES, max(1, steps // 20))
        t = timed(found, rounds)
        ours = t[_adapter.OURS]
        row = {"id": name}
        for who, timing in t.items():
            row[f"{who}: us"] = LANES * timing.best / 1e3
            if timing is not ours:
                row[f"{who} / delucax"] = timing.ratio(ours)
        many.append(row)
        print(_line(row), flush=True)
    return one, many


def _line(row: dict[str, Any]) -> str:
    parts = [f"{v:.3g}" if isinstance(v, float) else str(v) for v in row.values()]
    return "  " + "  ".join(parts)


def limits(
    raw: list[dict[str, Any]],
    gymnax: list[dict[str, Any]],
    one: list[dict[str, Any]],
    many: list[dict[str, Any]],
) -> list[dict[str, Any]]:
    """The worst of each kind, beside its limit."""
    found: list[dict[str, Any]] = []

    def worst(rows, ends, choose, limit, what):
        values = [
            (value, next(iter(row.values())))
            for row in rows
            for name, value in row.items()
            if name.endswith(ends) and isinstance(value, float)
        ]
        if values:
            value, where = choose(values)
            found.append({"what": what, "measured": value, "of": where, "limit": limit})

    worst(raw, "trajectory: ratio", max, "<= 1.3", "chain, all kept: delucax / raw")
    worst(raw, "cost: ratio", max, "<= 1.3", "chain, cost: delucax / raw")
    worst(raw, "lanes: ratio", max, "", f"{LANES} lanes: delucax / raw")
    worst(gymnax, "/ delucax", min, "> 1", "gymnax / delucax")
    worst(one, "delucax: us", max, "<= 15", "one step, us")
    slow = [row for row in one if row[f"{_adapter.THEIRS}: us"] >= 8]
    ends = "delucax / Gymnasium"
    worst(slow, ends, max, "<= 2", "one step: delucax / Gymnasium, where 8 us or more")
    worst(many, f"{_adapter.SYNC} / delucax", min, ">= 50", "SyncVectorEnv / delucax")
    return found


def documented(found: dict[str, Any]) -> str:
    """The tables of `docs/benchmarks.md`, of what a run has written.

    Times are the best of all rounds, and ratios those of such times.
    """
    times = lambda row, *keys: [_number(row.get(key)) for key in keys]
    lanes = f"{LANES} lanes"
    raw = [
        [
            f"`{row['task']}`",
            *times(row, "chain, trajectory: ns", "chain, trajectory: raw ns"),
            *times(row, "chain, trajectory: ratio", "chain, cost: ns"),
            *times(row, "chain, cost: ratio", f"{lanes}: ns", f"{lanes}: ratio"),
        ]
        for row in found["raw"]
    ]
    gymnax = [
        [f"`{row['task']}`"]
        + [
            cell
            for what in ("chain", lanes)
            for cell in (
                *times(row, f"{what}: gymnax step / delucax"),
                *times(row, f"{what}: gymnax step_env / delucax"),
            )
        ]
        for row in found["gymnax"]
    ]
    many = {row["id"]: row for row in found["vector step"]}
    ours, theirs = f"{_adapter.OURS}: us", f"{_adapter.THEIRS}: us"
    adapted = [
        [
            f"`{row['id']}`",
            *times(row, ours, theirs, "delucax / Gymnasium"),
            *times(many[row["id"]], ours, f"{_adapter.SYNC} / delucax"),
            *times(many[row["id"]], f"{_adapter.VECTOR} / delucax"),
        ]
        for row in found["one step"]
    ]
    worst = [
        [row["what"], _number(row["measured"]), f"`{row['of']}`", row["limit"]]
        for row in found["worst"]
    ]
    chain, batch = "one chain, cost only", f"{lanes}, cost only"
    return "\n\n".join(
        [
            _markdown(
                ["", "one chain, all kept", "raw", "ratio"]
                + [chain, "ratio", batch, "ratio"],
                raw,
            ),
            _markdown(
                [""]
                + [
                    f"{what}: `{way}` / delucax"
                    for what in ("one chain", lanes)
                    for way in ("step", "step_env")
                ],
                gymnax,
            ),
            _markdown(
                ["", "delucax", "Gymnasium", "delucax / Gymnasium"]
                + [f"{LANES}: delucax", "`SyncVectorEnv` / delucax"]
                + ["Gymnasium's own batch / delucax"],
                adapted,
            ),
            _markdown(["the worst of each kind", "measured", "of", "limit"], worst),
        ]
    )


def _number(value: Any) -> str:
    """Three digits."""
    if not isinstance(value, float):
        return ""
    return f"{value:,.0f}" if abs(value) >= 999.5 else f"{value:#.3g}".rstrip(".")


def _markdown(titles: list[str], rows: list[list[str]]) -> str:
    lines = [titles, ["---"] * len(titles), *rows]
    return "\n".join(f"| {' | '.join(line)} |".replace("|  |", "| |") for line in lines)


def measure(options: argparse.Namespace, folder: Path) -> None:
    """Measure, print and write."""
    compile_anew()
    rounds = 3 if options.quick else options.rounds
    chain, batch = (5_000, 50) if options.quick else (50_000, 200)
    names = _tasks.names() if options.tasks is None else options.tasks
    adapted = list(_adapter.IDS) if options.tasks is None else []

    print("Against a raw scan: ns a step of ours, of the raw scan, and the ratio;")
    print("and gymnax's ns a step, and how many times as long, where it has the task")
    raw, gymnax = against_peers(names, chain, batch, rounds)
    print("\nIn Gymnasium's interface: us a step, of one and of a batch")
    one, many = against_gymnasium(adapted, 500 if options.quick else 3_000, rounds)
    tables = {"raw": raw, "gymnax": gymnax, "one step": one, "vector step": many}
    for title, rows in tables.items():
        if rows:
            print(f"\n{title}")
            table = pd.DataFrame(rows).set_index(next(iter(rows[0]))).T
            print(table.to_string(float_format="%.3g", na_rep=""))
    summary = limits(raw, gymnax, one, many)
    print("\nThe worst of each kind")
    print(pd.DataFrame(summary).to_string(index=False, float_format="%.2f"))
    if not options.quick and options.tasks is None:
        out = folder / OUT.name
        content = {
            "machine": describe(),
            "gymnax version": gymnax_peer.versions(),
            "worst": summary,
            **tables,
        }
        out.write_text(json.dumps(content, indent=1) + "\n")
        print(f"\nwritten: {out}")


def main() -> None:
    """Run under both settings."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.environments")
    parser.add_argument("--rounds", type=int, default=11)
    parser.add_argument("--quick", action="store_true", help="small sizes, no file")
    parser.add_argument("--tasks", nargs="*", help="these alone, and no file")
    parser.add_argument(
        "--table", action="store_true", help="run nothing, print the tables"
    )
    if parser.parse_known_args()[0].table:
        print(documented(json.loads(OUT.read_text())))
        return
    run_in_settings(parser, measure)


if __name__ == "__main__":
    main()
