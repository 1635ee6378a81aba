"""How the controllers of the study do at the lungs: its rows, figures and words."""

from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from ..._module import save
from ...environments import Environment
from ...lung._data import LENGTH
from ...lung._policies import Breathing
from ...lung._runner import ABORT
from ...lung._stacking import count_of, repeat, taken, unstack
from ...lung._waveform import at_pip, BreathWaveform
from ...simulation import rollout
from ._contenders import Contender
from ._size import BREATH, SEEN, SHOWN, UNSEEN


Rows = list[dict[str, Any]]
WRONG = ("single compartment", "balloon")
"""Physics that the lungs of the study do not have."""
PID_ROWS = (
    "leaky PID",
    "PID",
    "trained leaky PID",
    "trained PID",
    "PID + feed-forward",
    "tuned PID + feed-forward",
    "tuned leaky PID + feed-forward",
)
FLOORS = ("zero", "bang-bang")
LEARNED = ("MLP", "MLP for all", "CNN", "PID + MLP", "GPC", "MPC")


@eqx.filter_jit
def _evaluated(envs, controllers, pips, keys):
    """Errors over an inspiration and the highest pressures of a controller in each
    lung, and the breaths, shape `(lungs, keys, pips)`; controllers stacked."""

    def in_lung(env, controller):
        index = env.cost.index

        def one(pip, key):
            world, policy = at_pip((env, controller), pip)
            run = rollout(world, policy, key=key, horizon=BREATH, throw=False)
            assert run.costs is not None and run.states is not None
            highest = jnp.max(run.states[:, index])
            return jnp.mean(run.costs[:LENGTH]), highest, run

        return jax.vmap(lambda key: jax.vmap(one, (0, None))(pips, key))(keys)

    return eqx.filter_vmap(in_lung)(envs, controllers)


def breathing(controllers: Any, waveform: BreathWaveform) -> Any:
    """Controllers of the inspiratory valve, stacked, made ones of both valves."""
    waveforms = repeat(waveform, count_of(controllers))
    return eqx.filter_vmap(Breathing)(controllers, waveforms)


def error_rows(
    contenders: list[Contender],
    envs: Environment,
    names: list[str],
    waveform: BreathWaveform,
    keys: Any,
    between: tuple[Environment, list[str]] | None,
) -> tuple[Rows, dict[str, Any]]:
    """The error of each controller in each lung, averaged over noise and pressures; and
    by label a breath of the first seed in each, at the pressure `SHOWN`.

    `between` are other lungs, as many as the first, and the names of those that count:
    controllers that are the same for all lungs are run in them too.
    """
    rows: Rows = []
    runs: dict[str, Any] = {}
    pips = jnp.asarray(SEEN + UNSEEN)
    place = (SEEN + UNSEEN).index(SHOWN)
    parts = (("seen", slice(len(SEEN))), ("unseen", slice(len(SEEN), None)))
    for label, seed, controllers, shared in contenders:
        whole = breathing(controllers, waveform)
        *found, breaths = _evaluated(envs, whole, pips, keys)
        runs.setdefault(label, taken(breaths, (slice(None), 0, place)))
        for part, here in parts:
            columns = (array[..., here] for array in found)
            rows += _rows(names, label, seed, part, *columns)
        if shared and between is not None:
            # As many lungs as before, so that nothing compiles again.
            others, other_names = between
            *found, _ = _evaluated(others, whole, pips, keys)
            here = slice(len(other_names)), Ellipsis, parts[1][1]
            columns = (array[here] for array in found)
            rows += _rows(other_names, label, seed, "between", *columns)
    return rows, runs


def bound_rows(names: list[str], bound: Any) -> Rows:
    """Rows of the least errors, shape `(lungs, pips)`."""
    return [
        row
        for part, here in (
            ("seen", slice(len(SEEN))),
            ("unseen", slice(len(SEEN), None)),
        )
        for row in _rows(names, "least error", 0, part, bound[:, here], None)
    ]


def _rows(names, label, seed, part, mae, highest) -> Rows:
    rows = []
    for i, name in enumerate(names):
        row = {"lung": name, "controller": label, "seed": seed, "split": part}
        row["mae"] = float(np.mean(mae[i]))
        row["highest"] = "" if highest is None else float(np.max(highest[i]))
        rows.append(row)
    return rows


