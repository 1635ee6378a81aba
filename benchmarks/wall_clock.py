"""`python -m benchmarks.wall_clock`: the wall-clock table of the Deluca paper, again.

One pendulum, zero input, 1e7 steps in one call; the mean and deviation over 100 runs;
the start-up over 100 cold compilations, timed apart; peak memory; and Gymnasium beside
it, on 1e5 steps. Prints the table and writes `benchmarks/results/wall_clock.json`, and
the same pinned to one core in `pinned/`.
"""

import argparse
import json
import resource
import sys
import time
from pathlib import Path
from typing import Any

import equinox as eqx
import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd

import delucax as dlx
from benchmarks._machine import compile_anew, describe, run_in_settings


def simulate(steps: int) -> Any:
    """A freshly traced program of `steps` steps with zero input; keeps the end only."""
    env, zero = dlx.make("pendulum"), dlx.controllers.Zero(1)
    arrays, static = eqx.partition(env, eqx.is_array)

    def run(arrays, x0):
        env = eqx.combine(arrays, static)
        key = jax.random.key(0)
        end = dlx.rollout(
            env, zero, key=key, x0=x0, horizon=steps, keep=(), throw=False
        )
        return end.final_state

    return jax.jit(run), (arrays, jnp.array([1.0, 0.0]))


def cold_compile(steps: int) -> float:
    """Seconds to trace and compile with every cache empty."""
    jax.clear_caches()
    start = time.perf_counter()
    program, arguments = simulate(steps)
    program.lower(*arguments).compile()
    return time.perf_counter() - start


def gymnasium_run(steps: int) -> float:
    """Seconds of `steps` steps of Gymnasium's own pendulum."""
    env = gymnasium.make("Pendulum-v1").unwrapped
    env.reset(seed=0)
    action = np.zeros(1, np.float32)
    start = time.perf_counter()
    for _ in range(steps):
        env.step(action)
    return time.perf_counter() - start


def peak_megabytes() -> float:
    """The most memory that this process has held."""
    scale = 1e6 if sys.platform == "darwin" else 1e3
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / scale


def run(options: argparse.Namespace, folder: Path) -> None:
    """Measure, print and write."""
    compile_anew()
    compiles = np.array([cold_compile(options.steps) for _ in range(options.runs)])
    before = peak_megabytes()
    program, arguments = simulate(options.steps)
    executable = program.lower(*arguments).compile()
    jax.block_until_ready(executable(*arguments))
    runs = []
    for _ in range(options.runs):
        start = time.perf_counter()
        jax.block_until_ready(executable(*arguments))
        runs.append(time.perf_counter() - start)
    after = peak_megabytes()
    nanoseconds = 1e9 * np.array(runs) / options.steps
    gym_runs = max(3, options.runs // 10)
    gym = np.array([gymnasium_run(options.gymnasium_steps) for _ in range(gym_runs)])
    gym_nanoseconds = 1e9 * gym / options.gymnasium_steps

    rows = [
        {
            "library": f"Gymnasium ({options.gymnasium_steps:.0e} steps)",
            "start-up (ms)": "-",
            "time a step": f"{gym_nanoseconds.mean() / 1e3:.2f} "
            f"+- {gym_nanoseconds.std(ddof=1) / 1e3:.2f} us",
            "runs": gym_runs,
        },
        {
            "library": f"delucax ({options.steps:.0e} steps)",
            "start-up (ms)": f"{1e3 * compiles.mean():.1f} "
            f"+- {1e3 * compiles.std(ddof=1):.1f}",
            "time a step": f"{nanoseconds.mean():.2f} "
            f"+- {nanoseconds.std(ddof=1):.2f} ns",
            "runs": options.runs,
        },
    ]
    ratio = gym_nanoseconds.mean() / nanoseconds.mean()
    memory = executable.memory_analysis()
    print(pd.DataFrame(rows).to_string(index=False))
    print(f"\nratio of the means: {ratio:.0f}")
    print(
        f"memory: the program needs {memory.temp_size_in_bytes} bytes of scratch; the "
        f"process peaked at {after:.0f} MB ({before:.0f} MB before the runs)"
    )
    out = folder / "wall_clock.json"
    content = {
        "machine": describe(),
        "rows": rows,
        "ratio of the means": ratio,
        "scratch bytes": memory.temp_size_in_bytes,
        "peak MB": after,
        "peak MB before the runs": before,
    }
    out.write_text(json.dumps(content, indent=1) + "\n")
    print(f"written: {out}")


def main() -> None:
    """Run under both settings."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.wall_clock")
    parser.add_argument("--steps", type=int, default=10_000_000)
    parser.add_argument("--runs", type=int, default=100)
    parser.add_argument("--gymnasium-steps", type=int, default=100_000)
    run_in_settings(parser, run)


if __name__ == "__main__":
    main()
