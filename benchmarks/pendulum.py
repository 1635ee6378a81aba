"""`python -m benchmarks.pendulum`: the pendulum against every peer, in one run.

Prints a table a case, then the ratios that matter beside their limits, and writes
`benchmarks/results/pendulum.json`, and the same pinned to one core in `pinned/`.
`--part chain` measures one part of it again.
"""

import argparse
import functools
import subprocess
import sys
import time
from dataclasses import dataclass, field
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
from benchmarks._machine import compile_anew, describe, run_in_settings
from benchmarks._peers import c, gymnax_peer, raw
from benchmarks._problem import Case
from benchmarks._results import updated
from benchmarks._timing import Contender, Missing, race, Timing


RAW = "raw, delucax.math"
JNP = raw.NAME
RUN = "delucax, run"
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
        # What a gradient is measured against: the run that it differentiates.
        run = Case("cost", case.steps, case.lanes, case.method)
        found.append(_ours.contender(run, name=RUN))
        forward = Case("trajectory", case.steps, case.lanes, case.method)
        found.append(raw.contender(forward, numerics=OURS, name=f"{RAW}, forward"))
    if case.method == "gym" and case.workload in ("trajectory", "cost"):
        user = _ours.environment(case, dynamics=_ours.UserPendulum())
        found.append(_ours.contender(case, name="delucax, user's pendulum", env=user))
        found.append(c.contender(case))
        found.append(gymnax_peer.contender(case, stepping="step"))
        found.append(gymnax_peer.contender(case, stepping="step_env"))
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


@dataclass
class Run:
    """What a part has measured, and with how much of everything."""

    quick: bool
    rounds: int
    timings: list[dict[str, Any]] = field(default_factory=list)
    ratios: list[dict[str, Any]] = field(default_factory=list)

    def scaled(self, steps: int) -> int:
        """Steps of a run, a tenth if it is quick."""
        return steps // 10 if self.quick else steps

    def race(
        self, case: Case, found: list[Any] | None = None, rounds: int | None = None
    ) -> dict[str, Timing]:
        """Race a case, print its table and keep it."""
        found = entries(case) if found is None else found
        ready = [entry for entry in found if isinstance(entry, Contender)]
        timings = race(ready, rounds=min(self.rounds, rounds or self.rounds))
        print(f"\n{case.label}, {case.steps} steps")
        table = pd.DataFrame([timing.row(timings[0]) for timing in timings])
        text = table.to_string(index=False, float_format="%.3g", na_rep="")
        print(text, flush=True)
        for entry in found:
            if isinstance(entry, Missing):
                print(f"  not there: {entry.name} ({entry.reason})")
        about = {"case": case.label, "horizon": case.steps}
        self.timings += [about | timing.row() for timing in timings]
        return {timing.name: timing for timing in timings}

    def ratio(
        self,
        what: str,
        a: Timing | None,
        b: Timing | None,
        limit: str = "",
        **about: str,
    ) -> None:
        """Keep how many times as long `a` takes, where both are there."""
        if a is not None and b is not None:
            row = {"ratio": what, "measured": a.ratio(b), "limit": limit}
            self.ratios.append(row | about)

    def by_hand(self, what: str, t: dict[str, Timing], limit: str = "") -> None:
        """Against what a user writes, in plain `jnp`; and, as a note, with our sine."""
        self.ratio(f"{what} delucax / by hand, jnp", t["delucax"], t[JNP], limit)
        self.ratio(f"{what} delucax / by hand, dlx.math", t["delucax"], t[RAW])


def measure_chain(run: Run) -> None:
    """One pendulum."""
    for workload in ("trajectory", "cost"):
        t = run.race(Case(workload, run.scaled(100_000)))
        run.by_hand(f"chain, {workload}:", t, "<= 1.3")


def measure_batch(run: Run) -> None:
    """Many pendulums at once."""
    for workload in ("trajectory", "cost"):
        for lanes, steps in ((1024, 1000), (16384, 200)):
            t = run.race(Case(workload, run.scaled(steps), lanes))
            what = f"{lanes} lanes, {workload}:"
            ours, user = t["delucax"], t["delucax, user's pendulum"]
            main_case = workload == "cost" and lanes == 1024
            for name in ("gymnax step", "gymnax step_env"):
                limit = ">= 10" if main_case and name == "gymnax step" else ""
                run.ratio(f"{what} {name} / delucax", t.get(name), ours, limit)
            run.ratio(f"{what} delucax / C", ours, t.get("C"), "<= 2.5" * main_case)
            run.by_hand(what, t)
            run.ratio(f"{what} user's / delucax", user, ours, "<= 1.1" * main_case)


def measure_tsit5(run: Run) -> None:
    """Tsit5 against Diffrax's own step."""
    for workload in ("trajectory", "cost", "gradient"):
        t = run.race(Case(workload, run.scaled(1000), 1024, "tsit5"))
        what = f"1024 lanes, Tsit5, {workload}: Diffrax step / delucax"
        run.ratio(what, t["delucax, Diffrax step"], t["delucax"], ">= 3")


