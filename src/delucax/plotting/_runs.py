"""Trajectories as labelled arrays, and the panels that show them."""

import dataclasses
import functools
import math
import operator
from collections.abc import Mapping, Sequence
from typing import Any, TypeAlias

import jax
import numpy as np
from jaxtyping import Bool, Float, Int

from .._check import check_instance, is_concrete
from .._module import indexed_names
from ..simulation import Trajectory
from ._path import Path, path_of


Trajectories: TypeAlias = Trajectory | Mapping[Any, Trajectory] | Sequence[Trajectory]
Series: TypeAlias = Float[np.ndarray, "batch times size"]
KINDS = ("states", "controls", "costs", "observations", "disturbances")
HELD = ("controls", "disturbances")
MOST_LINES = 6
FEW = 8


@dataclasses.dataclass(frozen=True)
class Run:
    """A labelled trajectory, or a batch of them, ready to draw.

    Every array of `series` has shape `(batch, T + 1, size)`. It is NaN after the end of
    the trajectory and where it is not finite. A series that is held over each step
    repeats its last value at the end of the last step. `incidents` holds the kinds that
    happened, as booleans of shape `(batch, T)`. A member has `failed`, has
    `terminated`, or neither.
    """

    label: str
    times: Float[np.ndarray, "batch times"]
    series: dict[str, Series]
    failed: Bool[np.ndarray, " batch"]
    terminated: Bool[np.ndarray, " batch"]
    incidents: dict[str, Bool[np.ndarray, "batch steps"]]
    total_costs: Float[np.ndarray, " batch"]
    trajectory: Trajectory

    @functools.cached_property
    def as_band(self) -> bool:
        """Whether to draw quartiles: for a large batch whose members share times."""
        return len(self.times) > FEW and bool(np.all(self.times == self.times[:1]))

    @functools.cached_property
    def last(self) -> Int[np.ndarray, " batch"]:
        """The index in time of the last finite state of each member."""
        finite = np.all(np.isfinite(self.series["states"]), axis=-1)
        last = finite.shape[1] - 1 - np.argmax(finite[:, ::-1], axis=1)
        return np.where(finite.any(axis=1), last, 0)

    @functools.cached_property
    def paths(self) -> list[Path]:
        """The path of each member, with its events if they were kept."""
        events, batch = self.trajectory.recorded_events, self.trajectory.batch_shape
        flat = lambda a: np.asarray(a).reshape(len(self.times), *a.shape[len(batch) :])
        events = jax.tree.map(flat, events)
        members = zip(self.times, self.series["states"], strict=True)
        return [
            path_of(times, states, jax.tree.map(operator.itemgetter(i), events))
            for i, (times, states) in enumerate(members)
        ]

    def lines(self, kind: str, column: int) -> list[tuple[np.ndarray, np.ndarray]]:
        """The times and values of one series, a pair for each member."""
        if kind == "states":
            broken = [path.broken() for path in self.paths]
            return [(times, states[:, column]) for times, states in broken]
        return list(zip(self.times, self.series[kind][..., column], strict=True))

    @property
    def time_label(self) -> str:
        """`"time [s]"`, in the time unit of the plant, if it names units; else
        `"time"`."""
        trajectory = self.trajectory
        named = any((*trajectory.state_units, *trajectory.control_units))
        return f"time [{trajectory.time_unit}]" if named else "time"

    def names_and_units(self, kind: str) -> tuple[tuple[str, ...], tuple[str, ...]]:
        """The names and units of a kind of series; `""` for an unknown unit."""
        run, size = self.trajectory, self.series[kind].shape[-1]
        letter = "w" if kind == "disturbances" else "y"
        names, units = {
            "states": (run.state_names, run.state_units),
            "controls": (run.control_names, run.control_units),
            "costs": (("cost",), ()),
        }.get(kind, (indexed_names(letter, size), ()))
        return tuple(names), tuple(units) if len(units) == size else ("",) * size


@dataclasses.dataclass(frozen=True)
class Panel:
    """Columns of one kind of series that share an axis, and so a unit."""

    kind: str
    columns: tuple[int, ...]
    names: tuple[str, ...]
    unit: str


