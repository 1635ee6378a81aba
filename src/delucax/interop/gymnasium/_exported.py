"""The step of an environment in C, in memory that is allocated once.

The function in C is the same function of the packed array that JAX compiles. Each
process traces the environment and writes the C once. The compiled library is kept on
disk, under a hash of the C.
"""

import functools
import tempfile
from typing import Any

import jax
import numpy as np

from ... import export
from ...environments import Environment
from .._episode import HashableEnvironment
from . import _program as programs


class _Row:
    """The row of this step, in place of a table of the rows of all steps."""

    def __init__(self, row: Any):
        self.row = row

    def __getitem__(self, time: Any) -> Any:
        return self.row


def exported_stepper(env: Environment, discrete: bool, truncate: bool) -> Any:
    """As `stepper`, with the step in C instead of JAX.

    **Raises:** `ValueError` if the environment cannot be exported, or no compiler is
    found.
    """
    step, size = _loaded(HashableEnvironment(env), discrete, truncate)

    def allocate(length, dtype):
        given, after = np.zeros(length, dtype), np.zeros(size, dtype)

        def begin(signals):
            # The noise is the one of the state after the step, hence the shift.
            drawn = signals.disturbances, signals.noise
            tables = [
                np.asarray(table)[shift:]
                for shift, table in enumerate(drawn)
                if table is not None
            ]
            rows = [table[0].copy() for table in tables]
            call = step.bind(given, *rows, after)

            def with_rows():
                now = int(given[size + programs.STEP])
                for row, table in zip(rows, tables, strict=True):
                    row[...] = table[now]
                return call()

            return with_rows if rows else call

        return begin, given, after

    return allocate


@functools.lru_cache(maxsize=64)
def _loaded(same: HashableEnvironment, discrete: bool, truncate: bool) -> Any:
    """The function in C, and the size of the packed array."""
    env = same.env
    program = programs.program(env, discrete, truncate)
    actions = 1 if discrete else env.control_size
    packed, signals = jax.eval_shape(program.start, jax.random.key(0), None)
    given = jax.ShapeDtypeStruct((program.size + actions,), packed.dtype)
    rows = jax.tree.map(lambda s: jax.ShapeDtypeStruct(s.shape[1:], s.dtype), signals)
    drawn, structure = jax.tree.flatten(rows)

    def step(given, *drawn):
        signals = jax.tree.unflatten(structure, map(_Row, drawn))
        split = given[: program.size], given[program.size :]
        return programs.step_packed(env, discrete, truncate, *split, signals)

    example = given, *drawn
    with tempfile.TemporaryDirectory() as folder:
        export.c(step, folder, name="step", dtype=str(packed.dtype), example=example)
        return export.load(folder), program.size