def measure_gradient(run: Run) -> None:
    """Gradients against the runs that they differentiate."""
    for method in ("gym", "rk4", "tsit5"):
        for lanes in (None, 1024):
            for steps in (200, 10_000):
                if lanes and steps > 200 and run.quick:
                    continue
                case = Case("gradient", steps, lanes, method)
                t = run.race(case, rounds=None if steps == 200 else 7)
                what = f"{case.label}, T = {steps}:"
                kind = f"gradient / run, {case.label.rpartition(', ')[2]}"
                name = f"{what} gradient / run"
                run.ratio(name, t["delucax"], t[RUN], kind=kind)
                limit = "" if method == "tsit5" else "<= 4" if lanes is None else "<= 5"
                scan = t[f"{RAW}, forward"]
                what_else = f"{what} gradient / scan, dlx.math"
                run.ratio(what_else, t["delucax"], scan, limit)
                run.by_hand(what, t)


def measure_noise(run: Run) -> None:
    """What noise costs."""
    for lanes, steps in ((None, 100_000), (1024, 1000)):
        case = Case("trajectory", run.scaled(steps), lanes)
        t = run.race(case, noise_entries(lanes, case.steps))
        what = "chain" if lanes is None else f"{lanes} lanes"
        gaussian, plain = t["delucax, Gaussian w"], t["delucax"]
        run.ratio(f"{what}: Gaussian w / none", gaussian, plain, "<= 1.6")
        noisy, calm = t["delucax, Euler-Maruyama"], t["delucax, Euler"]
        run.ratio(f"{what}: Euler-Maruyama / Euler", noisy, calm, "<= 1.5")


RACES = {
    "chain": measure_chain,
    "batch": measure_batch,
    "tsit5": measure_tsit5,
    "gradient": measure_gradient,
    "noise": measure_noise,
}


PARTS = (*RACES, "calls")


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
    policy = dlx.controllers.mlp_policy(env, width=32, depth=2, key=key)
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
    """How much longer `import delucax`, with its core, takes than the libraries it
    stands on."""

    def seconds(statement: str) -> float:
        start = time.perf_counter()
        subprocess.run([sys.executable, "-c", statement], check=True)
        return time.perf_counter() - start

    core = "from delucax import make, math, rollout, simulate"
    statements = (core, "import diffrax, optax, lineax")
    taken = [[seconds(s) for s in statements] for _ in range(repeats + 1)][1:]
    ours, theirs = np.median(taken, axis=0)
    return float(ours / theirs)


def measure_calls(run: Run) -> dict[str, Any]:
    """Single calls, and the memory of a gradient."""
    single = calls()
    single["import delucax / import diffrax, optax, lineax"] = imports()
    print("\nSingle calls")
    limited = pd.DataFrame({"measured": single, "at most": pd.Series(LIMITS)})
    print(limited.loc[list(single)].to_string(float_format="%.3f", na_rep=""))
    steps = run.scaled(1_000_000)
    needed = memory(steps)
    print(f"\nMemory of the gradient, one chain, {steps} steps (MB)")
    print(pd.Series(needed).to_string(float_format="%.2f"))
    return {"single calls": single, "gradient memory, 1e6 steps, MB": needed}


def merged(before: dict[str, Any], part: str, run: Run) -> dict[str, Any]:
    """The races of a part in the place of what was stored of it."""
    kept = {
        name: [row for row in before.get(name, []) if row["part"] != part]
        for name in ("ratios", "timings")
    }
    made = {"ratios": run.ratios, "timings": run.timings}
    return {n: kept[n] + [{"part": part} | row for row in made[n]] for n in kept}


def measure(options: argparse.Namespace, folder: Path) -> None:
    """Run the parts, print them and write each when it is done."""
    compile_anew()
    out = folder / "pendulum.json"
    for part in [options.part] if options.part else PARTS:
        run = Run(options.quick, 3 if options.quick else options.rounds)
        if part == "calls":
            made = measure_calls(run)
        else:
            RACES[part](run)
            print("\nRatios of the best rounds")
            summary = pd.DataFrame(run.ratios)
            print(summary.to_string(index=False, float_format="%.2f"), flush=True)
            made = None
        if options.quick:
            continue
        about = {"machine": describe(), "gymnax": gymnax_peer.versions()}

        def change(before, part=part, run=run, made=made, about=about):
            machines = before.get("parts", {}) | {part: about}
            return {"parts": machines} | (made or merged(before, part, run))

        updated(out, change)
        print(f"\nwritten: {out}")


def main() -> None:
    """Run under both settings."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.pendulum")
    parser.add_argument("--rounds", type=int, default=15)
    parser.add_argument("--quick", action="store_true", help="small sizes, no file")
    parser.add_argument("--part", choices=PARTS, help="one part alone, again")
    run_in_settings(parser, measure)


if __name__ == "__main__":
    main()
