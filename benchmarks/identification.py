"""`python -m benchmarks.identification`: identification, graded by public data.

`--data DIR` names a folder with `cascaded_tanks/dataBenchmark.csv`,
`silverbox/SNLS80mV.csv.gz` and `deluca_lung/arrays.npz`; the page
`docs/identification_exam.md`, which this command writes, says where they are from. The
parts:

- `tanks`, `silverbox`, `bouc_wen`: a linear model, physics, physics with a network of
  ten seeds, and a neural state-space model of ten seeds, fitted to the estimation half
  alone, and scored as `nonlinear_benchmarks` scores: the root of the mean squared error
  of the free run on the test, after the first 50 samples, from which the state is
  estimated. Bouc-Wen needs no file;
- `others`: the two models that need no physics, on each folder `DIR/others/NAME` with
  `estimation.csv` and tests `test*.csv`, columns `u...` and `y...`. Their errors are
  printed only;
- `coverage`: how often intervals of 95% hold the truth, on 1,000 simulated records of
  three plants;
- `lung`: controllers in the simulator that was published with Deluca
  (`benchmarks/_published_lung.py`).

A part whose file is not there is left out. All is in double precision. Each fit is
stored in `benchmarks/results/identified.jsonl` and not repeated: `--again` forgets the
stored ones first. The results and the page are written only if all seeds and records
were asked for.
"""

import argparse
import os
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks import _cases
from benchmarks._identified import others
from benchmarks._identified.case import DATA, GREY_BOX, KNOWN, LINEAR, module_of, NEURAL
from benchmarks._identified.page import page
from benchmarks._machine import describe, limit_cores
from benchmarks._results import updated


STORE = _cases.RESULTS / "identified.jsonl"
RESULTS = _cases.RESULTS / "identification.json"
SEEDS = 10
PROBLEMS = ("tanks", "silverbox", "bouc_wen")
PARTS = (*PROBLEMS, others.FOLDER, "coverage", "lung")
SECONDS = 180
"""A fit may take these, with compilation."""


def problem(
    name: str, data: Path, seeds: int, again: bool, store: Path = STORE
) -> dict[str, Any] | None:
    """The errors of each method on each test."""
    module = module_of(name)
    file = getattr(module, "FILE", None)
    if file and not (data / file).exists():
        print(f"  {data / file} is not there, and {name} is left out")
        return None
    several = (GREY_BOX, NEURAL) if hasattr(module, "fitted") else (NEURAL,)
    cases: list[dict[str, Any]] = [{"problem": name, "method": LINEAR, "seed": 0}]
    cases += [
        {"problem": name, "method": method, "seed": k}
        for method in several
        for k in range(seeds)
    ]
    if hasattr(module, "known"):
        cases.append({"problem": name, "method": KNOWN, "seed": 0})
    os.environ[DATA] = str(data)
    if again:
        _cases.forget(store, problem=name)
    before = _cases.stored(store)
    rows = _cases.run("benchmarks._identified.case", store, cases, _said)
    if not rows:
        print(f"  no fit of {name} succeeded")
        return None
    old = [row["machine"] for row in rows if row in before]
    if old:
        made = f"made on {old[-1]['date'][:10]}, {old[-1]['cpu']}"
        print(
            f"  {len(old)} of {len(rows)} fits are stored ({made}); --again fits anew"
        )
    tables: dict[str, dict[str, list[float]]] = {}
    for row in rows:
        for method, errors in row["errors"].items():
            for part, error in errors.items():
                tables.setdefault(method, {}).setdefault(part, []).append(error)
    made = [
        {"method": method, "seeds": len(next(iter(parts.values())))}
        | {part: _summary(values) for part, values in parts.items()}
        for method, parts in tables.items()
    ]
    for method, parts in tables.items():
        medians = (f"{part} {np.median(errors):.4g}" for part, errors in parts.items())
        print(f"  {method}: {', '.join(medians)} {module.UNIT}")
    slowest = max(row["seconds"] for row in rows)
    for part, limit in module.LIMITS.items():
        median = float(np.median(tables.get(GREY_BOX, {}).get(part, [np.inf])))
        verdict = "met" if median <= limit else "NOT met"
        print(f"  {name}, {part}: {median:.4g} {module.UNIT} ({limit:g}): {verdict}")
    print(f"  longest fit: {slowest:.0f} s ({SECONDS})")
    about = {"unit": module.UNIT, "limits": module.LIMITS, "rows": made}
    failed = len(cases) - len(rows)
    about |= {"longest fit, s": slowest, "failed": failed}
    return about | {"machine": rows[-1]["machine"]}


def _said(row: dict[str, Any]) -> str:
    parts = next(reversed(row["errors"].values()))
    errors = ", ".join(f"{part} {error:.4g}" for part, error in parts.items())
    return f"{errors}; {row['seconds']:.0f} s"


def _summary(values: list[float]) -> dict[str, float]:
    low, middle, high = np.quantile(values, [0, 0.5, 1])
    return {"median": float(middle), "least": float(low), "most": float(high)}


def covered(records: int) -> dict[str, Any]:
    """The coverage of the intervals."""
    import jax

    jax.config.update("jax_enable_x64", True)
    from benchmarks._identified.coverage import coverage, FAILURES, LIMITS

    rows = coverage(records)
    for row in rows:
        if not row["judged"]:
            continue
        is_met = LIMITS[0] <= row["covered, %"] <= LIMITS[1]
        is_met = is_met and row["failures, %"] <= FAILURES
        print(f"  {row['plant']}: {'met' if is_met else 'NOT met'}")
    return {"rows": rows}


def main() -> None:
    """Run the parts that are named, and write the page."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.identification")
    parser.add_argument("--data", type=Path, default=Path("data"), help="the folder")
    parser.add_argument("--part", choices=PARTS, action="append")
    parser.add_argument("--seeds", type=int, default=SEEDS, help="of the networks")
    parser.add_argument("--records", type=int, default=1000, help="of the coverage")
    parser.add_argument("--again", action="store_true", help="forget the stored fits")
    parser.add_argument("--page", action="store_true", help="write the page alone")
    options = parser.parse_args()
    if min(options.seeds, options.records) < 1:
        parser.error("--seeds and --records must be at least 1")
    if options.page:
        page(RESULTS)
        return
    is_whole = options.seeds >= SEEDS and options.records >= 1000
    for part in options.part or PARTS:
        print(f"\n== {part}", flush=True)
        if part in PROBLEMS:
            result = problem(part, options.data, options.seeds, options.again)
        elif part == "coverage":
            result = covered(options.records) | {"machine": describe()}
        elif part == "lung":
            result = in_the_lung(options.data)
        else:
            result = None
            with tempfile.TemporaryDirectory() as folder:
                store = Path(folder) / "identified.jsonl"
                for name in others.names(options.data):
                    print(f"\n== {name}", flush=True)
                    problem(name, options.data, options.seeds, False, store)
        if result is not None and is_whole:
            updated(RESULTS, lambda old, part=part, new=result: {part: new})
    if is_whole:
        page(RESULTS)
    else:
        print("\nnot all seeds and records: the results and the page stay as they were")


def in_the_lung(data: Path) -> None:
    """Controllers in the published simulator, for the page of the ventilator."""
    from benchmarks import _published_lung

    file = data / _published_lung.FILE
    if file.exists():
        _published_lung.store(_published_lung.published_lung(file))
    else:
        print(f"  {file} is not there, and the lung is left out")


if __name__ == "__main__":
    limit_cores(2)
    main()
