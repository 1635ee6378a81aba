"""The whole study in one command: breaths, simulators, PIDs, controllers, a report."""

import csv
import json
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np

from .._fields import positive
from .._serialise import load, save
from ..controllers import Constant
from ..environments import Environment
from ..simulation import rollout
from ._csv import COMPLIANCES, read_breaths, RESISTANCES
from ._data import Breaths, explore, LENGTH, PIPS, split
from ._grid import GAINS, least_error, make_pid, pid_grid
from ._learned import LearnedLung
from ._lungs import BalloonLung, DoubleCompartment, SingleCompartment
from ._models import GreyBoxLung, LungModel, NeuralLung
from ._policies import BangBang, Breathing, BreathPolicy, FeedForward, Summed
from ._runner import ABORT
from ._shooting import ShootingMPC
from ._tasks import double_compartment
from ._train import (
    fit_lungs,
    lung_environment,
    open_loop_error,
    stack,
    train_controllers,
    unstack,
)
from ._waveform import at_pip, BreathWaveform


SEEN = PIPS
UNSEEN = (12.5, 17.5, 22.5, 27.5, 32.5)
_SEEN_ONES, _UNSEEN_ONES = slice(len(SEEN)), slice(len(SEEN), None)
BREATH = 100
"""Steps of a whole breath, for the highest pressure."""
BETWEEN = ((10.0, 15.0), (10.0, 35.0), (35.0, 15.0), (35.0, 35.0))
"""Lungs between those that are trained on, (R, C)."""
TRUE_KP = (0.1, 0.2, 0.3, 0.5, 0.7, 1.0, 1.5, 2.0, 3.0, 5.0)
TRUE_KI = (0.0, 0.3, 1.0, 2.0, 3.0, 5.0, 10.0, 20.0)
TRUE_KD = (0.0, 0.01, 0.03)
_S = "dynamics.dynamics.system."


PHYSICS = (
    "single compartment",
    "balloon",
    "double compartment",
    "neural ODE",
    "grey box",
)


class Size(NamedTuple):
    """How much of everything."""

    breaths: int
    teacher_steps: int
    simulator_steps: int
    physics_steps: int
    controller_steps: int
    shared_steps: int
    pid_steps: int
    bound_steps: int
    seeds: int
    noises: int
    lungs: tuple[tuple[float, float], ...]
    physics: tuple[str, ...]
    extras: bool


FULL = Size(
    breaths=480,
    teacher_steps=1000,
    simulator_steps=1200,
    physics_steps=200,
    controller_steps=400,
    shared_steps=500,
    pid_steps=150,
    bound_steps=500,
    seeds=3,
    noises=5,
    lungs=tuple((R, C) for R in RESISTANCES for C in COMPLIANCES),
    physics=PHYSICS,
    extras=True,
)
SMALL = Size(
    breaths=96,
    teacher_steps=0,
    simulator_steps=250,
    physics_steps=40,
    controller_steps=100,
    shared_steps=100,
    pid_steps=20,
    bound_steps=150,
    seeds=1,
    noises=2,
    lungs=((5.0, 20.0), (50.0, 20.0)),
    physics=("single compartment",),
    extras=False,
)


def lung_name(resistance: float, compliance: float) -> str:
    """What a lung is called in the report."""
    return f"R{resistance:g}C{compliance:g}"


def physics_models(kind: str, count: int, dt: Any, delay: int, key: Any) -> Any:
    """Models of a kind, stacked, and what of them is fitted."""
    at = lambda *names: {_S + name: positive for name in names}  # noqa: E731
    if kind == "single compartment":
        systems = [SingleCompartment()] * count
        moved: Any = at("resistance", "compliance")
    elif kind == "balloon":
        systems = [BalloonLung()] * count
        moved = at("resistance", "stiffness", "rest")
    elif kind == "double compartment":
        begin: Any = dict(central=0.5, share=0.4, imbalance=3.0)
        systems = [DoubleCompartment(**begin)] * count
        moved = at("resistance", "compliance", "imbalance")
        moved |= {_S + "central": None, _S + "share": None}
    elif kind == "neural ODE":
        systems = [NeuralLung(key=k) for k in jr.split(key, count)]
        moved = None
    else:
        systems = [GreyBoxLung(key=k) for k in jr.split(key, count)]
        moved = [_S + name for name in ("network", "memory")]
        moved = {name: None for name in moved} | at(
            "single.resistance", "single.compliance"
        )
    return stack([LungModel(system, dt, delay) for system in systems]), moved


