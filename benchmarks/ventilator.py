"""`python -m benchmarks.ventilator`: the ventilator study, and how long its parts take.

Runs `python -m delucax lung` with more seeds into a folder (a run that was cut off goes
on there); then times the parts on one lung, and trains the same controller by the
gradient and by evolution strategies with as many steps of the simulator. Prints tables,
and writes `benchmarks/results/ventilator.json`.

The limits were written before the first run.
"""

import argparse
import json
import time
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from benchmarks._machine import describe
from delucax import lung
from delucax.training import EvolutionStrategies


RESULTS = Path(__file__).parent / "results" / "ventilator.json"
LIMITS = {
    "learned lung, open loop, worst lung, cmH2O": 0.4,
    "learned lung / wrong physics, worst lung": 0.5,
    "network / best PID, worst lung": 0.8,
    "network for all / best PID for all": 0.8,
    "network for all / best PID for all, lungs between": 0.8,
    "highest pressure, cmH2O": 60.0,
    "simulator of one lung, s": 60.0,
    "controller of one lung, s": 60.0,
    "PID grid over six pressures and nine lungs, s": 5.0,
}
"""At most these."""


def parts() -> dict[str, float]:
    """Seconds of the parts, compilation included, each by itself."""
    env = lung.double_compartment()
    breaths = lung.explore(env, 400, key=jax.random.key(0))
    found = {}

    begin = time.perf_counter()
    model = lung.LearnedLung(breaths, key=jax.random.key(1))
    model = lung.fit_lungs(model, breaths, key=jax.random.key(2)).model
    found["simulator of one lung, s"] = time.perf_counter() - begin

    begin = time.perf_counter()
    waveform = lung.BreathWaveform()
    policy = lung.BreathPolicy(waveform, 0.03, key=jax.random.key(3))
    start = lung.stack([lung.stack([policy])])
    models = lung.stack([model])
    lung.train_controllers(models, start, key=jax.random.key(4))
    found["controller of one lung, s"] = time.perf_counter() - begin

    lungs = [(R, C) for R in (5.0, 20.0, 50.0) for C in (10.0, 20.0, 50.0)]
    envs = lung.stack([lung.double_compartment(*each) for each in lungs])
    begin = time.perf_counter()
    grid = lung.pid_grid(envs, key=jax.random.key(5))
    jax.block_until_ready(grid.errors)
    found["PID grid over six pressures and nine lungs, s"] = time.perf_counter() - begin
    return found


def estimators(seeds: int) -> dict[str, Any]:
    """The error in the simulator after as many steps of it, by gradient and by ES."""
    models = lung.stack([lung.learned_lung().dynamics.dynamics])
    waveform = lung.BreathWaveform()
    steps, pairs, found = 400, 16, {}
    # A gradient costs one episode forward and about two backward.
    options = {
        "gradient": dict(steps=steps),
        "evolution strategies, as many steps": dict(
            steps=max(1, 3 * steps // (2 * pairs + 1)),
            gradient=EvolutionStrategies(0.05, 2 * pairs),
        ),
        "evolution strategies, 10 times as many": dict(
            steps=max(1, 30 * steps // (2 * pairs + 1)),
            gradient=EvolutionStrategies(0.05, 2 * pairs),
        ),
    }
    for name, chosen in options.items():
        ends = []
        for seed in range(seeds):
            policy = lung.BreathPolicy(waveform, 0.03, key=jax.random.key(seed))
            start = lung.stack([lung.stack([policy])])
            key = jax.random.key(100 + seed)
            fitted = lung.train_controllers(models, start, key=key, **chosen)
            env = lung.lung_environment(models_at(models, 0))
            trained = lung.unstack(lung.unstack(fitted.model)[0])[0]
            error = lung.breath_error(env, trained, key=jax.random.key(7))
            ends.append(float(jnp.mean(error)))
        found[name] = ends
        print(f"{name}: {np.mean(ends):.2f} cmH2O ({seeds} seeds)", flush=True)
    return found


def models_at(models: Any, index: int) -> Any:
    """One of the stacked models."""
    return jax.tree.map(lambda a: a[index] if eqx.is_array(a) else a, models)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--out", default="build/ventilator", help="folder of the study")
    parser.add_argument("--seeds", type=int, default=20)
    options = parser.parse_args()
    rows = lung.lung_study(options.out, seeds=options.seeds)
    summary = json.loads((Path(options.out) / "summary.json").read_text())
    seconds = parts()
    ratios = summary["learned_over_wrong_physics"].values()
    measured = {
        "learned lung, open loop, worst lung, cmH2O": max(
            summary["simulators"]["learned"].values()
        ),
        "learned lung / wrong physics, worst lung": max(ratios),
        "network / best PID, worst lung": max(
            summary["network_over_best_pid"].values()
        ),
        "network for all / best PID for all": summary["shared_over_best_pid"]["unseen"],
        "network for all / best PID for all, lungs between": summary[
            "shared_over_best_pid"
        ]["between"],
        "highest pressure, cmH2O": summary["highest_pressure"],
        **seconds,
    }
    for name, value in measured.items():
        kept = "kept" if value <= LIMITS[name] else "MISSED"
        print(f"{name:55} {value:8.3f}  limit {LIMITS[name]:6.2f}  {kept}")
    results = {
        "machine": describe(),
        "limits": LIMITS,
        "measured": measured,
        "summary": summary,
        "estimators": estimators(3),
        "report": rows,
    }
    RESULTS.write_text(json.dumps(results, indent=1) + "\n")


if __name__ == "__main__":
    main()