def as_runs(given: Any, labels: Any, argument: str, where: str) -> list[Run]:
    """Convert `given` (a trajectory, or a mapping or sequence of them) to runs. Raises
    an error if it cannot be drawn."""
    if isinstance(given, Trajectory):
        names, trajectories = [""], [given]
    elif isinstance(given, Mapping):
        if labels is not None:
            raise ValueError(
                f"{where}: labels must not be given with a dictionary, whose keys are "
                f"the labels; got {labels!r}."
            )
        names, trajectories = map(str, given), list(given.values())
    elif isinstance(given, Sequence) and not isinstance(given, str):
        names, trajectories = (f"trajectory {i}" for i in range(len(given))), given
    else:
        raise ValueError(
            f"{where}: {argument} must be a Trajectory, or a dictionary or sequence of "
            f"them, got {type(given).__name__}."
        )
    if not trajectories:
        raise ValueError(f"{where}: {argument} must not be empty.")
    if labels is not None:
        labels = [labels] if isinstance(labels, str) else labels
        if not isinstance(labels, Sequence) or len(labels) != len(trajectories):
            raise ValueError(
                f"{where}: labels must be {len(trajectories)} strings, one for each "
                f"trajectory, got {labels!r}."
            )
        names = map(str, labels)
    runs = []
    for label, trajectory in zip(names, trajectories, strict=True):
        what = f"{argument}[{label!r}]" if label else argument
        check_instance(trajectory, Trajectory, what, where)
        runs.append(_run(label, trajectory, what, where))
        for name in ("state_names", "control_names"):
            first, here = (getattr(r.trajectory, name) for r in (runs[0], runs[-1]))
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
    batch, steps = trajectory.batch_shape, trajectory.steps

    def flat(array: Any) -> np.ndarray:
        """Merge the axes of the batch into one."""
        array = np.asarray(array)
        return array.reshape((math.prod(batch), *array.shape[len(batch) :]))

    ends = flat(trajectory.length).astype(int)
    failed = flat(np.broadcast_to(trajectory.failed, batch))
    series = {}
    for kind in KINDS:
        array = getattr(trajectory, kind)
        if array is not None:
            array = flat(array)
            array = array[..., None] if kind == "costs" else array
            series[kind] = _until(array, ends, steps, kind)
    incidents = (trajectory.incidents or {}).items()
    return Run(
        label=label,
        times=flat(np.broadcast_to(trajectory.times, (*batch, steps + 1))),
        series=series,
        failed=failed,
        terminated=flat(np.broadcast_to(trajectory.ended, batch)) & ~failed,
        incidents={name: flat(at) for name, at in incidents if np.any(at)},
        total_costs=flat(trajectory.total_cost),
        trajectory=trajectory,
    )


def _until(
    array: np.ndarray, ends: Int[np.ndarray, " batch"], steps: int, kind: str
) -> Series:
    """`array` with `steps + 1` entries in time and NaN after the end of each member."""
    array = np.where(np.isfinite(array), array, np.nan).astype(float)
    index = np.arange(steps + 1)[None, :, None]
    ends = ends[:, None, None]
    if kind != "states":
        array = np.pad(array, ((0, 0), (0, 1), (0, 0)), constant_values=np.nan)
    if kind in HELD and steps:
        array[:, 1:] = np.where(index[:, 1:] == ends, array[:, :-1], array[:, 1:])
    has_end = kind == "states" or kind in HELD and steps
    return np.where(index <= ends if has_end else index < ends, array, np.nan)


def panels_of(run: Run, show: Any, *, grouped: bool, where: str) -> list[Panel]:
    """The panels for what `show` names: one for each unit if `grouped`, else one for
    each column."""
    chosen: dict[str, list[int]] = {}
    kept = {kind: run.names_and_units(kind) for kind in run.series}
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
        kind = next((kind for kind in kept if name in kept[kind][0]), None)
        if kind is None:
            names = [n for kind in kept for n in (kind, *kept[kind][0])]
            raise ValueError(
                f"{where}: show must be among {', '.join(dict.fromkeys(names))} (what "
                f"the trajectory kept), got {name!r}."
            )
        column, columns = kept[kind][0].index(name), chosen.setdefault(kind, [])
        if column not in columns:
            columns.append(column)
    panels = []
    for kind, columns in chosen.items():
        names, units = kept[kind]
        groups: dict[Any, list[int]] = {}
        for column in columns:
            groups.setdefault(units[column] if grouped else column, []).append(column)
        for group in groups.values():
            for part in np.array_split(group, -(-len(group) // MOST_LINES)):
                part = tuple(part.tolist())
                chosen_names = tuple(names[i] for i in part)
                panels.append(Panel(kind, part, chosen_names, units[part[0]]))
    return panels