class _Study:
    """Where it is written, and how far it is."""

    def __init__(self, out: Path, size: Size, settings: dict[str, Any], say: Any):
        self.out, self.size, self.say = out, size, say
        self.began = time.perf_counter()
        self.seconds: dict[str, float] = {}
        known = out / "settings.json"
        out.mkdir(parents=True, exist_ok=True)
        (out / "controllers").mkdir(exist_ok=True)
        if known.exists():
            try:
                there = json.loads(known.read_text())
            except ValueError as error:
                raise ValueError(
                    f"lung: '{known}' is damaged ({error}); delete the folder, or name "
                    "another one with out."
                ) from None
            here = json.loads(json.dumps(settings))
            for name in sorted(here.keys() | there.keys()):
                if here.get(name) != there.get(name):
                    raise ValueError(
                        f"lung: '{out}' holds a study with other settings: {name} is "
                        f"{there.get(name)} there and {here.get(name)} here. Delete "
                        "the folder, or name another one with out."
                    )
        else:
            beside = known.with_suffix(".tmp")
            beside.write_text(json.dumps(settings, indent=1) + "\n")
            beside.replace(known)

    def fit_file(self, name: str) -> Path:
        """Where the training of a stage is kept until it is done."""
        return self.out / f"{name}.fit"

    def stage(self, name: str, words: str, make: Callable[[], Any]) -> Any:
        """What `make` returns, or what it returned before, from its file."""
        path = self.out / f"{name}.dlx"
        if path.exists():
            found = load(path)
            self.seconds[name] = float(found["seconds"])
            self.say(f"{words}: found ({self.seconds[name]:.0f} s then)")
            return found["value"]
        began = time.perf_counter()
        value = make()
        self.seconds[name] = time.perf_counter() - began
        save(path, {"value": value, "seconds": self.seconds[name]})
        for left in self.out.glob(f"{name}.fit*"):
            left.unlink()
        self.say(f"{words}: {self.seconds[name]:.0f} s")
        return value


def _runs(env, controller, pips, keys):
    """Errors over an inspiration and the highest pressures, shape `(keys, pips)`."""
    index = env.cost.index

    def one(pip, key):
        world, policy = at_pip((env, controller), pip)
        run = rollout(world, policy, key=key, horizon=BREATH, throw=False)
        assert run.costs is not None and run.states is not None
        return jnp.mean(run.costs[:LENGTH]), jnp.max(run.states[:, index])

    in_one = lambda key: jax.vmap(one, (0, None))(pips, key)  # noqa: E731
    return jax.vmap(in_one)(keys)


@eqx.filter_jit
def _evaluated(envs, controllers, pips, keys):
    """`_runs` of a controller in each lung; controllers stacked over lungs."""
    one = lambda env, c: _runs(env, c, pips, keys)  # noqa: E731
    return eqx.filter_vmap(one)(envs, controllers)


def _repeated(controller: Any, count: int) -> Any:
    return stack([controller] * count)


