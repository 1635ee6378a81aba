"""Hand-written C with the same arithmetic, compiled when the benchmark runs.

`pendulum.c` is compiled with `-O3 -march=native -ffast-math -fopenmp-simd` and called
through `ctypes` on one core. It writes into arrays that are kept from run to run, as a
C program would.
"""

import ctypes
import functools
import os
import re
import shutil
import subprocess
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks._problem import Case, GAIN
from benchmarks._timing import Contender, Missing, python


NAME = "C"
FLAGS = ("-O3", "-march=native", "-ffast-math", "-fopenmp-simd", "-fPIC", "-std=c11")


@dataclass(frozen=True)
class Library:
    """The compiled file: its functions, its compiler, and how it came to be.

    `vector_sine` is the name of the vectorised sine that the code calls, such as
    `_ZGVdN8v_sinf`, or `None` where the compiler found none.
    """

    functions: ctypes.CDLL
    compiler: str
    flags: tuple[str, ...]
    compile_seconds: float
    vector_sine: str | None


@functools.cache
def library() -> Library | str:
    """Compile once a process; the reason in words where that isn't possible."""
    command = os.environ.get("CC") or next(
        filter(shutil.which, ("cc", "gcc", "clang")), None
    )
    if command is None:
        return "no C compiler found"
    try:
        about = subprocess.run(
            [command, "--version"], capture_output=True, text=True, check=True
        ).stdout
        # GCC finds the vector functions of glibc by itself; clang has to be told, and
        # not every build of it can be.
        extras = [("-fveclib=libmvec",), ()] if "clang" in about else [()]
        message = ""
        for extra in extras:
            flags = FLAGS + extra
            built, message = _build(command, flags)
            if built is not None:
                functions, seconds, vector_sine = built
                return Library(
                    functions, about.splitlines()[0], flags, seconds, vector_sine
                )
    except (OSError, subprocess.CalledProcessError) as error:
        return f"the C compiler doesn't run: {error}"
    return f"the C compiler failed: {message}"


def _build(
    command: str, flags: tuple[str, ...]
) -> tuple[tuple[ctypes.CDLL, float, str | None] | None, str]:
    source = Path(__file__).with_name("pendulum.c")
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as folder:
        part, whole = f"{folder}/pendulum.o", f"{folder}/pendulum.so"
        start = time.perf_counter()
        # Linked without -ffast-math: with it, GCC adds start-up code that changes the
        # floating-point mode of the whole process.
        for step in (
            [command, *flags, "-c", str(source), "-o", part],
            [command, "-shared", part, "-o", whole, "-lm"],
        ):
            done = subprocess.run(step, capture_output=True, text=True)
            if done.returncode:
                return None, done.stderr.strip()[-300:]
        seconds = time.perf_counter() - start
        # The names of the functions it needs lie in the file as plain text.
        found = re.search(rb"_ZGV\w+_sinf", Path(whole).read_bytes())
        vector_sine = found.group().decode() if found else None
        return (_declare(ctypes.CDLL(whole)), seconds, vector_sine), ""


def _declare(functions: ctypes.CDLL) -> ctypes.CDLL:
    size, real = ctypes.c_size_t, ctypes.c_float
    array = np.ctypeslib.ndpointer(np.float32, flags="C_CONTIGUOUS")
    signatures = {
        "trajectory_chain": [size, real, real, real, real, *[array] * 4],
        "trajectory_batch": [size, size, real, real, *[array] * 6],
        "cost_chain": [size, real, real, real, real],
        "cost_batch": [size, size, real, real, *[array] * 3],
        "free_chain": [size, array, array],
        "free_batch": [size, size, array, array],
    }
    for name, arguments in signatures.items():
        function = getattr(functions, name)
        function.argtypes = arguments
        function.restype = real if name == "cost_chain" else None
    return functions


def program(case: Case, functions: ctypes.CDLL) -> Callable[[], Any]:
    """The function to time: runs the C and returns the arrays that it wrote to."""
    angle, speed = case.starts()
    lanes, steps = case.lanes, case.steps
    k0, k1 = GAIN

    outputs: list[np.ndarray] = []
    if case.workload == "trajectory":
        tail = () if lanes is None else (lanes,)
        lengths = (steps + 1, steps + 1, steps, steps)
        outputs = [np.empty((length, *tail), np.float32) for length in lengths]

    def trajectory_chain() -> Any:
        functions.trajectory_chain(steps, k0, k1, angle, speed, *outputs)
        return outputs

    def trajectory_batch() -> Any:
        functions.trajectory_batch(lanes, steps, k0, k1, angle, speed, *outputs)
        return outputs

    def cost_chain() -> Any:
        return functions.cost_chain(steps, k0, k1, angle, speed)

    def cost_batch() -> Any:
        total = np.zeros_like(angle)
        functions.cost_batch(lanes, steps, k0, k1, angle.copy(), speed.copy(), total)
        return total

    def free_chain() -> Any:
        state = angle.copy(), speed.copy()
        functions.free_chain(steps, *state)
        return state

    def free_batch() -> Any:
        state = angle.copy(), speed.copy()
        functions.free_batch(lanes, steps, *state)
        return state

    chain = {"trajectory": trajectory_chain, "cost": cost_chain, "free": free_chain}
    batch = {"trajectory": trajectory_batch, "cost": cost_batch, "free": free_batch}
    return (chain if lanes is None else batch)[case.workload]


def contender(case: Case, *, name: str = NAME) -> Contender | Missing:
    """The case in C, ready to race, or the reason why not."""
    if case.workload == "gradient" or case.method != "gym":
        return Missing(name, "only Gymnasium's step is written in C, forward")
    compiled = library()
    if isinstance(compiled, str):
        return Missing(name, compiled)
    timed = python(name, case.total_steps, program(case, compiled.functions))
    return replace(timed, compile_seconds=compiled.compile_seconds)


def simulate(case: Case) -> dict[str, np.ndarray] | None:
    """What a run returns, as `raw.simulate` gives it; `None` if not compiled."""
    compiled = library()
    if isinstance(compiled, str):
        return None
    return case.named(program(case, compiled.functions)())
