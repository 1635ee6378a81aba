"""`python -m benchmarks.pendulum`: the pendulum against every peer, in one run.

Prints a table a case, then the ratios that matter beside their limits, and writes
`benchmarks/results/pendulum.json`.
"""

import argparse
import functools
import json
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd

import delucax as dlx
from benchmarks import _ours
from benchmarks._machine import describe, limit_cores
from benchmarks._peers import c, gymnasium_peer, gymnax_peer, raw
from benchmarks._problem import Case
from benchmarks._timing import Contender, Missing, race, Timing


RESULTS = Path(__file__).parent / "results"
RAW = "raw, delucax.math"
OURS = raw.Numerics(dlx.math.sin, dlx.math.clip)


def entries(case: Case) -> list[Contender | Missing]:
    """Everyone who can take part in a case."""
    found: list[Contender | Missing] = [
        raw.contender(case, numerics=OURS, name=RAW),
        raw.contender(case),
        _ours.contender(case),
    ]
    if case.method == "tsit5":
        diffrax_step = _ours.DiffraxStep(dlx.systems.Pendulum())
        env = _ours.environment(case, dynamics=diffrax_step)
        found.append(_ours.contender(case, name="delucax, Diffrax step", env=env))
    if case.workload == "gradient":
        kept = functools.partial(raw.contender, numerics=OURS, checkpoint=True)
        found.append(kept(case, name=f"{RAW}, checkpoint"))
        found.append(_ours.contender(case, name="delucax, stored", checkpoint=None))
        # What a gradient is measured against: the cost alone, forward.
        forward = Case("trajectory", case.steps, case.lanes, case.method)
        found.append(raw.contender(forward, numerics=OURS, name=f"{RAW}, forward"))
    if case.method == "gym" and case.workload in ("trajectory", "cost"):
        user = _ours.environment(case, dynamics=_ours.UserPendulum())
        found.append(_ours.contender(case, name="delucax, user's pendulum", env=user))
        found.append(c.contender(case))
        found.append(gymnax_peer.contender(case, stepping="step"))
        found.append(gymnax_peer.contender(case, stepping="step_env"))
        if case.lanes is None:
            found.append(gymnasium_peer.contender(case))
    return found


def noise_entries(lanes: int | None, steps: int) -> list[Contender]:
    """The price of noise: Gaussian `w`, and Euler-Maruyama beside Euler."""
    case = Case("trajectory", steps, lanes)
    gaussian = dlx.make("pendulum", disturbance=dlx.disturbances.Gaussian(0.01, size=2))
    cost = dlx.costs.PendulumCost()
    system = _ours.NoisyPendulum()
    stochastic = dlx.Discretized(system, 0.05, diffrax.Euler())
    calm = dlx.Discretized(
        dlx.system(
            lambda t, x, u, w: system.vector_field(t, x, u, w),
            states=system.state_names,
            controls=system.control_names,
        ),
        0.05,
        diffrax.Euler(),
    )
    bounds = (-2.0, 2.0)
    tasks = {
        "delucax": dlx.make("pendulum"),
        "delucax, Gaussian w": gaussian,
        "delucax, Euler": dlx.Environment(calm, cost, control_bounds=bounds),
        "delucax, Euler-Maruyama": dlx.Environment(
            stochastic, cost, control_bounds=bounds
        ),
    }
    return [_ours.contender(case, name=name, env=env) for name, env in tasks.items()]


def run(case: Case, rounds: int, found: list[Any] | None = None) -> dict[str, Timing]:
    """Race a case and print its table."""
    found = entries(case) if found is None else found
    ready = [entry for entry in found if isinstance(entry, Contender)]
    timings = race(ready, rounds=rounds)
    print(f"\n{case.label}, {case.steps} steps")
    table = pd.DataFrame([timing.row(timings[0]) for timing in timings])
    print(table.to_string(index=False, float_format="%.3g", na_rep=""), flush=True)
    for entry in found:
        if isinstance(entry, Missing):
            print(f"  not there: {entry.name} ({entry.reason})")
    return {timing.name: timing for timing in timings}