def save_controllers(
    folder: Path,
    contenders: list[Contender],
    names: list[str],
    waveform: Any,
    rows: Rows,
) -> list[str]:
    """Each as a controller of both valves, ready for a task; returned are the names of
    those that are not saved, for a pressure of theirs passed the abort limit."""
    unsafe = []
    for label, seed, controllers, shared in contenders:
        if label in FLOORS:
            continue
        stem = label.lower().replace(" + ", "_").replace(" ", "_").replace("-", "_")
        alone = unstack(controllers)
        made = [(stem, alone[0], None)]
        if not shared:
            each = zip(names, alone, strict=True)
            made = [(f"{stem}_{name}", controller, name) for name, controller in each]
        for place, controller, name in made:
            runs = [
                row for row in rows if (row["controller"], row["seed"]) == (label, seed)
            ]
            runs = [row for row in runs if name in (None, row["lung"])]
            file = folder / f"{place}_{seed}.dlx"
            # NaN is not below the limit.
            if np.max([row["highest"] for row in runs]) <= ABORT:
                save(file, Breathing(controller, waveform))
            else:
                file.unlink(missing_ok=True)
                unsafe.append(file.stem)
    return unsafe


def mean_error(rows: Rows, label: str, part: str, lung: str | None = None) -> float:
    """Of a controller, over its seeds, in one lung or all; NaN if it was not run."""
    found = [
        row["mae"]
        for row in rows
        if row["controller"] == label
        and row["split"] == part
        and lung in (None, row["lung"])
    ]
    return float(np.mean(found)) if found else float("nan")


def best_pid(rows: Rows) -> str:
    """The kind of PID with the least error at pressures that were not trained on."""
    errors = {label: mean_error(rows, label, "unseen") for label in PID_ROWS}
    there = [label for label in PID_ROWS if errors[label] > 0]
    return min(there, key=lambda label: errors[label])


def _least(values: Any) -> float:
    """The least of the numbers that there are."""
    return min((value for value in values if value == value), default=float("nan"))


def _by_kind(table: Rows, column: str) -> dict[str, dict[str, float]]:
    """A column of the table of the simulators, by kind and lung; empty without it."""
    found: dict[str, dict[str, float]] = {}
    for row in table:
        if column in row:
            found.setdefault(row["simulator"], {})[row["lung"]] = row[column]
    return found


def summarise(
    rows: Rows,
    table: Rows,
    seconds: dict[str, float],
    judge: str,
    unsafe: list[str],
) -> dict[str, Any]:
    """The figures that the study is about, and sentences of them.

    `judge` says what the controllers were run in, and `unsafe` names those that were
    not saved."""
    names = list(dict.fromkeys(row["lung"] for row in table))
    simulators = _by_kind(table, "mae")
    learned = simulators["learned"]
    wrong = {
        name: min(simulators[kind][name] for kind in WRONG if kind in simulators)
        for name in names
    }
    ratios = {name: learned[name] / wrong[name] for name in names}
    gains, room = {}, {}
    for name in names:
        pid = _least(mean_error(rows, label, "unseen", name) for label in PID_ROWS)
        gains[name] = mean_error(rows, "MLP", "unseen", name) / pid
        least = mean_error(rows, "least error", "unseen", name)
        room |= {name: least / pid} if least > 0 else {}
    shared = {}
    for part in ("unseen", "between"):
        labels = [f"{label} for all" for label in PID_ROWS]
        pid = _least(mean_error(rows, label, part) for label in labels)
        shared[part] = mean_error(rows, "MLP for all", part) / pid
    reached = [row["highest"] for row in rows if row["controller"] in LEARNED]
    highest = float(np.max(reached))
    words = [
        f"Learned lungs: open-loop error {np.mean(list(learned.values())):.3f} cmH2O "
        f"on average, {max(learned.values()):.3f} at most; relative to the better of "
        f"single compartment and balloon at most {max(ratios.values()):.2f}.",
        "A network for each lung: its error over that of the best PID is "
        f"{np.mean(list(gains.values())):.2f} on average, {max(gains.values()):.2f} at "
        "most, at peak pressures that are not trained on.",
        f"A network for all lungs, over the best PID for all: {shared['unseen']:.2f} "
        f"on the lungs of the training, {shared['between']:.2f} on lungs between.",
        f"The highest pressure with what was learned: {highest:.1f} cmH2O; the limit "
        f"is {ABORT:g}.",
        f"Controllers were judged in {judge}.",
    ]
    if unsafe:
        words.append(f"Not saved, for they passed the limit: {', '.join(unsafe)}.")
    return dict(
        simulators=simulators,
        simulators_closed_loop=_by_kind(table, "closed_loop_mae"),
        learned_over_wrong_physics=ratios,
        network_over_best_pid=gains,
        least_error_over_best_pid=room,
        shared_over_best_pid=shared,
        highest_pressure=highest,
        abort=ABORT,
        judged_in=judge,
        not_saved=unsafe,
        seconds=seconds,
        words=words,
    )
