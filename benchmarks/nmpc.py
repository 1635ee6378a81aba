"""`python -m benchmarks.nmpc`: nonlinear programs of model predictive control.

In double precision, each from the same guess: `planning.SQP` against FATROP and IPOPT
with CasADi, functions expanded, in time, cost and violation; the feedback of a
real-time iteration; and the seconds of first answers, each in a fresh process. Prints
tables, and writes `benchmarks/results/nmpc.json`, and the same pinned to one core in
`pinned/`. CasADi is installed into an environment of its own.
"""

import argparse
import json
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd

import delucax as dlx
from benchmarks._machine import compile_anew, describe, run_in_settings
from benchmarks._plans import AT_REST, LIMITED, Plans, pull
from benchmarks._timing import in_fresh_process
from benchmarks.planning import Charged, Discrete, guess_of, PEERS, Worker


LIMITS = {"ratio, n <= 6": 1.5, "ratio, chain": 4.0, "cost": 1e-6, "violation": 1e-8}
FEEDBACK_MS = {"median": 1.0, "p99": 2.0}
TOLERANCE = 1e-9
"""Relative: states of some hundreds must meet to the violation allowed."""
GUST = 0.2
"""The standard deviation of the change of each velocity, in m/s and rad/s."""


def constraints_of(case: Plans) -> Any:
    """The constraints of a case."""
    obstacle = case.obstacle
    function = None if obstacle is None else lambda t, x, u: obstacle(jnp, x)
    states = None if case.room is None else tuple(map(np.array, case.room))
    return dlx.planning.Constraints(function, states=states)


def problem_of(case: Plans) -> tuple[dict[str, Any], Any, Any]:
    """The arguments of our planner, and its guess."""
    given = dict(
        dynamics=Discrete(case),
        cost=Charged(case),
        bounds=case.limits,
        constraints=constraints_of(case),
    )
    states, controls = guess_of(case, case.x0)
    return given, jnp.array(states), jnp.array(controls)


def violation_of(case: Plans, plan: Any) -> float:
    """The largest violation, by the functions of the case."""
    reached = jax.vmap(lambda x, u: case.step(jnp, x, u))(
        plan.states[:-1], plan.controls
    )
    worst = [jnp.max(jnp.abs(reached - plan.states[1:]))]
    if case.obstacle is not None:
        obstacle = case.obstacle
        values = jax.vmap(lambda x: obstacle(jnp, x))(plan.states[1:-1])
        worst.append(jnp.max(values))
    if case.room is not None:
        low, high = map(np.array, case.room)
        worst.append(jnp.max(low - plan.states[1:]))
        worst.append(jnp.max(plan.states[1:] - high))
    return float(jnp.max(jnp.stack(worst)))


def solves(casadi: Worker, rounds: int) -> list[dict[str, Any]]:
    """A converged solve of each case, in turn with the peers."""
    rows = []
    for name, case in LIMITED.items():
        given, states, controls = problem_of(case)
        planner = dlx.planning.SQP(tolerance=TOLERANCE, states=states)
        x0 = jnp.array(case.x0)
        solve = lambda p=planner, x=x0, u=controls, g=given: jax.block_until_ready(
            p(x0=x, controls=u, throw=False, **g)
        )
        plan = solve()
        peers = {s: casadi.ask(build=name, solver=s) for s in ("fatrop", "ipopt")}
        guess = states.tolist(), controls.tolist()
        ask = dict(starts=[list(case.x0)], guess=guess)
        seconds: dict[str, list[float]] = {"ours": [], "fatrop": [], "ipopt": []}
        answers = {}
        for _ in range(rounds):
            began = time.perf_counter()
            solve()
            seconds["ours"].append(time.perf_counter() - began)
            for solver, built in peers.items():
                answers[solver] = casadi.ask(solve=built["id"], **ask)
                seconds[solver].append(answers[solver]["seconds"])
        ms = {who: 1e3 * float(np.median(s)) for who, s in seconds.items()}
        cost = answers["ipopt"]["costs"][0]
        fine = {solver: answer["success"][0] for solver, answer in answers.items()}
        fastest = min((ms[solver] for solver in fine if fine[solver]), default=np.nan)
        rows.append(
            {
                "case": name,
                "result": str(dlx.RESULTS[plan.result]) or "successful",
                "iterations": int(plan.iterations),
                "cost": float(plan.cost),
                "IPOPT's cost": cost,
                "relative difference": (float(plan.cost) - cost) / abs(cost),
                "violation": violation_of(case, plan),
                "ms": ms["ours"],
                "FATROP, ms": ms["fatrop"] if fine["fatrop"] else None,
                "IPOPT, ms": ms["ipopt"] if fine["ipopt"] else None,
                "ratio": ms["ours"] / fastest,
            }
        )
        print(pd.DataFrame(rows[-1:]).to_string(index=False, header=len(rows) == 1))
    return rows


