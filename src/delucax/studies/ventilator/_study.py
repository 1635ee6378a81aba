"""The whole study: breaths, simulators, PIDs, controllers and a report."""

import hashlib
import importlib.metadata
import importlib.util
import json
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import jax.random as jr
import numpy as np

from ... import lung
from ..._check import check_count
from ..._module import stack, unstack
from . import _contenders, _report, _simulators
from ._stages import (
    BREATH,
    FULL,
    NOISE,
    SENSOR_DELAY,
    SMALL,
    Stages,
    TEST_PIPS,
    TRAIN_PIPS,
)


def lung_study(
    out: str | Path = "lung",
    *,
    small: bool = False,
    data: str | Path | None = None,
    seeds: int | None = None,
    sensor_delay: int = SENSOR_DELAY,
    say: Callable[[str], Any] = print,
    progress: bool = True,
) -> list[dict[str, Any]]:
    """Learn simulators of lungs from breaths, and train controllers in the simulators.

    Then the controllers are tested on the original lungs, from which the breaths came,
    and compared with the best PIDs. The original lungs are those of the task
    `lung/double_compartment`, with the nine pairs of resistance and compliance in the
    public data set. The valves of these lungs respond with a lag, and the sensor is two
    samples late and adds noise of 0.2 cmH2O.

    If you give `data`, the breaths come from a file. In this case the original lungs
    are unknown. The controllers are therefore tested on grey-box lungs that are fitted
    to the same breaths. They are not tested on lungs with intermediate parameters. The
    study assumes that the sensor of the ventilator is `sensor_delay` samples late and
    has noise of 0.2 cmH2O, and that the PEEP is about 5 cmH2O. Except for the learned
    lungs, the study also assumes that the valves behave like [`delucax.lung.Valves`][].

    Each part of the study is stored in the folder when it is finished, so that an
    interrupted study continues from the last finished part.

    **Arguments:**

    - `out`: the folder to write to, `"lung"` by default. The study writes `report.csv`,
        `simulators.csv`, `summary.json`, figures, `breath.gif`, the learned lungs
        (`simulators.dlx`), and the controllers that stayed below the abort limit
        (`controllers/*.dlx`), which `delucax.load` reads.
    - `small`: whether to study only two lungs with short trainings, which takes about a
        minute; `False` by default.
    - `data`: a file that [`delucax.lung.read_breaths`][] reads; none by default.
    - `seeds`: the number of controllers of each kind to train; 3 by default, or 1 with
        `small`.
    - `sensor_delay`: the delay of the sensor in samples, also for the measurements in
        `data`; 2 by default.
    - `say`: a function that gets each line of text; `print` by default.
    - `progress`: whether trainings show a progress bar; `True` by default.

    **Returns:** the rows of the report, each a dictionary.

    **Raises:** `ValueError` if an argument is invalid, the folder holds a study with
        other settings, a file in it is damaged, or the data are invalid; `OSError` if a
        file cannot be read or written.

    !!! example

        ```python
        from delucax.studies import lung_study  # then: lung_study("out", small=True)
        ```
    """
    began = time.perf_counter()
    delay = check_count(sensor_delay, "sensor_delay", "lung", least=0)
    size = (SMALL if small else FULL)._replace(sensor_delay=delay)
    if seeds is not None:
        size = size._replace(seeds=check_count(seeds, "seeds", "lung"))
    recorded = None if data is None else lung.read_breaths(data)
    source = None
    if data is not None:
        # The settings hold a hash, because a file with other content is another study.
        digest = hashlib.sha256(Path(data).read_bytes()).hexdigest()[:16]
        source = f"{Path(data)}, SHA-256 {digest}"
    version = importlib.metadata.version("delucax")
    settings = dict(size._asdict(), data=source, version=version)
    stages = Stages(Path(out), settings, say, progress)
    waveform, key = lung.BreathWaveform(), jr.key(0)

    if recorded is None:
        lungs = size.lungs
        make = lambda: _simulators.explored(size)
        breaths = stages.stage("breaths", "Simulating breaths", make)
    else:
        make = lambda: _simulators.grouped(recorded)
        words = "Sorting the recorded breaths by lung"
        lungs, breaths = stages.stage("breaths", words, make)
        if words := _simulators.left_out(recorded, breaths):
            say(words)
        kinds = dict.fromkeys((*size.physics, "grey box"))
        size = size._replace(physics=tuple(kinds), between=())
    names = [_lung_name(*each) for each in lungs]
    train, test = _simulators.divided(breaths, jr.fold_in(key, 1))
    words, given = f"(all {len(lungs)} at once)", (train, size, key)
    words_learned = f"Training a learned lung for each lung {words}"
    learned = "simulators", words_learned, _simulators.learned
    models: dict[str, Any] = {"learned": stages.training(*learned, *given)}
    for kind in size.physics:
        told = f"Fitting a {kind} model to each lung {words}"
        stage = kind.replace(" ", "_"), told, _simulators.fitted
        models[kind] = stages.training(*stage, kind, *given)
    error_of = eqx.filter_jit(eqx.filter_vmap(lung.Breaths.open_loop_error))
    table: list[dict[str, Any]] = [
        {"lung": name, "simulator": kind, "mae": float(error)}
        for kind, model in models.items()
        for name, error in zip(names, error_of(test, model), strict=True)
    ]

    between = None
    if recorded is None:
        around = [size.between[i % len(size.between)] for i in range(len(lungs))]
        envs, others = (
            stack([_simulators.task_of(R, C, delay) for R, C in each])
            for each in (lungs, around)
        )
        between = others, [_lung_name(*each) for each in size.between]
        judge = "the lungs themselves"
    else:
        # Models in which no controller was trained stand in for the lungs.
        options: Any = dict(waveform=waveform, noise=NOISE, horizon=BREATH)
        boxes = unstack(models["grey box"])
        envs = stack([lung.learned_lung(box, **options) for box in boxes])
        judge = "grey-box lungs fitted to the same breaths (the lungs are unknown)"
    trainer = _contenders.Trainer(models["learned"], waveform, size, key, say)
    contenders = _contenders.contenders(stages, envs, train, trainer)
    if size.extras and recorded is None:
        pids = next(c.controllers for c in contenders if c.label == "PID")
        words = "Comparing simulators and lungs under the same PIDs"
        make = lambda: _simulators.closed_loop_errors(envs, models, pids)
        closed = stages.stage("closed_loop", words, make)
        for row in table:
            errors = closed[row["simulator"]]
            row["closed_loop_mae"] = float(errors[names.index(row["lung"])])
    stages.write_table("simulators.csv", table)
    keys = jr.split(jr.fold_in(key, 99), size.noises)
    rows, runs = _report.error_rows(contenders, (envs, names), between, keys)
    if size.bound_steps:
        pips = jnp.asarray(TRAIN_PIPS + TEST_PIPS)
        of = lambda env: lung.least_error(env, pips=pips, steps=size.bound_steps)
        words = "Computing the least error that is possible with a known lung"
        make = eqx.filter_vmap(of)
        bound = stages.stage("bound", words, lambda: make(envs))
        rows += _report.rows_of(names, ("least error", 0), np.asarray(bound))
    stages.write_table("report.csv", rows)
    place = stages.out / "controllers"
    unsafe = _report.save_controllers(place, contenders, names, rows)
    summary = _report.summarise(rows, table, stages.seconds, judge, unsafe)
    stages.write("summary.json", json.dumps(summary, indent=1) + "\n")
    for line in summary["words"]:
        say(line)
    best = {"best PID": _report.best_of(rows, _report.PID_ROWS, "unseen")[1]}
    shown = {n: runs[best.get(n, n)] for n in ("best PID", "MLP", "MLP for all")}
    if importlib.util.find_spec("matplotlib") is None:
        say("No figures, because Matplotlib is missing: pip install 'delucax[plot]'.")
    else:
        from . import _figures

        figure = _figures.tracking_figure(envs, shown, names, rows)
        figure.savefig(stages.out / "controllers.png", dpi=130)
        figure = _figures.simulator_figure(test, models, names, table)
        figure.savefig(stages.out / "simulators.png", dpi=130)
        _figures.draw_breath(stages.out / "breath.gif", envs, shown["MLP"])
    say(f"Wrote the results to {stages.out}/ ({time.perf_counter() - began:.0f} s).")
    return rows


def _lung_name(resistance: float, compliance: float) -> str:
    """The name of a lung in the report."""
    return f"R{resistance:g}C{compliance:g}"
