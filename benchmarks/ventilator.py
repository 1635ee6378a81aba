"""`python -m benchmarks.ventilator`: the ventilator study, and how long its parts take.

Runs `python -m delucax lung` with more seeds into a folder; times the parts on one
lung; fits learned lungs as published; and trains the same controller by the gradient,
by evolution strategies and by proximal policy optimisation, with as many steps of the
simulator and with more. A run that was cut off goes on in its folder. Prints tables,
and writes `benchmarks/results/ventilator.json` and the tables of
`docs/ventilator_results.md`; `--page` does the latter from what is stored.

The limits were written before the first run. Where there are seeds, the upper end of
the 95% interval of the mean decides.
"""

import argparse
import json
import time
from pathlib import Path
from typing import Any

import jax
import numpy as np

from benchmarks._breath_training import steps_to, WAYS
from benchmarks._lungs import as_published, least_errors
from benchmarks._machine import compile_anew, describe
from benchmarks._ventilator_page import write_page
from delucax import lung, studies
from delucax._module import stack
from delucax.studies.ventilator._report import PID_ROWS
from delucax.studies.ventilator._stages import FULL


RESULTS = Path(__file__).parent / "results" / "ventilator.json"
LIMITS = {
    "learned lung, open loop, worst lung, cmH2O": 0.4,
    "learned lung / wrong physics, worst lung": 0.5,
    "network / best PID, worst lung": 0.8,
    "network for all / best PID for all": 0.8,
    "network for all / best PID for all, lungs between": 0.8,
    "highest pressure with what was learned, cmH2O": 60.0,
    "simulator of one lung, s": 60.0,
    "controller of one lung, s": 60.0,
    "PID grid over six pressures and nine lungs, s": 5.0,
}
"""At most these."""
LEVELS = (8.0, 5.0, 3.0, 2.0)
"""Errors that training is to get to, cmH2O."""


def parts() -> dict[str, float]:
    """Seconds of the parts, compilation included, each by itself."""
    env = lung.double_compartment()
    breaths = lung.explore(env, 400, key=jax.random.key(0))
    found = {}

    begin = time.perf_counter()
    model = lung.LearnedLung(breaths, key=jax.random.key(1))
    steps = dict(teacher_steps=FULL.teacher_steps, steps=FULL.simulator_steps)
    model = lung.fit_lungs(model, breaths, key=jax.random.key(2), **steps).model
    found["simulator of one lung, s"] = time.perf_counter() - begin

    begin = time.perf_counter()
    waveform = lung.BreathWaveform()
    policy = lung.BreathPolicy(waveform, 0.03, key=jax.random.key(3))
    start = stack([stack([policy])])
    envs = stack([lung.learned_lung(model, noise=0.2)])
    lung.train_controllers(envs, start, key=jax.random.key(4))
    found["controller of one lung, s"] = time.perf_counter() - begin

    lungs = [(R, C) for R in (5.0, 20.0, 50.0) for C in (10.0, 20.0, 50.0)]
    tasks = [lung.double_compartment(resistance=R, compliance=C) for R, C in lungs]
    envs = stack(tasks)
    begin = time.perf_counter()
    jax.block_until_ready(lung.pid_grid(envs, key=jax.random.key(5)))
    found["PID grid over six pressures and nine lungs, s"] = time.perf_counter() - begin
    return found


def interval(values: Any) -> list[float]:
    """The mean, and the ends of its 95% interval by the bootstrap."""
    values = np.asarray(values, float)
    again = np.random.default_rng(0).choice(values, (4000, len(values))).mean(axis=1)
    return [float(values.mean()), *np.percentile(again, [2.5, 97.5]).tolist()]


def errors_of(rows: list[dict[str, Any]], label: str, split: str, lung: Any = None):
    """The error of each seed of a controller, in one lung or on average over all."""
    seeds: dict[int, list[float]] = {}
    for row in rows:
        fits = lung is None or row["lung"] == lung
        if row["controller"] == label and row["split"] == split and fits:
            seeds.setdefault(int(row["seed"]), []).append(float(row["mae"]))
    return np.array([np.mean(errors) for errors in seeds.values()])


