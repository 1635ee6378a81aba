"""The results of the ventilator study: its rows, saved controllers and summary."""

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from ... import lung
from ..._module import save, stack, unstack
from ..._typing import PRNGKey
from ...environments import Environment
from ._contenders import Contender
from ._simulators import closed_loop
from ._stages import ABORT, BREATH, SHOWN, TEST_PIPS, TRAIN_PIPS


Rows = list[dict[str, Any]]
Lungs = tuple[Environment, list[str]]
"""Stacked tasks of lungs, and their names."""
Which = tuple[str, int]
"""The label of a controller, and its seed."""
WRONG = ("single compartment", "balloon")
"""The models whose physics is not that of the lungs of the study."""
PID_ROWS = (
    *("leaky PID", "PID", "trained leaky PID", "trained PID", "PID + feed-forward"),
    *("tuned PID + feed-forward", "tuned leaky PID + feed-forward"),
)
FLOORS = ("zero", "bang-bang")
SPLITS = {"seen": slice(len(TRAIN_PIPS)), "unseen": slice(len(TRAIN_PIPS), None)}
"""The slices of the peak pressures `TRAIN_PIPS + TEST_PIPS`, by the names in the
report."""
LEARNED = ("MLP", "MLP for all", "CNN", "PID + MLP", "GPC", "MPC")


def error_rows(
    contenders: list[Contender], lungs: Lungs, between: Lungs | None, keys: PRNGKey
) -> tuple[Rows, dict[str, Any]]:
    """The error of each controller in each lung, averaged over noise and pressures.
    Also, by label, a breath of the first seed in each lung, at the pressure `SHOWN`.

    `between` are as many other lungs, and the names of those that count. Shared
    controllers are run in these lungs too.
    """
    (envs, names), rows, runs = lungs, [], {}
    pips, count = jnp.asarray(TRAIN_PIPS + TEST_PIPS), len(names)
    waveforms = envs.cost.waveform  # pyright: ignore[reportAttributeAccessIssue]
    place = (TRAIN_PIPS + TEST_PIPS).index(SHOWN)
    for label, seed, controllers, shared in contenders:
        each = stack([controllers] * count) if shared else controllers
        whole = eqx.filter_vmap(lung.Breathing)(each, waveforms)
        *errors, breaths = closed_loop(envs, whole, pips, keys, BREATH)
        runs.setdefault(label, jax.tree.map(lambda a: a[:, 0, place], breaths))
        rows += rows_of(names, (label, seed), *errors)
        if shared and between is not None:
            # The number of lungs is the same, so that nothing compiles again.
            others, other_names = between
            *errors, _ = closed_loop(others, whole, pips, keys, BREATH)
            splits = {"between": SPLITS["unseen"]}
            rows += rows_of(other_names, (label, seed), *errors, splits)
    return rows, runs


def rows_of(
    names: list[str], run: Which, errors: Any, highest: Any = None, splits: Any = SPLITS
) -> Rows:
    """A row for each lung and each split of the peak pressures, which are the last axis
    of `errors` and `highest`."""
    (label, seed), rows = run, []
    for split, at in splits.items():
        of_split = errors[..., at]
        most = None if highest is None else np.asarray(highest)[..., at]
        for i, name in enumerate(names):
            row: Any = dict(lung=name, controller=label, seed=seed, split=split)
            row["mae"] = float(np.mean(of_split[i]))
            row["highest"] = "" if most is None else float(np.max(most[i]))
            rows.append(row)
    return rows


def save_controllers(
    folder: Path, contenders: list[Contender], names: list[str], rows: Rows
) -> list[str]:
    """Save each controller as a controller of both valves, ready for a task.

    A controller is not saved if a pressure passed the abort limit. Returns the names of
    these controllers.
    """
    unsafe = []
    for label, seed, controllers, shared in contenders:
        if label in FLOORS:
            continue
        stem = label.lower().replace(" + ", "_").replace(" ", "_").replace("-", "_")
        runs = [r for r in rows if (r["controller"], r["seed"]) == (label, seed)]
        # A shared controller is saved once, and judged by its runs in all lungs.
        each = [controllers] if shared else unstack(controllers)
        for name, controller in zip([None] if shared else names, each, strict=True):
            file = folder / f"{stem if name is None else f'{stem}_{name}'}_{seed}.dlx"
            reached = [r["highest"] for r in runs if name in (None, r["lung"])]
            # NaN is not below the limit.
            if np.max(reached) <= ABORT:
                save(file, lung.Breathing(controller, lung.BreathWaveform()))
            else:
                file.unlink(missing_ok=True)
                unsafe.append(file.stem)
    return unsafe


