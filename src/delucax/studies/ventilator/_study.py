"""The whole study in one command: breaths, simulators, PIDs, controllers, a report."""

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
from ..._typing import PRNGKey
from ...controllers import LeakyPID
from ...environments import Environment
from . import _contenders as making, _report as reporting, _simulators as fitting
from ._contenders import Contender, pid_contenders, Trainer
from ._settings import BREATH, FULL, SEEN, SENSOR_DELAY, Size, SMALL, UNSEEN
from ._stages import Stages


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
    """Learn simulators of lungs from breaths, and controllers in the simulators; show
    how they do at the lungs themselves, beside the best PIDs.

    The lungs are those of the task `lung/double_compartment`, with the nine resistances
    and compliances of the public data set: valves that lag, a sensor that is two
    samples late and adds noise of 0.2 cmH2O. With `data`, the breaths are those of a
    file; then what stands in for the lungs themselves is a grey-box lung fitted to the
    same breaths, and there are no lungs between. Of the file's ventilator are taken for
    granted: that its sensor is `sensor_delay` samples late and as noisy as ours, that
    it breathes from a PEEP of about 5 cmH2O, and, in all but the learned lungs, that
    its valves are ours.

    Each part is written to the folder when it is done, so that a study that was cut off
    goes on from there.

    **Arguments:**

    - `out`: the folder to write to, `"lung"` by default. In it: `report.csv`,
        `simulators.csv`, `summary.json`, figures, `breath.gif`, the learned lungs
        (`simulators.dlx`) and those controllers that stayed below the abort limit
        (`controllers/*.dlx`), which `delucax.load` reads.
    - `small`: two lungs and little of everything, in less than a minute; false by
        default.
    - `data`: a file that [`delucax.lung.read_breaths`][] reads; none by default.
    - `seeds`: how many controllers of each kind are trained; 3 by default, and 1 if
        `small`.
    - `sensor_delay`: how many samples late the sensor is, that of the file's ventilator
        or of ours; 2 by default.
    - `say`: what to do with a line of text; `print` by default.
    - `progress`: whether trainings show a bar; true by default.

    **Returns:** the rows of the report, dictionaries.

    **Raises:** `ValueError` if an argument is illegal, the folder holds a study with
        other settings, a file in it is damaged, or the data are not what they should
        be; `OSError` if a file cannot be read or written.

    !!! example

        ```python
        from delucax.studies import lung_study  # then: lung_study("out", small=True)
        ```
    """
    began = time.perf_counter()
    size = SMALL if small else FULL
    if seeds is not None:
        size = size._replace(seeds=seeds)
    if size.seeds < 1:
        raise ValueError(f"lung: seeds must be at least 1, got {seeds}.")
    sensor_delay = check_count(sensor_delay, "sensor_delay", "lung", least=0)
    size = size._replace(sensor_delay=sensor_delay)
    recorded = None if data is None else lung.read_breaths(data)
    settings = dict(
        size._asdict(),
        data=None if data is None else _named(Path(data)),
        version=importlib.metadata.version("delucax"),
    )
    stages = Stages(Path(out), settings, say, progress)
    waveform, key = lung.BreathWaveform(), jr.key(0)

    if recorded is None:
        lungs = size.lungs
        make = lambda: fitting.explored(size)
        breaths = stages.stage("breaths", "Breaths", make)
    else:
        make = lambda: fitting.grouped(recorded)
        lungs, breaths = stages.stage("breaths", "Breaths", make)
        if words := fitting.left_out(recorded, breaths):
            say(words)
        kinds = dict.fromkeys((*size.physics, "grey box"))
        size = size._replace(physics=tuple(kinds), between=())
    names = [_lung_name(*each) for each in lungs]
    train, test = fitting.divided(breaths, jr.fold_in(key, 1))
    models = _simulators(stages, train, size, key)
    table = fitting.open_loop_rows(names, test, models)

    between = None
    if recorded is None:
        around = [size.between[i % len(size.between)] for i in range(len(lungs))]
        envs, others = (
            lung.stack([fitting.task_of(R, C, sensor_delay) for R, C in each])
            for each in (lungs, around)
        )
        between = others, [_lung_name(*each) for each in size.between]
        judge = "the lungs themselves"
    else:
        # What no controller was trained in stands in for the lungs.
        made = [
            lung.lung_environment(model, waveform, horizon=BREATH)
            for model in lung.unstack(models["grey box"])
        ]
        envs = lung.stack(made)
        judge = "grey-box lungs fitted to the same breaths, for want of the lungs"
    trainer = Trainer(models["learned"], waveform, size, key)
    contenders = _contenders(stages, envs, train, trainer)
    if size.extras and recorded is None:
        pids = next(c.controllers for c in contenders if c.label == "PID")
        closed = stages.stage(
            "closed_loop",
            "Simulators and lungs under the same PIDs",
            lambda: fitting.closed_loop_errors(envs, models, pids, waveform),
        )
        for row in table:
            errors = closed[row["simulator"]]
            row["closed_loop_mae"] = float(errors[names.index(row["lung"])])
    stages.write_table("simulators.csv", table)
    keys = jr.split(jr.fold_in(key, 99), size.noises)
    rows, runs = reporting.error_rows(contenders, envs, names, waveform, keys, between)
    if size.bound_steps:
        bound = stages.stage(
            "bound",
            "The least error, with the lung at hand",
            lambda: _least_errors(envs, size.bound_steps),
        )
        rows += reporting.bound_rows(names, np.asarray(bound))
    stages.write_table("report.csv", rows)
    place = stages.out / "controllers"
    unsafe = reporting.save_controllers(place, contenders, names, waveform, rows)
    summary = reporting.summarise(rows, table, stages.seconds, judge, unsafe)
    stages.write("summary.json", json.dumps(summary, indent=1) + "\n")
    for line in summary["words"]:
        say(line)
    best = {"best PID": reporting.best_of(rows, reporting.PID_ROWS, "unseen")[1]}
    shown = {n: runs[best.get(n, n)] for n in ("best PID", "MLP", "MLP for all")}
    if importlib.util.find_spec("matplotlib") is None:
        say("No figures: they need matplotlib (pip install 'delucax[plot]').")
    else:
        from ._figures import draw_study

        draw_study(stages.out, envs, shown, names, test, models, table, rows)
    say(f"Written to {stages.out}/ in {time.perf_counter() - began:.0f} s.")
    return rows