def lung_study(
    out: str | Path = "lung",
    *,
    small: bool = False,
    data: str | Path | None = None,
    seeds: int | None = None,
    say: Callable[[str], Any] = print,
) -> list[dict[str, Any]]:
    """Learn simulators of lungs from breaths, and controllers in the simulators; show
    how they do at the lungs themselves, beside the best PIDs.

    The lungs are those of the task `lung/double_compartment`, with the nine resistances
    and compliances of the public data set: valves that lag, a sensor that is two
    samples late and adds noise of 0.2 cmH2O. With `data`, the breaths are those of a
    file; then what stands in for the lungs themselves is a grey-box lung fitted to the
    same breaths, and there are no lungs between.

    Each part is written to the folder when it is done, so that a study that was cut off
    goes on from there.

    **Arguments:**

    - `out`: the folder to write to, `"lung"` by default. In it: `report.csv`,
        `simulators.csv`, `summary.json`, figures, `breath.gif`, the learned lungs
        (`simulators.dlx`) and the trained controllers (`controllers/*.dlx`), which
        `delucax.load` reads.
    - `small`: two lungs and little of everything, in less than a minute; false by
        default.
    - `data`: a file that [`delucax.lung.read_breaths`][] reads; none by default.
    - `seeds`: how many controllers of each kind are trained; 3 by default, and 1 if
        `small`.
    - `say`: what to do with a line of text; `print` by default.

    **Returns:** the rows of the report, dictionaries.

    **Raises:** `ValueError` if the folder holds a study with other settings, a file in
        it is damaged, or the data are not what they should be; `OSError` if a file
        cannot be read or written.

    !!! example

        ```python
        from delucax.lung import lung_study  # then: lung_study("out", small=True)
        ```
    """
    size = SMALL if small else FULL
    if seeds is not None:
        size = size._replace(seeds=seeds)
    if size.seeds < 1:
        raise ValueError(f"lung: seeds must be at least 1, got {seeds}.")
    recorded = None if data is None else read_breaths(data)
    settings = dict(size._asdict(), data=None if data is None else str(data))
    study = _Study(Path(out), size, settings, say)
    waveform = BreathWaveform()
    key = jr.key(0)

    if recorded is None:
        lungs = size.lungs
        breaths = study.stage("breaths", "Breaths", lambda: _explored(size))
    else:
        lungs, breaths = study.stage("breaths", "Breaths", lambda: _grouped(recorded))
        lungs = tuple((float(R), float(C)) for R, C in lungs)
    names = [lung_name(*lung) for lung in lungs]
    halves = [split(b, 1 / 6, key=jr.fold_in(key, 1)) for b in unstack_breaths(breaths)]
    train, test = (stack_breaths(list(part)) for part in zip(*halves, strict=True))
    dt = train.dt[0] if jnp.ndim(train.dt) else train.dt

    simulators = study.stage(
        "simulators",
        f"Learned lungs, all {len(lungs)} at once",
        lambda: _learned(train, size, key, study.fit_file("simulators")),
    )
    physics = {}
    kinds = size.physics
    if recorded is not None and "grey box" not in kinds:
        kinds = (*kinds, "grey box")
    for kind in kinds:
        name = kind.replace(" ", "_")
        physics[kind] = study.stage(
            name,
            f"Fitted {kind}, all {len(lungs)} at once",
            lambda kind=kind: _fitted(kind, train, size, dt, key),
        )
    table = _simulator_rows(names, test, {"learned": simulators, **physics})
    _write(study.out / "simulators.csv", table)

    if recorded is None:
        envs = stack([double_compartment(*lung) for lung in lungs])
        between = BETWEEN if not small else BETWEEN[2:3]
        around = [between[i % len(between)] for i in range(len(lungs))]
        others = stack([double_compartment(*lung) for lung in around])
    else:
        # What no controller was trained in stands in for the lungs.
        make = lambda m: lung_environment(m, waveform, horizon=100)  # noqa: E731
        envs = stack([make(model) for model in unstack(physics["grey box"])])
        between, others = (), None

    count = len(lungs)
    pid = study.stage(
        "pids", "PID grids", lambda: _pids(envs, simulators, waveform, size, key)
    )
    own = study.stage(
        "own",
        f"A network for each lung, {size.seeds} seeds at once",
        lambda: _policies(
            simulators, waveform, size, key, "mlp", study.fit_file("own")
        ),
    )
    extras: dict[str, Any] = {}
    if size.extras:
        few = size._replace(seeds=1)
        extras["CNN"] = study.stage(
            "own_cnn",
            "A convolutional network for each lung",
            lambda: _policies(
                simulators, waveform, few, key, "cnn", study.fit_file("own_cnn")
            ),
        )
        extras["PID + MLP"] = study.stage(
            "residual",
            "A PID and a network for each lung",
            lambda: _residual(simulators, pid, waveform, size, key),
        )
    shared = study.stage(
        "shared",
        f"A network for all lungs, {size.seeds} seeds at once",
        lambda: _shared(simulators, waveform, size, key, study.fit_file("shared")),
    )
    bound = study.stage(
        "bound",
        "The least error, with the lung at hand",
        lambda: _bounds(envs, size),
    )

    one_pid = {name: c for name, c in pid.items() if name.endswith("for all")}
    contenders: list[tuple[str, int, Any, bool]] = [
        ("zero", 0, _repeated(Constant([0.0]), count), True),
        ("bang-bang", 0, _repeated(BangBang(waveform), count), True),
    ]
    for name, controller in pid.items():
        single = name in one_pid
        stacked = _repeated(controller, count) if single else controller
        contenders.append((name, 0, stacked, single))
    for seed, controller in enumerate(unstack(own)):
        contenders.append(("MLP", seed, controller, False))
    if size.extras:
        plan = eqx.filter_vmap(ShootingMPC)(simulators, _repeated(waveform, count))
        contenders.append(("MPC", 0, plan, False))
    for name, controller in extras.items():
        contenders.append((name, 0, unstack(controller)[0], False))
    for seed, controller in enumerate(unstack(shared)):
        contenders.append(("MLP for all", seed, _repeated(controller, count), True))

    rows: list[dict[str, Any]] = []
    keys = jr.split(jr.fold_in(key, 99), size.noises)
    for label, seed, controller, is_shared in contenders:
        whole = _breathing(controller, waveform, count)
        found = _evaluated(envs, whole, jnp.asarray(SEEN + UNSEEN), keys)
        for part, here in (("seen", _SEEN_ONES), ("unseen", _UNSEEN_ONES)):
            rows += _rows(names, label, seed, part, *(a[..., here] for a in found))
        if is_shared and others is not None:
            # As many lungs as before, so that nothing compiles again.
            found = _evaluated(others, whole, jnp.asarray(SEEN + UNSEEN), keys)
            other_names = [lung_name(*lung) for lung in between]
            found = [a[: len(between), ..., _UNSEEN_ONES] for a in found]
            rows += _rows(other_names, label, seed, "between", *found)
    for part, values in bound.items():
        mae = np.asarray(values)
        rows += _rows(names, "least error", 0, part, mae[:, None, :], None)
    _write(study.out / "report.csv", rows)
    for label, seed, controller, is_shared in contenders:
        if label not in ("zero", "bang-bang"):
            _save_controllers(
                study.out, label, seed, controller, is_shared, names, waveform
            )

    summary = summarise(rows, table, study.seconds)
    text = json.dumps(summary, indent=1)
    (study.out / "summary.json").write_text(text + "\n")
    for line in summary["words"]:
        say(line)
    chosen = {
        "best PID": (_best_label(rows), "own"),
        "MLP": ("MLP", "own"),
        "MLP for all": ("MLP for all", "all"),
    }
    by_label = {label: c for label, seed, c, _ in contenders if seed == 0}
    shown = {
        name: by_label[label]
        for name, (label, _) in chosen.items()
        if label in by_label
    }
    _draw(study, envs, shown, names, test, simulators, physics, table, rows, waveform)
    say(f"Written to {study.out}/ in {time.perf_counter() - study.began:.0f} s.")
    return rows


