"""One case after another, in the process that it is called in."""

import contextlib
import dataclasses
import inspect
import os
import threading
import time
import traceback
import warnings
from collections.abc import Callable, Iterator, Mapping
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import NamedSharding, PartitionSpec

from ._axes import Axis
from ._experiment import Experiment, Fixture, RESERVED
from ._provenance import device
from ._room import make_room


# Programs that are kept compiled. A sweep over something static would fill the memory.
_PROGRAMS = 128
_LONGEST = 8000


@dataclasses.dataclass(frozen=True)
class Plan:
    """All that a process needs to know to run the cases of an experiment."""

    name: str
    function: Callable
    fixtures: dict[str, Fixture]
    axes: tuple[Axis, ...]

    @classmethod
    def of(cls, made: Experiment) -> "Plan":
        """The plan of an experiment."""
        return cls(made.name, made.function, made.needed(), made.all_axes())


@dataclasses.dataclass(frozen=True)
class Outcome:
    """What became of a case: values for each seed, or an error."""

    values: dict[str, list]
    error: str | None
    trace: str | None
    compile_seconds: float
    run_seconds: float
    device: str | None
    worker: int


class Runner:
    """Runs cases of a plan, and keeps what they share: programs and fixtures."""

    def __init__(self, plan: Plan):
        self.plan = plan
        arguments = inspect.signature(plan.function).parameters
        self.takes = "key" if "key" in arguments else "seed"
        self.takes = self.takes if self.takes in arguments else None
        open_ended = any(p.kind is p.VAR_KEYWORD for p in arguments.values())
        self.names = None if open_ended else {*arguments}
        self.shared: dict[Any, Any] = {}
        self.closing = contextlib.ExitStack()
        self.verdicts: dict[Any, bool] = {}
        self.program: Any = jax.jit(self._all_seeds, static_argnums=0)

    def run(self, index: tuple[int, ...], seeds: tuple[int, ...], mesh: Any) -> Outcome:
        """Run one case; whatever it raises is recorded."""
        clock = _Clock()
        error = trace = where = None
        values: dict[str, list] = {}
        try:
            with clock, contextlib.ExitStack() as stack:
                arguments = self._arguments(index, stack)
                found = self._call(arguments, seeds, mesh)
                values = _columns(found, len(seeds), self.plan)
            where = device()
        except KeyboardInterrupt:
            raise
        except BaseException as raised:
            # `exit()` in a case ends the case, not the sweep.
            error = f"{type(raised).__name__}: {raised}".strip()[:_LONGEST]
            trace = "".join(traceback.format_exception(raised))[-_LONGEST:]
            values = {}
        if clock.compiling:
            make_room()
        return Outcome(
            values, error, trace, clock.compiling, clock.running, where, os.getpid()
        )

    def close(self) -> None:
        """Let the fixtures of the process go; one that fails harms no result."""
        self.shared.clear()
        try:
            self.closing.close()
        except KeyboardInterrupt:
            raise
        except BaseException as raised:
            warnings.warn(
                f"{self.plan.name}: a fixture of the process could not be let go: "
                f"{type(raised).__name__}: {raised}",
                stacklevel=2,
            )

    def _arguments(self, index: tuple[int, ...], stack: Any) -> dict[str, Any]:
        given: dict[str, Any] = {}
        params: dict[str, Any] = {}
        place: dict[str, tuple[int, int]] = {}
        for i, (axis, k) in enumerate(zip(self.plan.axes, index, strict=True)):
            for name, value in zip(axis.names, axis.values[k], strict=True):
                place[name] = (i, k)
                (params if name in self.plan.fixtures else given)[name] = value
        depends = {name: frozenset([at]) for name, at in place.items()}
        # In the order in which they need each other.
        for name, fixture in self.plan.fixtures.items():
            wanted = inspect.signature(fixture.function).parameters
            on = frozenset().union(
                *(depends.get(w, frozenset()) for w in wanted),
                depends.get(name, frozenset()),
            )
            depends[name] = on
            arguments = {w: given[w] for w in wanted if w in given}
            if "param" in wanted:
                arguments["param"] = params[name]
            if fixture.scope == "case":
                given[name] = _made(fixture.function, arguments, stack)
                continue
            if (name, on) not in self.shared:
                made = _made(fixture.function, arguments, self.closing)
                self.shared[name, on] = made
            given[name] = self.shared[name, on]
        if self.names is None:
            return given
        return {name: value for name, value in given.items() if name in self.names}

    def _call(self, arguments: dict[str, Any], seeds: tuple[int, ...], mesh: Any):
        function = self.plan.function
        if self.takes == "seed":
            return [function(**arguments, seed=seed) for seed in seeds]
        if self.takes is None:
            return [function(**arguments)]
        numbers = np.asarray(seeds, np.int32)
        if mesh is not None:
            spread = NamedSharding(mesh, PartitionSpec(mesh.axis_names[0]))
            numbers = jax.device_put(numbers, spread)
        return self._traced(arguments, numbers)

    def _traced(self, arguments: dict[str, Any], numbers: Any) -> Any:
        """Call for all seeds at once, with as much traced as can be.

        First every number is traced, then only those that are no whole numbers, then
        none. What worked is remembered by what tracing depends on, so that which it is
        follows from the case alone and not from those that ran before it.
        """
        last = None
        for level in range(3):
            dynamic, static = _split(arguments, level)
            static = _Static(static)
            if static == last:
                continue
            last = static
            shapes = jax.tree.map(
                lambda x: (np.shape(x), jax.dtypes.result_type(x), type(x).__name__),
                dynamic,
            )
            leaves, structure = jax.tree.flatten(shapes)
            known = (static, tuple(leaves), structure, numbers.shape)
            verdict = self.verdicts.get(known)
            if verdict is None:
                if len(self.verdicts) >= _PROGRAMS:
                    self.verdicts.clear()
                    self.program.clear_cache()
                try:
                    self.program.trace(static, dynamic, numbers)
                    verdict = True
                except Exception:
                    if level == 2 or static == _Static(_split(arguments, 2)[1]):
                        raise
                    verdict = False
                self.verdicts[known] = verdict
            if verdict:
                return jax.block_until_ready(self.program(static, dynamic, numbers))
        raise AssertionError("the last level is traced or raises")

    def _all_seeds(self, static: "_Static", dynamic: Any, numbers: Any) -> Any:
        arguments = eqx.combine(dynamic, static.tree)

        def one(number: Any) -> Any:
            return self.plan.function(**arguments, key=jax.random.key(number))

        return jax.vmap(one)(numbers)