def _named(path: Path) -> str:
    """A file by its name and its content: with another content it is another study."""
    return f"{path}, SHA-256 {hashlib.sha256(path.read_bytes()).hexdigest()[:16]}"


def _lung_name(resistance: float, compliance: float) -> str:
    """What a lung is called in the report."""
    return f"R{resistance:g}C{compliance:g}"


def _simulators(
    stages: Stages, train: lung.Breaths, size: Size, key: PRNGKey
) -> dict[str, lung.LearnedLung | lung.LungModel]:
    """Simulators of each kind, stacked over the lungs, by name."""
    count, data = f"all {train.pressure.shape[0]} at once", (train, size, key)
    words = f"Learned lungs, {count}"
    learned = stages.training("simulators", words, fitting.learned, *data)
    models: dict[str, Any] = {"learned": learned}
    for kind in size.physics:
        name, words = kind.replace(" ", "_"), f"Fitted {kind}, {count}"
        models[kind] = stages.training(name, words, fitting.fitted, kind, *data)
    return models


def _contenders(
    stages: Stages, envs: Environment, train: lung.Breaths, trainer: Trainer
) -> list[Contender]:
    """All controllers, in the order of the report."""
    size, waveform, training = trainer.size, trainer.waveform, stages.training
    pids = stages.stage(
        "pids", "PID grids", lambda: making.searched_pids(envs, trainer)
    )
    # No control is a PID without gains, as which it compiles nothing of its own.
    none = trainer.pid(LeakyPID, (0.0, 0.0, 0.0))
    contenders = [Contender("zero", 0, none, True), *pid_contenders(pids)]
    words = f"A network for each lung, {size.seeds} seeds at once"
    own = training("own", words, making.networks, trainer, "mlp", size.seeds)
    words = f"A network for all lungs, {size.seeds} seeds at once"
    shared = training("shared", words, making.networks_for_all, trainer)
    if size.tuned:
        words = "PIDs with feed-forward tuned on the lungs"
        tuned = training(
            "tuned_pids", words, making.tuned_pids, envs, trainer, stages.say
        )
        contenders += pid_contenders(tuned)
    if size.extras:
        words = "PIDs trained on"
        more = training("trained_pids", words, making.trained_pids, trainer, pids)
        words = "A convolutional network for each lung"
        convolved = training("own_cnn", words, making.networks, trainer, "cnn", 1)
        words = "A PID and a network for each lung"
        residual = training("residual", words, making.networks_on_pids, trainer, pids)
        learn = lambda: making.online_learners(train, pids, waveform, size.sensor_delay)
        online = stages.stage("online", "GPC around the best PIDs", learn)
        contenders += [
            *pid_contenders(more),
            Contender("bang-bang", 0, lung.BangBang(waveform), True),
            Contender("GPC", 0, online),
            making.planners(trainer),
            Contender("CNN", 0, lung.unstack(convolved)[0]),
            Contender("PID + MLP", 0, lung.unstack(residual)[0]),
        ]
    for label, trained in (("MLP", own), ("MLP for all", shared)):
        alike = trained is shared
        each = enumerate(lung.unstack(trained))
        contenders += [Contender(label, seed, one, alike) for seed, one in each]
    return contenders


def _least_errors(envs: Environment, steps: int) -> Any:
    """About the least error there could be, shape `(lungs, pips)`."""
    pips = jnp.asarray(SEEN + UNSEEN)
    of = lambda env: lung.least_error(env, pips=pips, steps=steps)  # noqa: E731
    return eqx.filter_vmap(of)(envs)
