"""How closely exported controllers follow JAX, in the precision of this process.

A random state is one that the controller gets to: along sequences of random
observations, each step of the C begins at the state that JAX had.
"""

import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import delucax as dlx
from benchmarks._exports import ALL, Exported, KEY, table, write
from delucax.export._keys import as_words


LIMITS = {"float64": 1e-12, "float32": 1e-5}
"""Of a step, of `max(1, |u|)`; ten times its own tolerance where it iterates."""
LOOP_LIMITS = {"float64": 1e-9, "float32": 1e-3}
LOOP = 1000


class Keyed(dlx.AbstractController):
    """A controller that draws with the key of its export, whatever it is given."""

    controller: Any

    def init(self, *, key: Any = None) -> Any:
        del key
        return self.controller.init(key=KEY)

    def __call__(self, t: Any, y: Any, state: Any) -> Any:
        return self.controller(t, y, state)

    def applied(self, u: Any, cost: Any, state: Any) -> Any:
        return self.controller.applied(u, cost, state)


def memories(loaded: Any, leaves: list[Any]) -> np.ndarray:
    """The bytes of the C's state for each row of the leaves of JAX's, which come
    first in it."""
    about, memory = loaded.description.state, loaded.init().memory
    members = [(name, dtype, shape) for name, shape, dtype, _ in about]
    rows = np.tile(memory, (len(leaves[0]) if leaves else 1, 1))
    if members:
        kind = np.dtype(members, align=True)
        struct = np.zeros(len(rows), kind)
        for (name, *_), leaf in zip(members, leaves, strict=True):
            struct[name] = leaf
        rows[:, : kind.itemsize] = struct.view(np.uint8).reshape(len(rows), -1)
    return rows


def recorded(controller: Any, case: Exported, sequences: int, steps: int) -> Any:
    """Inputs, states before each step and controls, with axes sequence and step."""
    start, static = eqx.partition(controller.init(), eqx.is_array)
    y0 = jnp.zeros(case.observations)
    act = lambda: controller(jnp.zeros(()), y0, controller.init())[0]
    m, n = jax.eval_shape(act).shape[0], case.observations
    rows = np.stack([table(case, steps, m, seed) for seed in range(sequences)])
    inputs = rows[..., 0], rows[..., 1 : n + 1], rows[..., n + 1 : -1], rows[..., -1]

    def step(arrays, row):
        t, y, u, cost = row
        control, after = controller(t, y, eqx.combine(arrays, static))
        after = controller.applied(u, cost, after)
        return eqx.filter(after, eqx.is_array), (
            jax.tree.map(as_words, arrays),
            control,
        )

    run = jax.jit(jax.vmap(lambda rows: jax.lax.scan(step, start, rows)[1]))
    return inputs, *jax.device_get(run(inputs))


def of_a_step(loaded: Any, record: Any) -> tuple[float, int]:
    """The largest difference of a control, of `max(1, |u|)`, and the steps."""
    (times, seen, _, _), states, controls = record
    flat = lambda table: table.reshape(-1, *table.shape[2:])
    times, seen, controls = flat(times), flat(seen), flat(controls)
    # An array without entries is none in C.
    leaves = [flat(leaf) for leaf in jax.tree.leaves(states) if leaf.size]
    rows = memories(loaded, leaves)
    rows = np.broadcast_to(rows, (len(times), rows.shape[1]))
    state, found = loaded.init(), np.full_like(controls, np.nan)
    for k, memory in enumerate(rows):
        found[k], _ = loaded(times[k], seen[k], state._replace(memory=memory))
    known = np.all(np.isfinite(controls), axis=1)  # not beyond a horizon
    return difference(found[known], controls[known]), len(times)


def difference(found: Any, expected: Any) -> float:
    """The largest, of `max(1, |expected|)`."""
    expected = np.asarray(expected, float)
    scale = np.maximum(1.0, np.abs(expected))
    return float(np.max(np.abs(np.asarray(found, float) - expected) / scale))


def of_a_loop(loaded: Any, controller: Any, case: Exported, controls: int) -> float:
    """The largest difference of a control in a closed loop with a stable plant."""
    n, rng = case.observations, np.random.default_rng(1)
    A, B = 0.9 * np.eye(n), 0.02 * rng.normal(size=(n, controls))
    env = dlx.Environment(
        dlx.LinearDynamics(A, B, dt=case.dt),
        dlx.costs.Quadratic(np.eye(n), 0.1 * np.eye(controls)),
        initial_state=case.scale * np.ones(n),
        horizon=LOOP,
    )
    key = jax.random.key(0)
    run = lambda law: np.asarray(dlx.rollout(env, law, key=key, throw=False).controls)
    found, expected = run(loaded), run(controller)
    # Some have a horizon, beyond which JAX gives NaN.
    known = np.cumprod(np.all(np.isfinite(expected), axis=1)).astype(bool)
    return difference(found[known], expected[known])


def accuracy_of(name: str, case: Exported, quick: bool) -> dict[str, Any]:
    """The row of a controller."""
    dtype = jnp.zeros(()).dtype.name
    row: dict[str, Any] = {"controller": name, "dtype": dtype}
    controller = Keyed(case.make())
    with tempfile.TemporaryDirectory() as folder:
        write(case, Path(folder))
        loaded: Any = dlx.export.load(folder)
    record = recorded(controller, case, *((2, 10) if quick else (100, 100)))
    row["step"], row["states"] = of_a_step(loaded, record)
    limit = LIMITS[dtype]
    tolerance = float(np.sqrt(np.finfo(dtype).eps))
    row["limit"] = 10 * tolerance if case.iterates else limit
    row["loop"] = of_a_loop(loaded, controller, case, record[2].shape[-1])
    row["loop limit"] = LOOP_LIMITS[dtype]
    return row


def accuracy(quick: bool) -> list[dict[str, Any]]:
    """A row for each controller, in the precision of this process."""
    rows = []
    for name, case in ALL.items():
        rows.append(accuracy_of(name, case, quick))
        print(rows[-1], file=sys.stderr, flush=True)
    return rows


def in_both_precisions(quick: bool) -> list[dict[str, Any]]:
    """The rows of double precision, and those of single in a process of its own."""
    code = "from benchmarks._export_accuracy import *; "
    code += f"print(json.dumps(accuracy({quick})))"
    environment = os.environ | {"JAX_ENABLE_X64": "0"}
    command = [sys.executable, "-c", code]
    done = subprocess.run(
        command, env=environment, stdout=subprocess.PIPE, text=True, check=True
    )
    return accuracy(quick) + json.loads(done.stdout.splitlines()[-1])