def real_time(steps: int) -> dict[str, float]:
    """The two phases of a real-time iteration of the quadrotor among discs, T = 30,
    from its start again every 100 steps, under a gust every 20."""
    case = replace(LIMITED["quadrotor among discs"], horizon=30)
    mpc = receding(case)
    rng = np.random.default_rng(0)
    step = jax.jit(lambda x, u: case.step(jnp, x, u))
    spent: dict[str, list[float]] = {"preparation": [], "feedback": []}
    work, failures = [], 0
    for run in range(steps // 100 + 1):
        x, state = np.array(case.x0), mpc.init()
        for k in range(100):
            t = k * case.dt
            began = time.perf_counter()
            state = jax.block_until_ready(mpc.prepare(t, state))
            between = time.perf_counter()
            u, state = jax.block_until_ready(mpc.feedback(t, x, state))
            # The first run compiles.
            if run > 0:
                spent["preparation"].append(between - began)
                spent["feedback"].append(time.perf_counter() - between)
                work.append(int(state.iterations))
            x = np.asarray(step(x, u))
            if k % 20 == 19:
                x = x + np.append(np.zeros(3), GUST * rng.normal(size=3))
        failures += int(state.failures.count) if run > 0 else 0
    row: dict[str, float] = {"steps": len(work), "failures": failures}
    for phase, seconds in spent.items():
        row[f"{phase}, median ms"] = 1e3 * float(np.median(seconds))
        row[f"{phase}, p99 ms"] = 1e3 * float(np.percentile(seconds, 99))
    row["linear systems, median"] = float(np.median(work))
    row["linear systems, most"] = max(work)
    return row


def receding(case: Plans) -> Any:
    """The real-time iteration of a case, from a plan for its start."""
    given, states, controls = problem_of(case)
    plan = dlx.planning.SQP(states=states)(
        x0=jnp.array(case.x0), controls=controls, **given
    )
    dynamics, cost = given.pop("dynamics"), given.pop("cost")
    start = dlx.planning.Start(plan.controls, plan.states, plan.gains, plan.multipliers)
    return dlx.controllers.MPC(
        dynamics, cost, case.horizon, start=start, real_time=True, throw=False, **given
    )


FIRST = """
import time
import jax, jax.numpy as jnp
import delucax as dlx
from dataclasses import replace
from benchmarks import nmpc
from benchmarks._plans import LIMITED
case = LIMITED["{name}"]
given, states, controls = nmpc.problem_of(case)
jax.block_until_ready(states)
mpc = nmpc.receding(replace(case, horizon=30)) if {real_time} else None
start = time.perf_counter()
if {real_time}:
    u, _ = mpc(0.0, jnp.array(case.x0), mpc.init())
    jax.block_until_ready(u)
else:
    planner = dlx.planning.SQP(states=states)
    plan = planner(x0=jnp.array(case.x0), controls=controls, throw=False, **given)
    jax.block_until_ready(plan.cost)
print(time.perf_counter() - start)
"""


def first_answers() -> dict[str, float]:
    """Seconds from a problem to its first answer, each in a fresh process."""
    seconds = {}
    for name, is_real_time in [
        *((name, False) for name in LIMITED),
        ("quadrotor among discs", True),
    ]:
        label = f"{name}, a real-time iteration" if is_real_time else name
        code = FIRST.format(name=name, real_time=is_real_time)
        seconds[label] = in_fresh_process(code)
    return seconds


def measure(options: argparse.Namespace, folder: Path) -> None:
    """All tables under one setting."""
    jax.config.update("jax_enable_x64", True)
    compile_anew()
    began = time.perf_counter()
    still = pull(jnp, jnp.array(AT_REST), jnp.zeros(3)) - jnp.array(AT_REST)
    assert jnp.max(jnp.abs(still)) < 1e-12, "the chain does not rest"
    casadi = Worker("casadi", *PEERS["casadi"])
    results: dict[str, Any] = {"machine": describe(), "limits": LIMITS}
    results["limits, feedback ms"] = FEEDBACK_MS
    results["solves"] = solves(casadi, options.rounds)
    casadi.close()
    results["real time"] = real_time(options.steps)
    print(pd.Series(results["real time"]).to_string())
    results["first answers, s"] = first_answers()
    print(pd.Series(results["first answers, s"]).to_string())
    results["seconds"] = time.perf_counter() - began
    (folder / "nmpc.json").write_text(json.dumps(results, indent=1) + "\n")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rounds", type=int, default=15)
    parser.add_argument("--steps", type=int, default=2000)
    run_in_settings(parser, measure)