def memory(steps: int = 1_000_000) -> dict[str, float]:
    """MB that the gradient of a long rollout needs, by what it stores."""
    case = Case("gradient", steps)
    env = _ours.environment(case)
    needed = {}
    for checkpoint in ("sqrt", "step", None):
        function, arrays = _ours.program(case, env, checkpoint=checkpoint)
        gain = jnp.array([0.5, 0.0])
        start = tuple(jnp.asarray(x) for x in case.starts())
        executable = jax.jit(function).lower(arrays, gain, *start).compile()
        analysis = executable.memory_analysis()
        needed[str(checkpoint)] = analysis.temp_size_in_bytes / 1e6
        if checkpoint == "sqrt":
            jax.block_until_ready(executable(arrays, gain, *start))
    return needed


def calls(repeats: int = 200) -> dict[str, float]:
    """Milliseconds of single calls from Python, and seconds of compilation."""
    env, key = dlx.make("pendulum"), jax.random.key(0)
    policy = dlx.controllers.Deep(env, width=32, depth=2, key=key)
    linear = dlx.controllers.Linear(jnp.array([[0.5, 0.0]]))
    x, u = jnp.array([1.0, 0.0]), jnp.zeros(1)

    def first(function):
        start = time.perf_counter()
        jax.block_until_ready(jax.tree.leaves(eqx.filter(function(), eqx.is_array)))
        return time.perf_counter() - start

    def milliseconds(function):
        first(function)
        return 1e3 * float(np.median([first(function) for _ in range(repeats)]))

    step = eqx.filter_jit(env.step)
    plain = jax.jit(lambda x, u: env.step(0.0, x, u).state)
    return {
        "first eager rollout, linear (s)": first(
            lambda: dlx.rollout(env, linear, key=key)
        ),
        "eager rollout, T = 200, MLP (ms)": milliseconds(
            lambda: dlx.rollout(env, policy, key=key)
        ),
        "eager rollout, T = 200, linear (ms)": milliseconds(
            lambda: dlx.rollout(env, linear, key=key)
        ),
        "one step, eqx.filter_jit (ms)": milliseconds(lambda: step(0.0, x, u)),
        "one step, jax.jit of arrays (ms)": milliseconds(lambda: plain(x, u)),
    }


LIMITS = {
    "first eager rollout, linear (s)": 0.5,
    "eager rollout, T = 200, MLP (ms)": 2.0,
    "import delucax / import diffrax, optax, lineax": 1.2,
}
"""Of single calls and of the import."""


def imports(repeats: int = 7) -> float:
    """How much longer `import delucax` takes than the libraries it stands on."""

    def seconds(statement: str) -> float:
        start = time.perf_counter()
        subprocess.run([sys.executable, "-c", statement], check=True)
        return time.perf_counter() - start

    statements = ("import delucax", "import diffrax, optax, lineax")
    taken = [[seconds(s) for s in statements] for _ in range(repeats + 1)][1:]
    ours, theirs = np.median(taken, axis=0)
    return float(ours / theirs)


