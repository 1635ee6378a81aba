"""`python -m benchmarks.accelerator`: batches on a GPU or TPU beside the same machine's
CPU, in one run.

- Tasks: nanoseconds a step of an episode, of the whole of delucax and of a raw
  `lax.scan`, from a thousand lanes to a million.
- Riccati equations of four states in single and double precision.
- Bounded linear-quadratic programs, and plans by iLQR, in double precision.

Every result is compared with that of the CPU. Prints tables and writes
`benchmarks/results/accelerator.json`. Needs a JAX with the device's plugin; without a
device it says so and writes nothing.
"""

import argparse
import json
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd

import delucax as dlx
from benchmarks import _tasks
from benchmarks._machine import describe
from benchmarks._problem import Episodes
from benchmarks._timing import compiled, race
from benchmarks.qp import bounded_lq, CONTROLS, staged, STATES


OUT = Path(__file__).parent / "results" / "accelerator.json"
TASKS = "cartpole", "quadrotor", "planar_quadrotor", "acrobot", "reacher"
STEPS = 200


def both(
    name: str, count: int, function: Callable[..., Any], *args: Any, rounds: int
) -> dict[str, Any]:
    """Microseconds a member of a batch on the device and on the CPU, and the largest
    relative difference of their results."""
    row: dict[str, Any] = {"what": name, "count": count}
    results = []
    for device in (jax.devices()[0], jax.devices("cpu")[0]):
        with jax.default_device(device):
            given = jax.device_put(args, device)
            contender = compiled(name, count, function, *given)
            (timing,) = race([contender], rounds=rounds, warmup=1)
            results.append(jax.device_get(jax.jit(function)(*given)))
        row[f"{device.platform} us"] = timing.best / 1e3
        row[f"{device.platform} compile s"] = timing.compile_seconds
    row["cpu / device"] = row["cpu us"] / row[f"{jax.devices()[0].platform} us"]
    row["largest difference"] = max(
        float(np.max(np.abs(a - b) / (1 + np.abs(b))))
        for a, b in zip(*map(jax.tree.leaves, results), strict=True)
    )
    print(_line(row), flush=True)
    return row


def steps_of(name: str, lanes: int, rounds: int) -> dict[str, Any]:
    """Nanoseconds a step of ours and of the raw scan on the device."""
    case = Episodes(name, STEPS, lanes, batched=True)
    timings = race(_tasks.contenders(case), rounds=rounds, warmup=1)
    row: dict[str, Any] = {"task": name, "lanes": lanes}
    row |= {f"{timing.name} ns": timing.best for timing in timings}
    ours, raw = (next(t for t in timings if t.name == n) for n in _NAMES)
    row["delucax / raw"] = ours.ratio(raw)
    row["steps a second"] = 1e9 / ours.best
    print(_line(row), flush=True)
    return row


_NAMES = _tasks.OURS, _tasks.RAW


def riccati(count: int, dtype: Any, rounds: int) -> dict[str, Any]:
    """Stabilising solutions of random systems."""
    draw = np.random.default_rng(0).standard_normal
    A, B = draw((count, 4, 4)).astype(dtype), draw((count, 4, 2)).astype(dtype)
    Q, R = np.eye(4, dtype=dtype), np.eye(2, dtype=dtype)
    solve = jax.vmap(lambda A, B: dlx.riccati.dare(A, B, Q, R, throw=False).X)
    return both(f"DARE, n = 4, {np.dtype(dtype)}", count, solve, A, B, rounds=rounds)


def programs(count: int, rounds: int) -> dict[str, Any]:
    """Bounded linear-quadratic programs of 20 stages."""
    A, B, b, starts = bounded_lq()
    repeats = -(-count // len(starts))
    draw = np.random.default_rng(1).uniform(0.9, 1.1, (repeats * len(starts), 1))
    starts = np.tile(starts, (repeats, 1)) * draw
    H = np.eye(STATES + CONTROLS)
    solve = jax.vmap(lambda x0: staged(A, B, b, H, x0, 1.0).u)
    return both("bounded LQ, T = 20", count, solve, starts[:count], rounds=rounds)


def plans(count: int, rounds: int) -> dict[str, Any]:
    """Swing-ups of the pendulum from random states."""
    dynamics = dlx.Discretized(dlx.systems.Pendulum(), dt=0.05)
    cost = dlx.costs.Quadratic([1.0, 0.1], [0.1], final=[20.0, 2.0])
    planner = dlx.planning.ILQR()
    starts = np.random.default_rng(2).uniform(-1, 1, (count, 2))

    def solve(x0):
        plan = planner(dynamics, cost, x0, jnp.zeros((40, 1)), throw=False)
        return plan.cost

    return both("iLQR, pendulum, T = 40", count, jax.vmap(solve), starts, rounds=rounds)


def measure(options: argparse.Namespace) -> None:
    """Measure, print and write."""
    rounds, began = options.rounds, time.perf_counter()
    lanes = (1 << 10, 1 << 12) if options.quick else (1 << 10, 1 << 16, 1 << 20)
    counts = (128, 256) if options.quick else (1024, 16384)
    tasks = [steps_of(name, n, rounds) for name in TASKS for n in lanes]
    batches = [riccati(n, np.float32, rounds) for n in counts]
    with jax.enable_x64(True):
        batches += [riccati(n, np.float64, rounds) for n in counts]
        batches += [programs(n, rounds) for n in counts[:1]]
        batches += [plans(n, rounds) for n in counts[:1]]
        for title, rows in {"tasks": tasks, "batches": batches}.items():
            print(f"\n{title}")
            print(pd.DataFrame(rows).to_string(index=False, float_format="%.3g"))
    print(f"{time.perf_counter() - began:.0f} s")
    if not options.quick:
        found = {"machine": describe(), "tasks": tasks, "batches": batches}
        options.out.write_text(json.dumps(found, indent=1) + "\n")
        print(f"written: {options.out}")


def _line(row: dict[str, Any]) -> str:
    parts = [f"{v:.3g}" if isinstance(v, float) else str(v) for v in row.values()]
    return "  " + "  ".join(parts)


def main() -> None:
    """Run where there is a device."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.accelerator")
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--quick", action="store_true", help="small sizes, no file")
    parser.add_argument("--out", type=Path, default=OUT)
    options = parser.parse_args()
    if jax.default_backend() == "cpu" and not options.quick:
        sys.exit("benchmarks.accelerator: JAX sees no device but the CPU.")
    measure(options)


if __name__ == "__main__":
    main()