def mean_error(rows: Rows, label: str, split: str, lung: str | None = None) -> float:
    """The mean error of a controller over its seeds, in one lung or in all; NaN if it
    was not run."""
    of = lambda row: (row["controller"], row["split"]) == (label, split)
    errors = [r["mae"] for r in rows if of(r) and lung in (None, r["lung"])]
    return float(np.mean(errors)) if errors else float("nan")


def best_of(
    rows: Rows, labels: Iterable[str], split: str, lung: str | None = None
) -> tuple[float, str]:
    """The least error of some controllers, and its label; NaN if none was run."""
    errors = {label: mean_error(rows, label, split, lung) for label in labels}
    known = ((e, label) for label, e in errors.items() if not np.isnan(e))
    return min(known, default=(float("nan"), ""))


def _by_kind(table: Rows, column: str) -> dict[str, dict[str, float]]:
    """A column of the table of simulators, by kind and lung; empty if it is missing."""
    columns: dict[str, dict[str, float]] = {}
    for row in table:
        if column in row:
            columns.setdefault(row["simulator"], {})[row["lung"]] = row[column]
    return columns


def summarise(
    rows: Rows, table: Rows, seconds: dict[str, float], judge: str, unsafe: list[str]
) -> dict[str, Any]:
    """The key figures of the study, and sentences about them.

    `judge` says in what the controllers were run, and `unsafe` names the controllers
    that were not saved.
    """
    simulators = _by_kind(table, "mae")
    learned = simulators["learned"]
    names = [kind for kind in WRONG if kind in simulators]
    wrong = [simulators[kind] for kind in names]
    ratios = {name: e / min(w[name] for w in wrong) for name, e in learned.items()}
    gains, bounds = {}, {}
    for name in learned:
        pid, _ = best_of(rows, PID_ROWS, "unseen", name)
        gains[name] = mean_error(rows, "MLP", "unseen", name) / pid
        least = mean_error(rows, "least error", "unseen", name)
        bounds |= {name: least / pid} if least > 0 else {}
    for_all = [f"{label} for all" for label in PID_ROWS]
    shared = {
        split: mean_error(rows, "MLP for all", split) / best_of(rows, for_all, split)[0]
        for split in ("unseen", "between")
    }
    reached = [row["highest"] for row in rows if row["controller"] in LEARNED]
    highest = float(np.max(reached))
    error, gain = np.array([*learned.values()]), np.array([*gains.values()])
    between = shared["between"]
    on_others = "" if np.isnan(between) else f"; on lungs between those, {between:.2f}"
    words = [
        "The learned lungs predict the pressure from the controls alone with a mean "
        f"error of {error.mean():.3f} cmH2O ({error.max():.3f} on the worst lung). "
        f"This is at most {max(ratios.values()):.2f} times the error of physical "
        f"models with the wrong structure ({', '.join(names)}).",
        f"With a network for each lung, the error is {gain.mean():.2f} times that of "
        f"the best PID ({gain.max():.2f} on the worst lung), at peak pressures that "
        "the network was not trained on.",
        "With one network for all lungs, the error is "
        f"{shared['unseen']:.2f} times that of the best PID for all lungs{on_others}.",
        "The highest pressure under a learned controller was "
        f"{highest:.1f} cmH2O; the limit is {ABORT:g}.",
        f"The controllers were tested in {judge}.",
    ]
    if unsafe:
        lost = ", ".join(unsafe)
        words.append(f"Not saved, because the pressure passed the limit: {lost}.")
    return dict(
        simulators=simulators,
        simulators_closed_loop=_by_kind(table, "closed_loop_mae"),
        learned_over_wrong_physics=ratios,
        network_over_best_pid=gains,
        least_error_over_best_pid=bounds,
        shared_over_best_pid=shared,
        highest_pressure=highest,
        abort=ABORT,
        judged_in=judge,
        not_saved=unsafe,
        seconds=seconds,
        words=words,
    )
