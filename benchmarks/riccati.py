"""`python -m benchmarks.riccati`: Riccati equations against SciPy, in double precision.

A run asks for the solution, the residual, the spectral radius of the closed loop and
the result, and reads all of them; SciPy returns the solution alone. All of it is
measured twice: with JAX and BLAS as they are for a user who sets nothing, and pinned to
one core without threads for products. Prints the tables and writes
`benchmarks/results/riccati.json`, and the same in `pinned/`.
"""

import argparse
import json
import math
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd
import scipy.linalg

import delucax as dlx
from benchmarks._machine import compile_anew, describe, run_in_settings
from benchmarks._timing import compiled, python, race, Timing


SIZES = (4, 20, 100, 300, 480)
LANES = 1000


def system(n: int, lanes: int | None = None) -> tuple[np.ndarray, ...]:
    """A random unstable system with a quarter as many controls as states."""
    rng = np.random.default_rng(n)
    m = max(1, n // 4)
    batch = () if lanes is None else (lanes,)
    A = 1.2 * rng.normal(size=(*batch, n, n)) / math.sqrt(n)
    return A, rng.normal(size=(*batch, n, m)), np.eye(n), np.eye(m)


def facts(A, B, Q, R) -> tuple[Any, ...]:
    """All that a user would look at."""
    solution = dlx.riccati.dare(A, B, Q, R, throw=False)
    good = solution.result == dlx.RESULTS.successful
    return solution.X, solution.residual, solution.spectral_radius, good


def gradient(A, B, Q, R) -> Any:
    """Of a number made of the whole solution, with respect to all four matrices."""

    def number(A, B, Q, R):
        solution = dlx.riccati.dare(A, B, Q, R, throw=False)
        return jnp.sum(jnp.sin(solution.X)) + jnp.sum(solution.K)

    return jax.grad(number, argnums=(0, 1, 2, 3))(A, B, Q, R)


def compare(n: int, rounds: int) -> tuple[dict[str, Timing], dict[str, Any]]:
    """Time one system of `n` states, forward and gradient."""
    problem = system(n)
    X, residual, radius, good = (np.asarray(v) for v in jax.jit(facts)(*problem))
    theirs = scipy.linalg.solve_discrete_are(*problem)
    contenders = [
        python("SciPy", 1, lambda: scipy.linalg.solve_discrete_are(*problem)),
        compiled("delucax", 1, facts, *problem),
        compiled("delucax, gradient", 1, gradient, *problem),
    ]
    timings = {t.name: t for t in race(contenders, rounds=rounds, warmup=1)}
    quality = {
        "n": n,
        "good": bool(good),
        "residual": float(residual),
        "spectral radius": float(radius),
        "difference from SciPy": float(np.linalg.norm(X - theirs) / np.linalg.norm(X)),
    }
    return timings, quality


def compare_batch(rounds: int) -> tuple[dict[str, Timing], dict[str, Any]]:
    """Time a batch of systems of four states against a loop."""
    A, B, Q, R = system(4, LANES)

    def loop():
        solve = scipy.linalg.solve_discrete_are
        return [solve(A[i], B[i], Q, R) for i in range(LANES)]

    batch = jax.vmap(facts, in_axes=(0, 0, None, None))
    steep = jax.vmap(gradient, in_axes=(0, 0, None, None))
    X, residual, radius, good = (np.asarray(v) for v in jax.jit(batch)(A, B, Q, R))
    theirs = np.stack(loop())
    contenders = [
        python("SciPy loop", LANES, loop),
        compiled("delucax", LANES, batch, A, B, Q, R),
        compiled("delucax, gradient", LANES, steep, A, B, Q, R),
    ]
    timings = {t.name: t for t in race(contenders, rounds=rounds, warmup=1)}
    quality = {
        "n": f"{LANES} x 4",
        "good": bool(np.all(good)),
        "residual": float(np.max(residual)),
        "spectral radius": float(np.max(radius)),
        "difference from SciPy": float(
            np.max(
                np.linalg.norm(X - theirs, axis=(1, 2))
                / np.linalg.norm(theirs, axis=(1, 2))
            )
        ),
    }
    return timings, quality


def measure(sizes: list[int], rounds: int) -> dict[str, Any]:
    """The rows of one setting."""
    ratios, record, qualities = [], [], []
    limits = {100: ">= 10", 300: ">= 8", 480: ">= 8"}
    for n in sizes:
        timings, quality = compare(n, rounds)
        ours = timings["delucax"]
        slower = timings["SciPy"].ratio(ours)
        ratios.append(
            {"ratio": f"n={n}: SciPy / delucax", "measured": slower}
            | {"limit": limits.get(n, "")}
        )
        steeper = timings["delucax, gradient"].ratio(ours)
        ratios.append(
            {"ratio": f"n={n}: gradient / forward", "measured": steeper}
            | {"limit": "<= 3"}
        )
        record += [{"n": n} | t.row() for t in timings.values()]
        qualities.append(quality)
    timings, quality = compare_batch(rounds)
    ours = timings["delucax"]
    slower = timings["SciPy loop"].ratio(ours)
    name = f"{LANES} systems of n=4: SciPy loop / delucax"
    ratios.append({"ratio": name, "measured": slower, "limit": ">= 30"})
    steeper = timings["delucax, gradient"].ratio(ours)
    name = f"{LANES} systems of n=4: gradient / forward"
    ratios.append({"ratio": name, "measured": steeper, "limit": "<= 3"})
    record += [{"n": quality["n"]} | t.row() for t in timings.values()]
    qualities.append(quality)
    times = pd.DataFrame(record)
    times = times.rename(columns=lambda c: c.replace("ns/step", "ns a system"))
    return {
        "machine": describe(),
        "ratios": ratios,
        "found": qualities,
        "timings": times.to_dict("records"),
    }


def run(options: argparse.Namespace, folder: Path) -> None:
    """Measure, print and write."""
    compile_anew()
    jax.config.update("jax_enable_x64", True)
    content = {"scipy": scipy.__version__} | measure(options.sizes, options.rounds)
    print(pd.DataFrame(content["timings"]).to_string(index=False, float_format="%.4g"))
    print("\nWhat was found")
    print(pd.DataFrame(content["found"]).to_string(index=False, float_format="%.2g"))
    print("\nRatios of the best rounds")
    print(pd.DataFrame(content["ratios"]).to_string(index=False, float_format="%.2f"))
    out = folder / "riccati.json"
    out.write_text(json.dumps(content, indent=1) + "\n")
    print(f"\nwritten: {out}")


def main() -> None:
    """Run under both settings."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.riccati")
    parser.add_argument("--rounds", type=int, default=7)
    parser.add_argument("--sizes", type=int, nargs="*", default=list(SIZES))
    run_in_settings(parser, run)


if __name__ == "__main__":
    main()
