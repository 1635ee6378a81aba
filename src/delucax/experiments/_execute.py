"""Runs cases one after another, in the calling process."""

import contextlib
import contextvars
import inspect
import os
import time
import traceback
import warnings
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import NamedSharding, PartitionSpec

from .._provenance import device
from ._experiment import arguments_of, Experiment
from ._store import RESERVED


# The largest number of compiled programs to keep. A sweep over a static value would
# otherwise fill the memory.
_PROGRAMS = 128
# The largest number of characters of an error or a traceback to store.
_LONGEST = 8000
# The types of numbers to trace, tried in this order.
_TRACED_KINDS = (bool, int, float, complex), (float, complex), ()


class Outcome(NamedTuple):
    """The outcome of a case, as it is stored, and the process that ran it."""

    values: dict[str, list]
    error: str | None
    traceback: str | None
    compile_seconds: float
    run_seconds: float
    device: str | None
    worker: int


class Runner:
    """Runs the cases of an experiment. It keeps the programs and fixtures that they
    share."""

    def __init__(self, experiment: Experiment):
        self.experiment, self.axes = experiment, experiment.all_axes()
        self.fixtures = experiment.used_fixtures()
        # The values of the fixtures whose scope is the process, and their teardown.
        self.process: tuple[dict, Any] = {}, contextlib.ExitStack()
        self.is_traceable: dict[Any, bool] = {}
        self.program: Any = jax.jit(self._all_seeds, static_argnums=0)

    def run(self, index: tuple[int, ...], seeds: tuple[int, ...], mesh: Any) -> Outcome:
        """Run one case, and record any error that it raises."""
        clock = _Clock()
        error = trace = where = None
        values: dict[str, list] = {}
        try:
            with clock, contextlib.ExitStack() as stack:
                arguments = self._arguments(index, stack)
                returned = self._call(arguments, seeds, mesh)
                values = self._columns(returned, len(seeds))
            where = device()
        except KeyboardInterrupt:
            raise
        except BaseException as raised:
            # `exit()` in a case ends the case, not the sweep.
            error = f"{type(raised).__name__}: {raised}".strip()[:_LONGEST]
            trace = "".join(traceback.format_exception(raised))[-_LONGEST:]
            values = {}
        if clock.compiling:
            clear_programs()
        seconds = round(clock.compiling, 6), round(clock.running, 6)
        return Outcome(values, error, trace, *seconds, where, os.getpid())

    def close(self) -> None:
        """Tear down the fixtures of the process. An error becomes a warning, because
        the results are already stored."""
        made, end = self.process
        made.clear()
        try:
            end.close()
        except KeyboardInterrupt:
            raise
        except BaseException as raised:
            warnings.warn(
                f"{self.experiment.name}: a fixture of the process could not be torn "
                f"down: {type(raised).__name__}: {raised}",
                stacklevel=2,
            )

    def _arguments(self, index: tuple[int, ...], stack: Any) -> dict[str, Any]:
        given: dict[str, Any] = {}
        # The points on the axes that determine each value. A fixture has its own point
        # and those of its arguments.
        origins: dict[str, frozenset] = {}
        for i, (axis, k) in enumerate(zip(self.axes, index, strict=True)):
            given |= zip(axis.names, axis.params[k].values, strict=True)
            origins |= dict.fromkeys(axis.names, frozenset([(i, k)]))
        for name, fixture in self.fixtures.items():
            wanted = arguments_of(fixture.function)
            arguments = {w: given[w] for w in wanted if w in given}
            if "param" in wanted:
                arguments["param"] = given[name]
            known = [origins[w] for w in (*wanted, name) if w in origins]
            origins[name] = frozenset().union(*known)
            made, end = ({}, stack) if fixture.scope == "case" else self.process
            key = name, origins[name]
            if key not in made:
                made[key] = _make(fixture.function, arguments, end)
            given[name] = made[key]
        takes = self.experiment.arguments
        takes_any = any(p.kind is p.VAR_KEYWORD for p in takes.values())
        return {name: v for name, v in given.items() if takes_any or name in takes}

    def _call(self, arguments: dict[str, Any], seeds: tuple[int, ...], mesh: Any):
        """Call the function. Returns a list with an entry for each seed, or arrays over
        all seeds."""
        function, known = self.experiment.function, self.experiment.arguments
        if "seed" in known:
            return [function(**arguments, seed=seed) for seed in seeds]
        if "key" not in known:
            return [function(**arguments)]
        # The program makes the keys from numbers, so that other seeds reuse it.
        numbers = np.asarray(seeds, np.int32)
        if mesh is not None:
            spread = NamedSharding(mesh, PartitionSpec(mesh.axis_names[0]))
            numbers = jax.device_put(numbers, spread)
        made = self._traced(arguments, numbers)
        # A list would be one of rows.
        return {"value": made} if isinstance(made, list) else made

    def _traced(self, arguments: dict[str, Any], numbers: Any) -> Any:
        """Call the function for all seeds, with as many numbers traced as possible.

        Tracing is tried with all numbers, then with floats only, then with no numbers.
        The choice is cached by the signature, so that it does not depend on the cases
        that ran before.
        """
        for kinds in _TRACED_KINDS:
            dynamic, rest = _split(arguments, kinds)
            static = _Static(rest)
            leaves, structure = jax.tree.flatten(dynamic)
            key = static, structure, tuple(map(jax.typeof, leaves)), numbers.shape
            if key not in self.is_traceable:
                if len(self.is_traceable) >= _PROGRAMS:
                    self.is_traceable.clear()
                    self.program.clear_cache()
                try:
                    self.program.trace(static, dynamic, numbers)
                    self.is_traceable[key] = True
                except Exception:
                    if static == _Static(_split(arguments, ())[1]):
                        raise
                    self.is_traceable[key] = False
            if self.is_traceable[key]:
                return jax.block_until_ready(self.program(static, dynamic, numbers))
        raise AssertionError("the last level is traced or raises")

    def _all_seeds(self, static: "_Static", dynamic: Any, numbers: Any) -> Any:
        arguments = eqx.combine(dynamic, static.tree)
        call = lambda n: self.experiment.function(**arguments, key=jax.random.key(n))
        return jax.vmap(call)(numbers)

    def _columns(self, returned: Any, count: int) -> dict[str, list]:
        """The results by name, as lists with an entry for each seed that JSON can
        store."""
        where = self.experiment.name
        if isinstance(returned, list):
            rows = [_as_mapping(row) for row in returned]
            names = {name for row in rows for name in row}
            if any(row.keys() != names for row in rows):
                raise ValueError(
                    f"{where}: every seed must return the same names, got "
                    f"{sorted(names)}."
                )
            columns = {name: [row[name] for row in rows] for name in rows[0]}
        else:
            named = _as_mapping(jax.tree.map(np.asarray, returned))
            # A result may also hold several arrays, or none.
            columns = {
                name: [jax.tree.map(lambda a, k=k: a[k], value) for k in range(count)]
                for name, value in named.items()
            }
        taken = {*RESERVED}.union(*(axis.names for axis in self.axes))
        for name in columns:
            if not isinstance(name, str) or name in taken:
                raise ValueError(
                    f"{where}: a result cannot be called {name!r}, which is the name "
                    "of a parameter or of a column of the table."
                )
        return {
            name: [_simple(value, name, where) for value in values]
            for name, values in columns.items()
        }