def stack_breaths(parts: list[Breaths]) -> Breaths:
    """Breaths of several lungs as one, the fewest of each."""
    fewest = min(len(part) for part in parts)
    return stack([part[:fewest] for part in parts])


def unstack_breaths(breaths: Breaths) -> list[Breaths]:
    """The breaths of each lung."""
    return unstack(breaths)


def _explored(size: Size) -> Breaths:
    return stack_breaths(
        [
            explore(
                double_compartment(R, C),
                size.breaths,
                key=jr.key(i),
                resistance=R,
                compliance=C,
            )
            for i, (R, C) in enumerate(size.lungs)
        ]
    )


def _grouped(breaths: Breaths) -> Any:
    """The lungs of a file and the breaths of each."""
    R, C = np.asarray(breaths.resistance), np.asarray(breaths.compliance)
    lungs = sorted(set(zip(R.tolist(), C.tolist(), strict=True)))
    parts = [breaths[np.flatnonzero((R == r) & (C == c))] for r, c in lungs]
    fewest = min(len(part) for part in parts)
    if fewest < 6:
        worst = lungs[int(np.argmin([len(part) for part in parts]))]
        raise ValueError(
            f"lung: data must have at least 6 breaths of each lung, got {fewest} with "
            f"R = {worst[0]:g} and C = {worst[1]:g}."
        )
    return np.asarray(lungs), stack_breaths(parts)