class _Static:
    """The part of the arguments that is no array, comparable by `jax.jit`."""

    def __init__(self, tree: Any):
        self.tree = tree
        self.leaves, self.structure = jax.tree.flatten(tree)

    def __hash__(self) -> int:
        found = []
        for leaf in self.leaves:
            try:
                found.append(hash(leaf))
            except TypeError:
                found.append(id(leaf))
        return hash((self.structure, *found))

    def __eq__(self, other: Any) -> bool:
        if not isinstance(other, _Static) or self.structure != other.structure:
            return False
        return all(
            a is b or (type(a) is type(b) and _same(a, b))
            for a, b in zip(self.leaves, other.leaves, strict=True)
        )


def _same(a: Any, b: Any) -> bool:
    try:
        return bool(a == b)
    except Exception:
        return False


def _split(arguments: dict[str, Any], level: int) -> tuple[dict, dict]:
    kinds = ((bool, int, float, complex), (float, complex), ())[level]

    def traced(leaf: Any) -> bool:
        return isinstance(leaf, jax.Array | np.ndarray | np.generic)

    def number(leaf: Any) -> bool:
        return traced(leaf) or type(leaf) in kinds

    dynamic, static = {}, {}
    for name, value in arguments.items():
        # A whole number inside a module is part of its structure.
        plain = type(value) in (bool, int, float, complex, list, tuple, dict)
        test = number if plain else traced
        dynamic[name], static[name] = eqx.partition(value, test)
    return dynamic, static


def _made(function: Callable, arguments: dict[str, Any], stack: Any) -> Any:
    if not inspect.isgeneratorfunction(function):
        return function(**arguments)
    return stack.enter_context(contextlib.contextmanager(function)(**arguments))


def _columns(found: Any, count: int, plan: Plan) -> dict[str, list]:
    """Lists with an entry for each seed, by name, of things that JSON knows."""
    parameters = {name for axis in plan.axes for name in axis.names}
    if not isinstance(found, list):
        found = _as_mapping(found, plan)
        columns = {name: np.asarray(value) for name, value in found.items()}
        lists = {name: list(column) for name, column in columns.items()}
    else:
        rows = [_as_mapping(row, plan) for row in found]
        if any(row.keys() != rows[0].keys() for row in rows):
            raise ValueError(
                f"{plan.name}: every seed must return the same names, got "
                f"{sorted({name for row in rows for name in row})}."
            )
        lists = {name: [row[name] for row in rows] for name in rows[0]}
    for name in lists:
        if not isinstance(name, str) or name in parameters or name in RESERVED:
            raise ValueError(
                f"{plan.name}: a result cannot be called {name!r}, which is the name "
                "of a parameter or of a column of the table."
            )
    return {
        name: [_simple(value, name, plan) for value in values]
        for name, values in lists.items()
    }


def _as_mapping(value: Any, plan: Plan) -> Mapping[str, Any]:
    if isinstance(value, Mapping):
        return value
    if hasattr(value, "_asdict"):
        return value._asdict()
    return {"value": value}


def _simple(value: Any, name: str, plan: Plan) -> Any:
    if value is None or isinstance(value, bool | str):
        return value
    try:
        array = np.asarray(value)
    except Exception:
        array = np.asarray(None, object)
    if array.dtype.kind not in "biuf":
        if jnp.issubdtype(array.dtype, jnp.floating):  # bfloat16 and its kin
            array = array.astype(np.float32)
        else:
            raise ValueError(
                f"{plan.name}: the result {name!r} must be a number, a string or an "
                f"array of numbers, got {type(value).__name__}."
            )
    return array.tolist()


class _Clock:
    """The time of a call, and how much of it went into tracing and compiling."""

    compiling = running = 0.0

    def __enter__(self) -> "_Clock":
        _listen()
        self._outer, _local.spans = getattr(_local, "spans", None), []
        self._begin = time.perf_counter()
        return self

    def __exit__(self, *_: Any) -> None:
        total = time.perf_counter() - self._begin
        spans, _local.spans = _local.spans, self._outer
        # One function is traced within another: what is covered counts once.
        covered, last = 0.0, self._begin
        for begin, end in sorted(spans):
            begin = max(begin, last)
            if end > begin:
                covered += end - begin
                last = end
        self.compiling = min(covered, total)
        self.running = total - self.compiling


_local = threading.local()
_listening = False


def _listen() -> None:
    global _listening
    if not _listening:
        jax.monitoring.register_event_duration_secs_listener(_heard)
        _listening = True


def _heard(event: str, duration_secs: float, **kwargs: str | int) -> None:
    del kwargs
    spans = getattr(_local, "spans", None)
    if spans is not None and event.startswith("/jax/core/compile/"):
        now = time.perf_counter()
        spans.append((now - duration_secs, now))


@contextlib.contextmanager
def precision(precise: bool) -> Iterator[None]:
    """Double precision, or single, in this thread."""
    with jax.enable_x64(precise):
        yield