class _Static:
    """The static part of the arguments, which `jax.jit` compares: by its content, or by
    identity if a value cannot be hashed."""

    def __init__(self, tree: Any):
        self.tree = tree
        leaves, structure = jax.tree.flatten(tree)
        self._content = structure, tuple(map(_comparable, leaves))

    def __hash__(self) -> int:
        return hash(self._content)

    def __eq__(self, other: Any) -> bool:
        return isinstance(other, _Static) and self._content == other._content


def _comparable(leaf: Any) -> tuple:
    try:
        hash(leaf)
    except TypeError:
        return (id(leaf),)
    return type(leaf), leaf  # 1 and True are equal, but are traced differently


def _split(arguments: dict[str, Any], kinds: tuple[type, ...]) -> tuple[dict, dict]:
    """Split the arguments into traced and static ones. Arrays, and numbers of `kinds`,
    are traced."""

    def is_traced(value: Any) -> Any:
        # A number inside a module is part of its structure.
        plain = type(value) in (*_TRACED_KINDS[0], list, tuple, dict)
        traced = kinds if plain else ()
        is_array = lambda leaf: isinstance(leaf, jax.Array | np.ndarray | np.generic)
        return lambda leaf: is_array(leaf) or type(leaf) in traced

    parts = {name: eqx.partition(v, is_traced(v)) for name, v in arguments.items()}
    dynamic, static = ({name: p[k] for name, p in parts.items()} for k in (0, 1))
    return dynamic, static