def _learned(train: Breaths, size: Size, key: Any, file: Path) -> Any:
    keys = jr.split(jr.fold_in(key, 2), train.pressure.shape[0])
    parts = zip(unstack_breaths(train), keys, strict=True)
    models = stack([LearnedLung(part, key=own) for part, own in parts])
    return fit_lungs(
        models,
        train,
        key=jr.fold_in(key, 3),
        teacher_steps=size.teacher_steps,
        steps=size.simulator_steps,
        checkpoint=file,
    ).model


def _fitted(kind: str, train: Breaths, size: Size, dt: Any, key: Any) -> Any:
    count = train.pressure.shape[0]
    models, moved = physics_models(kind, count, dt, 2, jr.fold_in(key, 4))
    is_network = kind in ("neural ODE", "grey box")
    return fit_lungs(
        models,
        train,
        key=jr.fold_in(key, 5),
        steps=size.physics_steps * (2 if is_network else 1),
        learning_rate=1e-2 if is_network else 0.05,
        batch_size=32,
        trainable=moved,
    ).model


def _simulator_rows(names: list[str], test: Breaths, models: dict[str, Any]) -> Any:
    rows = []
    for kind, model in models.items():
        errors = eqx.filter_jit(eqx.filter_vmap(open_loop_error))(model, test)
        for name, error in zip(names, np.asarray(errors), strict=True):
            rows.append({"lung": name, "simulator": kind, "mae": float(error)})
    return rows


def _pids(envs: Any, simulators: Any, waveform: Any, size: Size, key: Any) -> Any:
    """The best of each kind for each lung, and for all."""
    key = jr.fold_in(key, 6)
    lists = dict(kp=TRUE_KP, ki=TRUE_KI, kd=TRUE_KD)
    grids = {
        "leaky PID": pid_grid(envs, key=key, kp=GAINS, ki=GAINS),
        "PID": pid_grid(envs, key=key, kind="true", **lists),
    }
    dt = envs.dt[0]
    found: dict[str, Any] = {}
    for name, grid in grids.items():
        make = lambda gains, kind=grid.kind: make_pid(gains, kind, dt, waveform)  # noqa: E731
        found[name] = stack([make(gains) for gains in grid.best()])
        found[f"{name} for all"] = make(grid.best_of_all())
    for name in ("leaky PID", "PID") if size.extras else ():
        for shared in (False, True):
            start = found[f"{name} for all"] if shared else found[name]
            options: Any = dict(steps=size.pid_steps, learning_rate=0.05, key=key)
            fitted = train_controllers(
                simulators, stack([start]), waveform=waveform, shared=shared, **options
            )
            suffix = " for all" if shared else ""
            found[f"trained {name}{suffix}"] = unstack(fitted.model)[0]
    if not size.extras:
        return found
    weak: Any = 0.3
    forward = stack([FeedForward(waveform, weak)] * len(found["PID"].kp))
    both = eqx.filter_vmap(lambda a, b: Summed(a, b))(found["PID"], forward)
    fitted = train_controllers(
        simulators,
        stack([both]),
        waveform=waveform,
        steps=2 * size.pid_steps,
        learning_rate=0.05,
        key=key,
    )
    found["PID + feed-forward"] = unstack(fitted.model)[0]
    return found