def main() -> None:
    """Run, print and write."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.pendulum")
    parser.add_argument("--rounds", type=int, default=15)
    parser.add_argument("--quick", action="store_true", help="small sizes, no file")
    parser.add_argument("--out", default=str(RESULTS / "pendulum.json"))
    parser.add_argument("--cores", type=int, default=1, help="cores to run on")
    options = parser.parse_args()
    limit_cores(options.cores)
    few = 10 if options.quick else 1
    rounds = 3 if options.quick else options.rounds
    chain, batch, wide = 100_000 // few, 1000 // few, 200 // few
    ratios: list[dict[str, Any]] = []
    record: list[dict[str, Any]] = []

    def keep(case: Case, timings: dict[str, Timing]) -> dict[str, Timing]:
        for timing in timings.values():
            record.append({"case": case.label, "horizon": case.steps} | timing.row())
        return timings

    def ratio(what: str, a: Timing | None, b: Timing | None, limit: str) -> None:
        if a is not None and b is not None:
            ratios.append({"ratio": what, "measured": a.ratio(b), "limit": limit})

    for workload in ("trajectory", "cost"):
        case = Case(workload, chain)
        t = keep(case, run(case, rounds))
        ratio(f"chain, {workload}: delucax / raw", t["delucax"], t[RAW], "<= 1.3")
        slow = t.get("Gymnasium")
        ratio(f"chain, {workload}: Gymnasium / delucax", slow, t["delucax"], ">= 300")
        for lanes, steps in ((1024, batch), (16384, wide)):
            case = Case(workload, steps, lanes)
            t = keep(case, run(case, rounds))
            what = f"{lanes} lanes, {workload}:"
            ours, user = t["delucax"], t["delucax, user's pendulum"]
            main_case = workload == "cost" and lanes == 1024
            for name in ("gymnax step", "gymnax step_env"):
                limit = ">= 10" if main_case and name == "gymnax step" else ""
                ratio(f"{what} {name} / delucax", t.get(name), ours, limit)
            ratio(f"{what} delucax / C", ours, t.get("C"), "<= 2.5" * main_case)
            ratio(f"{what} delucax / raw", ours, t[RAW], "")
            ratio(f"{what} user's / delucax", user, ours, "<= 1.1" * main_case)
    for workload in ("trajectory", "cost", "gradient"):
        case = Case(workload, batch, 1024, "tsit5")
        t = keep(case, run(case, rounds))
        what = f"1024 lanes, Tsit5, {workload}: Diffrax step / delucax"
        ratio(what, t["delucax, Diffrax step"], t["delucax"], ">= 3")
    for method in ("gym", "rk4", "tsit5"):
        for lanes in (None, 1024):
            for steps in (200, 10_000):
                if lanes and steps > 200 and options.quick:
                    continue
                case = Case("gradient", steps, lanes, method)
                t = keep(case, run(case, rounds if steps == 200 else min(rounds, 7)))
                limit = "" if method == "tsit5" else "<= 4" if lanes is None else "<= 5"
                what = f"{case.label}, T = {steps}: delucax / raw forward"
                ratio(what, t["delucax"], t[f"{RAW}, forward"], limit)
    for lanes, steps in ((None, chain), (1024, batch)):
        case = Case("trajectory", steps, lanes)
        t = keep(case, run(case, rounds, noise_entries(lanes, steps)))
        what = "chain" if lanes is None else f"{lanes} lanes"
        gaussian, plain = t["delucax, Gaussian w"], t["delucax"]
        ratio(f"{what}: Gaussian w / none", gaussian, plain, "<= 1.6")
        noisy, calm = t["delucax, Euler-Maruyama"], t["delucax, Euler"]
        ratio(f"{what}: Euler-Maruyama / Euler", noisy, calm, "<= 1.5")

    summary = pd.DataFrame(ratios)
    print("\nRatios (median over the rounds of one run)")
    print(summary.to_string(index=False, float_format="%.2f"))
    single = calls()
    single["import delucax / import diffrax, optax, lineax"] = imports()
    print("\nSingle calls")
    limited = pd.DataFrame({"measured": single, "at most": pd.Series(LIMITS)})
    print(limited.loc[list(single)].to_string(float_format="%.3f", na_rep=""))
    needed = memory(1_000_000 // few)
    print(f"\nMemory of the gradient, one chain, {1_000_000 // few} steps (MB)")
    print(pd.Series(needed).to_string(float_format="%.2f"))
    if not options.quick:
        out = Path(options.out)
        out.parent.mkdir(parents=True, exist_ok=True)
        content = {
            "machine": describe(),
            "gymnax": gymnax_peer.versions(),
            "ratios": ratios,
            "single calls": single,
            "gradient memory, 1e6 steps, MB": needed,
            "timings": record,
        }
        out.write_text(json.dumps(content, indent=1) + "\n")
        print(f"\nwritten: {out}")


if __name__ == "__main__":
    main()
