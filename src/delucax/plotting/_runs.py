"""What there is to draw in a trajectory: plain NumPy arrays, and panels for them."""

import dataclasses
import math
from collections.abc import Mapping, Sequence
from typing import Any, TypeAlias

import jax
import numpy as np

from .._check import is_concrete
from ..simulation import Trajectory


Trajectories: TypeAlias = Trajectory | Mapping[Any, Trajectory] | Sequence[Trajectory]
KINDS = ("states", "controls", "costs", "observations", "disturbances")
HELD = ("controls", "disturbances")
MOST_LINES = 6


@dataclasses.dataclass(frozen=True)
class Run:
    """A labelled trajectory, or a batch of them, ready to draw.

    Every array of `series` has shape `(batch, T + 1, size)`, and is NaN where the
    trajectory has ended or is not finite. A series that is held over a step has its
    last value repeated at the end of the last step. Of `incidents` there are those that
    happened, booleans of shape `(batch, T)`.
    """

    label: str
    times: np.ndarray
    series: dict[str, np.ndarray]
    ends: np.ndarray
    failed: np.ndarray
    terminated: np.ndarray
    incidents: dict[str, np.ndarray]
    total_costs: np.ndarray
    batched: bool
    trajectory: Trajectory

    @property
    def same_times(self) -> bool:
        """Whether all members of the batch share their times."""
        return bool(np.all(self.times == self.times[:1]))


@dataclasses.dataclass(frozen=True)
class Panel:
    """Columns of one kind of series that share a unit, and so an axis."""

    kind: str
    columns: tuple[int, ...]
    names: tuple[str, ...]
    unit: str


def as_runs(given: Any, labels: Any, argument: str, where: str) -> list[Run]:
    """`given` (a trajectory, a mapping or a sequence of them) as runs, or an error."""
    if isinstance(given, Trajectory):
        pairs = [("", given)]
    elif isinstance(given, Mapping):
        if labels is not None:
            raise ValueError(
                f"{where}: labels must not be given with a dictionary, whose keys are "
                f"the labels; got {labels!r}."
            )
        pairs = [(str(label), trajectory) for label, trajectory in given.items()]
    elif isinstance(given, Sequence) and not isinstance(given, str):
        pairs = [(f"trajectory {i}", trajectory) for i, trajectory in enumerate(given)]
    else:
        raise ValueError(
            f"{where}: {argument} must be a Trajectory, or a dictionary or sequence of "
            f"them, got {type(given).__name__}."
        )
    if not pairs:
        raise ValueError(f"{where}: {argument} must not be empty.")
    if labels is not None:
        labels = [labels] if isinstance(labels, str) else labels
        if not isinstance(labels, Sequence) or len(labels) != len(pairs):
            raise ValueError(
                f"{where}: labels must be {len(pairs)} strings, one a trajectory, got "
                f"{labels!r}."
            )
        pairs = [(str(a), pair[1]) for a, pair in zip(labels, pairs, strict=True)]
    runs = []
    for label, trajectory in pairs:
        what = f"{argument}[{label!r}]" if label else argument
        if not isinstance(trajectory, Trajectory):
            raise ValueError(
                f"{where}: {what} must be a Trajectory, got "
                f"{type(trajectory).__name__}."
            )
        runs.append(_run(label, trajectory, what, where))
        for name in ("state_names", "control_names"):
            first, here = getattr(pairs[0][1], name), getattr(trajectory, name)
            if here != first:
                raise ValueError(
                    f"{where}: {what} has {name} {here}, but the first trajectory has "
                    f"{first}; only the same plant can be compared."
                )
    return runs


def _run(label: str, trajectory: Trajectory, what: str, where: str) -> Run:
    if trajectory.states is None:
        raise ValueError(
            f"{where}: {what} holds no states; keep them in the rollout, such as "
            'keep=("states", "controls", "costs").'
        )
    if not all(is_concrete(leaf) for leaf in jax.tree.leaves(trajectory)):
        raise ValueError(
            f"{where}: {what} must hold values, got traced arrays; draw outside of "
            "jax.jit and jax.vmap."
        )
    lead = len(trajectory.batch_shape)
    steps, members = trajectory.steps, math.prod(trajectory.batch_shape)

    def flat(array: Any) -> np.ndarray:
        array = np.asarray(array)
        return array.reshape((members,) + array.shape[lead:])

    shape = (*trajectory.batch_shape, steps + 1)
    times = flat(np.broadcast_to(trajectory.times, shape))
    ends = flat(trajectory.length).astype(int)
    terminated = flat(np.broadcast_to(trajectory.ended, trajectory.batch_shape))
    failed = flat(np.broadcast_to(trajectory.failed, trajectory.batch_shape))
    incidents = {
        name: flat(steps)
        for name, steps in (trajectory.incidents or {}).items()
        if np.any(steps)
    }
    series = {}
    for kind in KINDS:
        array = getattr(trajectory, kind)
        if array is None:
            continue
        array = flat(array)
        array = array[..., None] if kind == "costs" else array
        series[kind] = _until(array, ends, steps, kind)
    return Run(
        label=label,
        times=times,
        series=series,
        ends=ends,
        failed=failed,
        terminated=terminated,
        incidents=incidents,
        total_costs=flat(trajectory.total_cost),
        batched=lead > 0,
        trajectory=trajectory,
    )