def _policies(
    simulators: Any, waveform: Any, size: Size, key: Any, kind: Any, file: Path
) -> Any:
    count = simulators.hidden.shape[0]
    dt = simulators.dt[0]
    keys = jr.split(jr.fold_in(key, 7), (size.seeds, count))
    width = 32 if kind == "mlp" else 12
    start = stack(
        [
            stack([BreathPolicy(waveform, dt, kind, width, key=k) for k in row])
            for row in keys
        ]
    )
    return train_controllers(
        simulators,
        start,
        waveform=waveform,
        steps=size.controller_steps,
        key=jr.fold_in(key, 8),
        checkpoint=file,
    ).model


def _residual(simulators: Any, pid: Any, waveform: Any, size: Size, key: Any) -> Any:
    count = simulators.hidden.shape[0]
    keys = jr.split(jr.fold_in(key, 9), count)
    policies = stack([BreathPolicy(waveform, simulators.dt[0], key=k) for k in keys])
    offset = 100 * jax.nn.sigmoid(jnp.asarray(-2.0))
    make = lambda a, b: Summed(a, b, offset=offset)  # noqa: E731
    start = stack([eqx.filter_vmap(make)(pid["leaky PID"], policies)])
    return train_controllers(
        simulators,
        start,
        waveform=waveform,
        steps=size.controller_steps,
        key=jr.fold_in(key, 10),
    ).model


def _shared(simulators: Any, waveform: Any, size: Size, key: Any, file: Path) -> Any:
    keys = jr.split(jr.fold_in(key, 11), size.seeds)
    options: Any = dict(width=48, controls=6)
    dt = simulators.dt[0]
    start = stack([BreathPolicy(waveform, dt, **options, key=k) for k in keys])
    return train_controllers(
        simulators,
        start,
        waveform=waveform,
        shared=True,
        steps=size.shared_steps,
        key=jr.fold_in(key, 12),
        checkpoint=file,
    ).model


def _bounds(envs: Environment, size: Size) -> dict[str, Any]:
    of = lambda pips: lambda env: least_error(env, pips=pips, steps=size.bound_steps)  # noqa: E731
    return {
        part: eqx.filter_vmap(of(pips))(envs)
        for part, pips in (("seen", SEEN), ("unseen", UNSEEN))
    }


def _breathing(controllers: Any, waveform: BreathWaveform, count: int) -> Any:
    return eqx.filter_vmap(Breathing)(controllers, _repeated(waveform, count))


def _rows(names, label, seed, part, mae, highest):
    """A row for each lung, averaged over noise and peak pressures."""
    rows = []
    for i, name in enumerate(names):
        row = {"lung": name, "controller": label, "seed": seed, "split": part}
        row["mae"] = float(np.mean(mae[i]))
        row["highest"] = "" if highest is None else float(np.max(highest[i]))
        rows.append(row)
    return rows


def _write(path: Path, rows: list[dict[str, Any]]) -> None:
    beside = path.with_suffix(".tmp")
    with open(beside, "w", newline="") as file:
        writer = csv.DictWriter(file, rows[0].keys())
        writer.writeheader()
        writer.writerows(rows)
    beside.replace(path)


