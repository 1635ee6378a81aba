"""Interleaved timing: contenders take turns, so that a ratio sees one kind of noise.

Needs only the standard library until a JAX contender is made, since peers in other
virtual environments import it too.
"""

import gc
import os
import statistics
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class Contender:
    """Something to time.

    - `name`: its row in the table.
    - `steps`: simulated steps in one run, all lanes together.
    - `measure`: does one whole run and returns the seconds it took.
    - `compile_seconds`: what tracing and compiling took, apart; `None` if nothing is
      compiled.
    """

    name: str
    steps: int
    measure: Callable[[], float]
    compile_seconds: float | None = None


@dataclass(frozen=True)
class Missing:
    """A contender that can't take part, and why."""

    name: str
    reason: str


@dataclass(frozen=True)
class Timing:
    """The seconds of every round of one contender."""

    name: str
    steps: int
    seconds: tuple[float, ...]
    compile_seconds: float | None = None

    @property
    def best(self) -> float:
        """Nanoseconds a step in the fastest round."""
        return 1e9 * min(self.seconds) / self.steps

    @property
    def median(self) -> float:
        """Nanoseconds a step in the median round."""
        return 1e9 * statistics.median(self.seconds) / self.steps

    def ratio(self, reference: "Timing") -> float:
        """This contender's time a step over the reference's, each in its best round, as
        tables show them."""
        return self.best / reference.best

    def row(self, reference: "Timing | None" = None) -> dict[str, Any]:
        """This timing as one row of a table."""
        row: dict[str, Any] = {
            "contender": self.name,
            "best ns/step": self.best,
            "median ns/step": self.median,
            "compile s": self.compile_seconds,
        }
        if reference is not None:
            row[f"ratio to {reference.name}"] = self.ratio(reference)
        return row


def python(name: str, steps: int, function: Callable[[], Any]) -> Contender:
    """A contender that runs on the CPU as it is called: Python, or C behind `ctypes`.

    What the function returns is released outside the measured time.
    """

    def measure() -> float:
        start = time.perf_counter()
        output = function()
        seconds = time.perf_counter() - start
        del output
        return seconds

    return Contender(name, steps, measure)


def compiled(
    name: str, steps: int, function: Callable[..., Any], *args: Any
) -> Contender:
    """A contender compiled by JAX ahead of time; compilation is timed apart.

    `function` is traced, lowered and compiled for `args`, which are moved to the device
    first. A run calls the executable and waits for all its outputs.
    """
    import jax

    args = jax.device_put(args)
    jax.block_until_ready(args)
    start = time.perf_counter()
    executable = jax.jit(function).lower(*args).compile()
    compile_seconds = time.perf_counter() - start

    def measure() -> float:
        start = time.perf_counter()
        output = jax.block_until_ready(executable(*args))
        seconds = time.perf_counter() - start
        del output
        return seconds

    return Contender(name, steps, measure, compile_seconds)


def race(
    contenders: Sequence[Contender], *, rounds: int = 21, warmup: int = 2
) -> list[Timing]:
    """Time the contenders round-robin and return one `Timing` each, in their order.

    Every round runs each contender once. The order turns by one place a round, so that
    nobody always runs behind the same neighbour's cold caches. Python's garbage
    collector waits outside the measured runs.
    """
    if rounds < 1:
        raise ValueError(f"`rounds` must be at least 1, got {rounds}.")
    for contender in contenders:
        for _ in range(warmup):
            contender.measure()
    seconds: list[list[float]] = [[] for _ in contenders]
    collecting = gc.isenabled()
    gc.disable()
    try:
        for turn in range(rounds):
            for place in range(len(contenders)):
                i = (turn + place) % len(contenders)
                seconds[i].append(contenders[i].measure())
            gc.collect()
    finally:
        if collecting:
            gc.enable()
    return [
        Timing(c.name, c.steps, tuple(s), c.compile_seconds)
        for c, s in zip(contenders, seconds, strict=True)
    ]


def in_fresh_process(code: str) -> float:
    """The seconds that a program prints in a process of its own, in double precision
    and without compiled programs from disk."""
    changes = {"JAX_ENABLE_COMPILATION_CACHE": "false", "JAX_ENABLE_X64": "1"}
    done = subprocess.run(
        [sys.executable, "-c", code],
        env=os.environ | changes,
        capture_output=True,
        text=True,
        check=True,
    )
    return float(done.stdout)