def _make(function: Callable, arguments: dict[str, Any], stack: Any) -> Any:
    if not inspect.isgeneratorfunction(function):
        return function(**arguments)
    return stack.enter_context(contextlib.contextmanager(function)(**arguments))


def _as_mapping(value: Any) -> Mapping[str, Any]:
    if isinstance(value, Mapping):
        return value
    return value._asdict() if hasattr(value, "_asdict") else {"value": value}


def _simple(value: Any, name: str, where: str) -> Any:
    if value is None or isinstance(value, bool | str):
        return value
    array = np.empty((), object)
    with contextlib.suppress(Exception):
        array = np.asarray(value)
    if jnp.issubdtype(array.dtype, jnp.floating):  # bfloat16 too
        return (array if array.dtype.kind == "f" else array.astype(np.float32)).tolist()
    if array.dtype.kind not in "biu":
        raise ValueError(
            f"{where}: the result {name!r} must be a number, a string or an "
            f"array of numbers, got {type(value).__name__}."
        )
    return array.tolist()


class _Clock:
    """Measures the time of a call, and how much of it is tracing and compiling."""

    compiling = running = 0.0

    def __enter__(self) -> "_Clock":
        self._token, self._begin = _spans.set([]), time.perf_counter()
        return self

    def __exit__(self, *_: Any) -> None:
        total = time.perf_counter() - self._begin
        # A function can be traced within another one: count overlapping spans once.
        covered, last = 0.0, self._begin
        for begin, end in sorted(_spans.get() or ()):
            covered += max(end - max(begin, last), 0.0)
            last = max(end, last)
        _spans.reset(self._token)
        self.compiling = min(covered, total)
        self.running = total - self.compiling


_spans = contextvars.ContextVar[list | None]("spans", default=None)
"""The spans of tracing and compiling, while a clock runs in this thread."""


def _note(event: str, duration_secs: float, **_: str | int) -> None:
    spans = _spans.get()
    if spans is not None and event.startswith("/jax/core/compile/"):
        now = time.perf_counter()
        spans.append((now - duration_secs, now))


jax.monitoring.register_event_duration_secs_listener(_note)


_IN_USE = Path("/proc/self/maps")
_LIMIT = Path("/proc/sys/vm/max_map_count")


def clear_programs(limit: int | None = None) -> bool:
    """Clear the caches of JAX if its compiled programs hold too many memory maps.

    Linux allows a process 65,530 memory maps by default. A compiled program holds tens
    of them, and a compilation that finds no map left ends in a segmentation fault.
    Programs that are still needed are compiled again. On other systems than Linux,
    nothing is done.

    `limit` is the number of maps above which the caches are cleared, by default half of
    what Linux allows. Returns whether the caches were cleared.
    """
    try:
        limit = int(_LIMIT.read_text()) // 2 if limit is None else limit
        used = _IN_USE.read_bytes().count(b"\n")
    except (OSError, ValueError):
        return False
    if used > limit:
        jax.clear_caches()
    return used > limit