def _until(array: np.ndarray, ends: np.ndarray, steps: int, kind: str) -> np.ndarray:
    """`array` with `steps + 1` entries in time and NaN after the end of each member."""
    array = np.where(np.isfinite(array), array, np.nan).astype(float)
    index = np.arange(steps + 1)[None, :, None]
    ends = ends[:, None, None]
    if kind == "states":
        return np.where(index <= ends, array, np.nan)
    array = np.pad(array, ((0, 0), (0, 1), (0, 0)), constant_values=np.nan)
    if kind in HELD and steps:
        array[:, 1:] = np.where(index[:, 1:] == ends, array[:, :-1], array[:, 1:])
        return np.where(index <= ends, array, np.nan)
    return np.where(index < ends, array, np.nan)


def last_seen(run: Run) -> np.ndarray:
    """The index in time of the last finite state of each member, shape `(batch,)`."""
    finite = np.all(np.isfinite(run.series["states"]), axis=-1)
    last = finite.shape[1] - 1 - np.argmax(finite[:, ::-1], axis=1)
    return np.where(finite.any(axis=1), last, 0)


def names_and_units(run: Run, kind: str) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """The names and units of a kind of series; `""` for a unit that is not known."""
    trajectory = run.trajectory
    size = run.series[kind].shape[-1]
    if kind == "states":
        names, units = trajectory.state_names, trajectory.state_units
    elif kind == "controls":
        names, units = trajectory.control_names, trajectory.control_units
    elif kind == "costs":
        names, units = ("cost",), ()
    else:
        names, units = tuple(f"{'yw'[kind[0] == 'd']}{i}" for i in range(size)), ()
    return tuple(names), tuple(units) if len(units) == size else ("",) * size


def panels_of(run: Run, show: Any, *, grouped: bool, where: str) -> list[Panel]:
    """The panels for what `show` names: one a unit if `grouped`, else one a series."""
    chosen: dict[str, list[int]] = {}
    kept = {kind: names_and_units(run, kind) for kind in KINDS if kind in run.series}
    if show is None:
        show = [kind for kind in ("states", "controls", "costs") if kind in kept]
    show = [show] if isinstance(show, str) else show
    if not isinstance(show, Sequence) or not show:
        raise ValueError(
            f"{where}: show must name what to draw, such as ('states', 'costs'), got "
            f"{show!r}."
        )
    for name in show:
        if name in kept:
            chosen[name] = list(range(len(kept[name][0])))
            continue
        found = [kind for kind in kept if name in kept[kind][0]]
        if not found:
            names = [n for kind in kept for n in (kind, *kept[kind][0])]
            raise ValueError(
                f"{where}: show must be among {', '.join(dict.fromkeys(names))} (what "
                f"the trajectory kept), got {name!r}."
            )
        column = kept[found[0]][0].index(name)
        columns = chosen.setdefault(found[0], [])
        if column not in columns:
            columns.append(column)
    panels = []
    for kind, columns in chosen.items():
        names, units = kept[kind]
        groups: dict[Any, list[int]] = {}
        for column in columns:
            groups.setdefault(units[column] if grouped else column, []).append(column)
        for group in groups.values():
            count = -(-len(group) // MOST_LINES)
            for part in np.array_split(group, count):
                part = tuple(int(i) for i in part)
                panels.append(
                    Panel(kind, part, tuple(names[i] for i in part), units[part[0]])
                )
    return panels


def time_label(run: Run) -> str:
    """`"time [s]"`, in the unit of a plant that names units; else `"time"`."""
    trajectory = run.trajectory
    named = any((*trajectory.state_units, *trajectory.control_units))
    return f"time [{trajectory.time_unit}]" if named else "time"