def _save_controllers(out, label, seed, controller, is_shared, names, waveform):
    """Each as a controller of both valves, ready for a task."""
    stem = label.lower().replace(" + ", "_").replace(" ", "_").replace("-", "_")
    folder = out / "controllers"
    if is_shared:
        alone = jax.tree.map(lambda a: a[0] if eqx.is_array(a) else a, controller)
        save(folder / f"{stem}_{seed}.dlx", Breathing(alone, waveform))
        return
    for name, alone in zip(names, unstack(controller), strict=True):
        save(folder / f"{stem}_{name}_{seed}.dlx", Breathing(alone, waveform))


WRONG = ("single compartment", "balloon")
"""Physics that the lungs of the study do not have."""
PID_ROWS = ("leaky PID", "PID", "trained leaky PID", "trained PID")


def _mean(rows, label, part, lung=None):
    found = [
        row["mae"]
        for row in rows
        if row["controller"] == label
        and row["split"] == part
        and lung in (None, row["lung"])
    ]
    return float(np.mean(found)) if found else float("nan")


def _best_label(rows: list[dict[str, Any]]) -> str:
    there = [label for label in PID_ROWS if _mean(rows, label, "unseen") > 0]
    return min(there, key=lambda label: _mean(rows, label, "unseen"))


def _least(values: Any) -> float:
    """The least of the numbers that there are."""
    return min((value for value in values if value == value), default=float("nan"))


def summarise(
    rows: list[dict[str, Any]], table: list[dict[str, Any]], seconds: dict[str, float]
) -> dict[str, Any]:
    """The figures that the study is about, and sentences of them."""
    names = list(dict.fromkeys(row["lung"] for row in table))
    simulators = {
        kind: {row["lung"]: row["mae"] for row in table if row["simulator"] == kind}
        for kind in dict.fromkeys(row["simulator"] for row in table)
    }
    wrong = {
        name: min(simulators[k][name] for k in WRONG if k in simulators)
        for name in names
    }
    ratios = {name: simulators["learned"][name] / wrong[name] for name in names}
    gains = {}
    for name in names:
        pid = _least(_mean(rows, label, "unseen", name) for label in PID_ROWS)
        gains[name] = _mean(rows, "MLP", "unseen", name) / pid
    shared = {}
    for part in ("unseen", "between"):
        labels = [f"{label} for all" for label in PID_ROWS]
        pid = _least(_mean(rows, label, part) for label in labels)
        shared[part] = _mean(rows, "MLP for all", part) / pid
    shipped = [row["highest"] for row in rows if "MLP" in row["controller"]]
    highest = max(shipped)
    learned = simulators["learned"].values()
    words = [
        f"Learned lungs: open-loop error {np.mean(list(learned)):.3f} cmH2O on "
        f"average, {max(learned):.3f} at most; relative to the better of single "
        f"compartment and balloon at most {max(ratios.values()):.2f}.",
        "A network for each lung: its error over that of the best PID is "
        f"{np.mean(list(gains.values())):.2f} on average, {max(gains.values()):.2f} at "
        "most, at peak pressures that are not trained on.",
        f"A network for all lungs, over the best PID for all: {shared['unseen']:.2f} "
        f"on the lungs of the training, {shared['between']:.2f} on lungs between.",
        f"The highest pressure with a network: {highest:.1f} cmH2O; the limit is "
        f"{ABORT:g}.",
    ]
    return dict(
        simulators=simulators,
        learned_over_wrong_physics=ratios,
        network_over_best_pid=gains,
        shared_over_best_pid=shared,
        highest_pressure=highest,
        abort=ABORT,
        seconds=seconds,
        words=words,
    )


def _draw(
    study, envs, shown, names, test, simulators, physics, table, rows, waveform
) -> None:
    """The figures, where Matplotlib is there."""
    try:
        from ._figures import draw_study
    except ImportError:
        study.say("No figures: they need matplotlib (pip install 'delucax[plot]').")
        return
    draw_study(
        study.out, envs, shown, names, test, simulators, physics, table, rows, waveform
    )