def against_pids(
    rows: list[dict[str, Any]], label: str, split: str, lung: Any = None
) -> list[float]:
    """The error of a network over that of the best PID, with its interval."""
    ending = " for all" if label.endswith(" for all") else ""
    pids = [errors_of(rows, f"{pid}{ending}", split, lung) for pid in PID_ROWS]
    best = min(float(np.mean(errors)) for errors in pids if len(errors))
    return interval(errors_of(rows, label, split, lung) / best)


def kept(path: Path, make: Any) -> Any:
    """What `make` returns, or what it returned before."""
    if not path.exists():
        path.write_text(json.dumps(make()))
    return json.loads(path.read_text())


def levels(curves: dict[str, Any]) -> list[dict[str, Any]]:
    """After how many steps of the simulator each way has got to an error."""
    return [
        {"error": level} | {way: steps_to(c, level) for way, c in curves.items()}
        for level in LEVELS
    ]


def assembled(
    rows: list[dict[str, Any]],
    summary: dict[str, Any],
    seconds: dict[str, float],
    trained: dict[str, Any],
    others: dict[str, Any],
) -> dict[str, Any]:
    """What is committed."""
    names = list(summary["simulators"]["learned"])
    own = {name: against_pids(rows, "MLP", "unseen", name) for name in names}
    every = {
        split: against_pids(rows, "MLP for all", split)
        for split in ("unseen", "between")
    }
    alike = {name: against_pids(rows, "MLP for all", "unseen", name) for name in names}
    measured = {
        "learned lung, open loop, worst lung, cmH2O": max(
            summary["simulators"]["learned"].values()
        ),
        "learned lung / wrong physics, worst lung": max(
            summary["learned_over_wrong_physics"].values()
        ),
        "network / best PID, worst lung": max(high for _, _, high in own.values()),
        "network for all / best PID for all": every["unseen"][2],
        "network for all / best PID for all, lungs between": every["between"][2],
        "highest pressure with what was learned, cmH2O": summary["highest_pressure"],
        **seconds,
    }
    return {
        "machine": describe(),
        "limits": LIMITS,
        "measured": measured,
        "network / best PID": own,
        "network for all / best PID for all": every,
        "network for all / best PID for all, lung by lung": alike,
        "summary": summary,
        "steps of the simulator to an error": levels(trained),
        "training": trained,
        **others,
        "report": rows,
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--out", default="build/ventilator", help="folder of the study")
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--page", action="store_true", help="from what is stored")
    options = parser.parse_args()
    if options.page:
        write_page(json.loads(RESULTS.read_text()))
        return
    compile_anew()
    out = Path(options.out)
    out.mkdir(parents=True, exist_ok=True)
    # First, for what the study has compiled would take no time.
    seconds = kept(out / "parts.json", parts)
    rows = studies.lung_study(out, seeds=options.seeds)
    summary = json.loads((out / "summary.json").read_text())
    trained = {
        name: kept(out / f"{name}.json".replace(" ", "_"), lambda way=way: way(5))
        for name, way in WAYS.items()
    }
    others = {
        "learned lung as published, open loop": kept(
            out / "as_published.json", as_published
        ),
        "least error of other tasks at 35 cmH2O": kept(
            out / "least_errors.json", least_errors
        ),
    }
    results = assembled(rows, summary, seconds, trained, others)
    for name, value in results["measured"].items():
        said = "kept" if value <= LIMITS[name] else "MISSED"
        print(f"{name:55} {value:8.3f}  limit {LIMITS[name]:6.2f}  {said}")
    RESULTS.write_text(json.dumps(results, indent=1) + "\n")
    write_page(results)


if __name__ == "__main__":
    main()
