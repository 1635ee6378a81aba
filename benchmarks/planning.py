"""`python -m benchmarks.planning`: trajectory optimisation against its peers.

In double precision: the quadrotor of the docs against CasADi (FATROP and
IPOPT) and trajax, all in one run; a thousand random starts; problems with bounds,
obstacles and ends against IPOPT; warm steps of model predictive control; iterative
learning; and how often the dynamics are called. Prints tables, and writes
`benchmarks/results/planning.json`, and the same pinned to one core in `pinned/`.

CasADi and trajax are in virtual environments of their own. Google's trajax is installed
from its repository, so where that cannot be reached it is missing from the table;
`--trajax FOLDER` takes it from a checkout.
"""

import argparse
import functools
import json
import os
import statistics
import subprocess
import time
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
import pandas as pd

import delucax as dlx
from benchmarks._machine import compile_anew, describe, run_in_settings
from benchmarks._plans import CASES, Plans
from benchmarks._timing import compiled, Contender, Missing, race, Timing
from benchmarks._venv import interpreter, ROOT


OPTIMUM = 5.389016
LIMITS = {
    "objective, off the optimum": 1e-6,
    "delucax / FATROP": 1.0,
    "trajax / delucax": 5.0,
    "1,000 starts: CasADi / delucax": 4.0,
    "1,000 starts: dearer than CasADi by, relative": 1e-6,
    "residual": 1e-6,
    "violation": 1e-6,
    "dearer than IPOPT by, relative": 1e-5,
    "warm MPC step, 99th percentile, ms": 2.0,
    "iGPC, 40 iterations, s": 1.0,
}
"""At most these; at least for those that name a peer first."""
PEERS = {
    "casadi": ("casadi==3.8.2",),
    "trajax": ("git+https://github.com/google/trajax",),
}


class Worker:
    """A process in a virtual environment of its own; `ask` sends it one request."""

    def __init__(
        self, name: str, *requirements: str, worker: str | None = None
    ) -> None:
        outside = {k: v for k, v in os.environ.items() if k != "PYTHONPATH"}
        self._process = subprocess.Popen(
            [
                interpreter(name, *requirements),
                "-m",
                f"benchmarks._peers._{worker or name}_worker",
            ],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            cwd=ROOT,
            env=outside | {"JAX_ENABLE_X64": "1"},
        )

    def ask(self, **request: Any) -> dict[str, Any]:
        """The answer to a request, of a line of JSON among whatever a solver prints."""
        assert self._process.stdin is not None and self._process.stdout is not None
        self._process.stdin.write(json.dumps(request) + "\n")
        self._process.stdin.flush()
        for line in self._process.stdout:
            if line.startswith("{"):
                return json.loads(line)
        raise RuntimeError(f"the process ended with status {self._process.wait()}")

    def close(self) -> None:
        """End the process."""
        assert self._process.stdin is not None
        self._process.stdin.close()
        self._process.wait()


class Discrete(dlx.AbstractDynamics):
    """A problem's dynamics."""

    case: Plans = eqx.field(static=True)

    @property
    def dt(self):
        return jnp.asarray(self.case.dt)

    @property
    def state_names(self):
        return tuple(f"x{i}" for i in range(len(self.case.x0)))

    @property
    def control_names(self):
        return tuple(f"u{i}" for i in range(self.case.controls))

    def advance(self, t, x, u, w):
        return self.case.step(jnp, x, u), dlx.RESULTS.successful


class Charged(dlx.AbstractCost):
    """A problem's cost."""

    case: Plans = eqx.field(static=True)

    def __call__(self, t, x, u):
        return self.case.stage(jnp, x, u)

    def final(self, t, x):
        return self.case.final(jnp, x)


def planned(case: Plans, x0: Any, controls: Any, **options: Any) -> Any:
    """Our plan of a case."""
    bounds = case.limits
    constraints = None
    if case.obstacle is not None or case.arrival is not None:
        obstacle, arrival = case.obstacle, case.arrival
        constraints = dlx.planning.Constraints(
            None if obstacle is None else lambda t, x, u: obstacle(jnp, x),
            final_equality=None
            if arrival is None
            else lambda t, x: x - np.array(arrival),
        )
    given = Discrete(case), Charged(case), x0, controls
    planner = dlx.planning.ILQR(**options)
    return planner(*given, bounds=bounds, constraints=constraints, throw=False)


def guess_of(case: Plans, x0: Any) -> tuple[Any, Any]:
    """States and controls that all start from: the control at rest, and where it
    leads; or, where an end is given, the line to it, without which IPOPT finds none."""
    U = np.full((case.horizon, case.controls), case.rest)
    towards = case.arrival if case.towards is None else case.towards
    if towards is not None:
        return np.linspace(x0, towards, case.horizon + 1).tolist(), U.tolist()
    X = dlx.open_loop(Discrete(case), jnp.asarray(x0), jnp.asarray(U))
    return np.asarray(X).tolist(), U.tolist()


class Table:
    """Rows with what was measured, the limit, and whether it was met."""

    def __init__(self) -> None:
        self.rows: list[dict[str, Any]] = []

    def add(self, what: str, value: float, limit: str | None = None) -> None:
        """One row; `limit` is the name of one in `LIMITS`."""
        row: dict[str, Any] = {"what": what, "measured": float(value)}
        if limit is not None:
            bound = LIMITS[limit]
            least = limit.startswith("trajax") or "CasADi / " in limit
            row |= {
                "limit": bound,
                "ok": bool(value >= bound if least else value <= bound),
            }
        self.rows.append(row)

    def show(self, title: str) -> None:
        """Print it."""
        print(f"\n{title}")
        table = pd.DataFrame(self.rows)
        print(table.to_string(index=False, float_format="%.7g", na_rep=""), flush=True)


def quadrotor(casadi: Worker, trajax: Worker | str, rounds: int) -> Table:
    """One solve, everyone in turn."""
    case, table = CASES["quadrotor"], Table()
    x0 = jnp.asarray(case.x0)
    guess = guess_of(case, case.x0)
    U = jnp.asarray(guess[1])

    def plan(x0, U):
        plan = planned(case, x0, U)
        return plan.cost, plan.controls, plan.states, plan.gains, plan.iterations

    def exact(x0, U):
        plan = planned(case, x0, U, second_order=True)
        return plan.cost, plan.controls, plan.states, plan.gains, plan.iterations

    ours = {"delucax": plan, "delucax, second order": exact}
    entries = [compiled(name, 1, f, x0, U) for name, f in ours.items()]
    found = {name: float(jax.jit(f)(x0, U)[0]) for name, f in ours.items()}
    for solver in ("fatrop", "ipopt"):
        name = f"CasADi+{solver.upper()}"
        built = casadi.ask(build="quadrotor", solver=solver)
        if "error" in built:
            print(f"{name}: {built['error']}")
            continue
        ask = functools.partial(
            casadi.ask, solve=built["id"], starts=[case.x0], guess=guess
        )
        entries.append(
            Contender(name, 1, lambda ask=ask: ask()["seconds"], built["seconds"])
        )
        found[name] = ask()["costs"][0]
    if isinstance(trajax, str):
        missing = Missing("trajax", trajax)
        print(f"{missing.name} is missing: {missing.reason}")
    else:
        ready = trajax.ask(prepare=True)
        entries.append(
            Contender("trajax", 1, lambda: trajax.ask(measure=True)["seconds"])
        )
        found["trajax"] = ready["cost"]
    timings = {t.name: t for t in race(entries, rounds=rounds)}
    for name, timing in timings.items():
        table.add(f"{name}, ms", statistics.median(timing.seconds) * 1e3)
        limit = "objective, off the optimum" if name.startswith("delucax") else None
        table.add(f"{name}, objective - {OPTIMUM}", abs(found[name] - OPTIMUM), limit)
    best = min(
        (timings[name] for name in ours), key=lambda t: statistics.median(t.seconds)
    )
    if "CasADi+FATROP" in timings:
        fatrop = timings["CasADi+FATROP"]
        for name in ours:
            limit = "delucax / FATROP" if name == best.name else None
            table.add(f"{name} / FATROP", _ratio(timings[name], fatrop), limit)
    if "trajax" in timings:
        ratio = _ratio(timings["trajax"], best)
        table.add(f"trajax / {best.name}", ratio, "trajax / delucax")
    table.show("The quadrotor, T = 100")
    return table


def _ratio(timing: Timing, reference: Timing) -> float:
    """That of the medians, which the tables show."""
    return timing.median / reference.median


def starts(casadi: Worker, count: int) -> Table:
    """Random starts, as a batch and one after the other."""
    case, table = CASES["quadrotor"], Table()
    scale = jnp.array([1.0, 1.0, 0.3, 1.0, 1.0, 0.3])
    x0 = scale * jr.uniform(jr.key(0), (count, 6), minval=-1.0)
    U = jnp.full((case.horizon, 2), case.rest)

    def one(x0, second_order=False):
        plan = planned(case, x0, U, second_order=second_order)
        return plan.cost, plan.controls, plan.result == dlx.RESULTS.successful

    second = functools.partial(one, second_order=True)
    ours = {
        "vmap": jax.vmap(one),
        "lax.map": lambda x0: jax.lax.map(one, x0),
        "vmap, second order": jax.vmap(second),
        "lax.map, second order": lambda x0: jax.lax.map(second, x0),
    }
    built = casadi.ask(build="quadrotor", solver="fatrop")
    solve = functools.partial(
        casadi.ask, solve=built["id"], guess=guess_of(case, x0[0])
    )
    theirs = solve(starts=np.asarray(x0).tolist())
    entries = [compiled(name, count, f, x0) for name, f in ours.items()]
    entries.append(
        Contender(
            "CasADi", count, lambda: solve(starts=np.asarray(x0).tolist())["seconds"]
        )
    )
    timings = {t.name: t for t in race(entries, rounds=5, warmup=1)}
    known, fine = np.asarray(theirs["costs"]), np.asarray(theirs["success"])
    table.add(
        "CasADi+FATROP in a loop, s", statistics.median(timings["CasADi"].seconds)
    )
    table.add("CasADi+FATROP, solved", fine.mean())
    fastest = min(ours, key=lambda name: statistics.median(timings[name].seconds))
    for name, f in ours.items():
        costs, _, good = jax.jit(f)(x0)
        costs, good = np.asarray(costs), np.asarray(good)
        worst = np.max(np.where(fine & good, costs / known - 1, 0))
        table.add(f"{name}, s", statistics.median(timings[name].seconds))
        table.add(f"{name}, solved", good.mean())
        limit = "1,000 starts: dearer than CasADi by, relative"
        table.add(f"{name}: {limit.split(': ')[1]}", worst, limit)
        limit = "1,000 starts: CasADi / delucax" if name == fastest else None
        ratio = _ratio(timings["CasADi"], timings[name])
        table.add(f"CasADi / {name}", ratio, limit)
    table.show(f"{count} random starts")
    return table


def agreement(casadi: Worker) -> Table:
    """Problems with bounds and constraints against IPOPT: from the same guess, and
    from what IPOPT found."""
    table = Table()
    for name, case in CASES.items():
        if name == "quadrotor" or name.startswith("reactor"):
            continue
        x0, guess = jnp.asarray(case.x0), guess_of(case, case.x0)
        built = casadi.ask(build=name, solver="ipopt")
        theirs = casadi.ask(solve=built["id"], starts=[case.x0], guess=guess)
        known = theirs["costs"][0]
        table.add(f"{name}: IPOPT", known)
        table.add(f"{name}: IPOPT, solved", theirs["success"][0])
        solve = jax.jit(lambda U, x0=x0, case=case: planned(case, x0, U))
        for start, U in (("the same guess", guess[1]), ("theirs", theirs["controls"])):
            plan = solve(jnp.asarray(U))
            began = time.perf_counter()
            jax.block_until_ready(solve(jnp.asarray(U)).cost)
            seconds = time.perf_counter() - began
            table.add(f"{name}, from {start}: delucax", plan.cost)
            table.add(f"{name}, from {start}: residual", plan.residual, "residual")
            table.add(f"{name}, from {start}: violation", plan.violation, "violation")
            limit = "dearer than IPOPT by, relative"
            table.add(
                f"{name}, from {start}: {limit}", float(plan.cost) / known - 1, limit
            )
            table.add(f"{name}, from {start}: ms", 1e3 * seconds)
        table.add(f"{name}: IPOPT, ms", 1e3 * theirs["seconds"])
    table.show("Bounds, an obstacle and an end, against IPOPT")
    return table


def receding(steps: int) -> Table:
    """Warm steps of MPC on the pendulum at 50 Hz, as a real loop would take them: one
    call at a time, gusts on the way."""
    table = Table()
    env = dlx.make("pendulum", dt=0.02)
    near = dlx.costs.Quadratic([1.0, 0.1], [0.01], final=[100.0, 10.0])
    smooth = Swung()
    sampled: dict[str, Any] = dict(iterations=2, samples=128, correlation=0.8)
    tried = {
        "iLQR, balancing, 50 steps": (near, 50, {}, 0.2),
        "iLQR, swing-up, 100 steps, at most 8 iterations": (
            smooth,
            100,
            dict(planner=dlx.planning.ILQR(8)),
            np.pi,
        ),
        "MPPI, swing-up, 50 steps": (
            smooth,
            50,
            dict(planner=dlx.planning.MPPI(temperature=0.1, **sampled)),
            np.pi,
        ),
        "CEM, swing-up, 50 steps": (
            smooth,
            50,
            dict(planner=dlx.planning.CEM(elites=16, **sampled)),
            np.pi,
        ),
    }
    advance = jax.jit(lambda x, u, w: env.dynamics.advance(0.0, x, u, w)[0])
    for name, (cost, horizon, options, angle) in tried.items():
        mpc = dlx.controllers.MPC(
            env.dynamics, cost, horizon, bounds=(-2.0, 2.0), **options
        )
        step = eqx.filter_jit(lambda t, y, state, mpc=mpc: mpc(t, y, state))
        x, state = jnp.array([angle, 0.0]), mpc.init(key=jr.key(0))
        gusts = 0.05 * jr.normal(jr.key(1), (steps, 2)) * jnp.array([0.0, 1.0])
        seconds, iterations = [], []
        for k in range(steps):
            t = jnp.asarray(0.02 * k)
            began = time.perf_counter()
            u, state = step(t, x, state)
            u.block_until_ready()
            seconds.append(time.perf_counter() - began)
            iterations.append(int(state.iterations))
            x = advance(x, u, gusts[k])
        warm = 1e3 * np.asarray(seconds[1:])
        table.add(f"{name}: first call with compile, s", seconds[0])
        table.add(f"{name}: median, ms", np.median(warm))
        limit = "warm MPC step, 99th percentile, ms"
        table.add(f"{name}: 99th percentile, ms", np.percentile(warm, 99), limit)
        table.add(f"{name}: most, ms", warm.max())
        table.add(f"{name}: most iterations", max(iterations[1:]))
        table.add(f"{name}: plans that did not succeed", int(state.failures.count))
        table.add(f"{name}: angle at the end", dlx.math.wrap(x[0]))
    table.show(f"Model predictive control, {steps} steps at 50 Hz")
    return table


class Swung(dlx.AbstractCost):
    """Smooth, and of every turn of the pendulum.

    The end weighs no more than a step: where it does, each plan puts off the swing for
    which it must be fast.
    """

    def __call__(self, t, x, u):
        return 1 - jnp.cos(x[0]) + 0.05 * x[1] * x[1] + 0.001 * u[0] * u[0]

    def final(self, t, x):
        return 1 - jnp.cos(x[0]) + 0.05 * x[1] * x[1]


def learning() -> Table:
    """Iterative learning of the quadrotor in wind."""
    table = Table()
    env = dlx.make("planar_quadrotor")
    plant = dlx.make("planar_quadrotor", wind="dissipative", wind_strength=0.4)
    start = jnp.tile(env.dynamics.equilibrium()[1], (100, 1))
    x0 = env.initial_state
    plan = dlx.planning.ilqr(env.dynamics, env.cost, x0, start)
    options: dict[str, Any] = dict(step=0.2, iterations=40)
    learners = {"ILC": dlx.planning.ilc, "iGPC": dlx.planning.igpc}
    for name, learner in learners.items():
        run = lambda learner=learner: learner(
            plant.dynamics, env.dynamics, env.cost, plan, **options
        )
        began = time.perf_counter()
        jax.block_until_ready(run().cost)
        table.add(f"{name}, first call, s", time.perf_counter() - began)
        began = time.perf_counter()
        found = jax.block_until_ready(run())
        limit = "iGPC, 40 iterations, s" if name == "iGPC" else None
        table.add(f"{name}, 40 iterations, s", time.perf_counter() - began, limit)
        table.add(f"{name}, cost", found.cost)
        table.add(f"{name}, runs of the plant", found.rollouts)
    best = dlx.planning.ilqr(plant.dynamics, env.cost, x0, plan.controls)
    table.add("iLQR that knows the wind, cost", best.cost)
    table.show("Iterative learning in wind")
    return table


def calls() -> Table:
    """Evaluations of the dynamics, by the library's counter."""
    table = Table()
    case = CASES["quadrotor"]
    x0, U = jnp.asarray(case.x0), jnp.full((case.horizon, 2), case.rest)
    for name, spacing in (("autodiff", None), ("differences of 1e-2", 1e-2)):

        def solve(dynamics, spacing=spacing):
            planner = dlx.planning.ILQR(finite_difference=spacing)
            return planner(dynamics, Charged(case), x0, U)

        plan, found = dlx.planning.count_evaluations(solve, Discrete(case))
        T = case.horizon
        rolled, looks = T * int(plan.rollouts), int(plan.iterations) + 1
        table.add(f"{name}: objective - {OPTIMUM}", abs(float(plan.cost) - OPTIMUM))
        table.add(f"{name}: iterations", plan.iterations)
        table.add(f"{name}: calls, whole solve", found.primal)
        knot = T * looks
        table.add(f"{name}: calls a knot to linearise", (found.primal - rolled) / knot)
        table.add(f"{name}: tangents a knot", found.tangent / knot)
        table.add(f"{name}: cotangents a knot", found.cotangent / knot)
        run = eqx.filter_jit(
            lambda x0, U, s=spacing: planned(case, x0, U, finite_difference=s)
        )
        jax.block_until_ready(run(x0, U).cost)
        seconds = []
        for _ in range(21):
            began = time.perf_counter()
            jax.block_until_ready(run(x0, U).cost)
            seconds.append(time.perf_counter() - began)
        table.add(f"{name}: ms a solve", 1e3 * statistics.median(seconds))
    table.show("Calls of the dynamics, the quadrotor")
    return table


def measure(options: argparse.Namespace, folder: Path) -> None:
    """Measure, print and write."""
    out = folder / "planning.json"
    compile_anew()
    jax.config.update("jax_enable_x64", True)
    quick = options.quick
    workers: list[Worker] = []

    @functools.cache
    def casadi() -> Worker:
        workers.append(Worker("casadi", *PEERS["casadi"]))
        return workers[-1]

    def trajax() -> Worker | str:
        given = (options.trajax,) if options.trajax else PEERS["trajax"]
        try:
            workers.append(Worker("trajax", *given))
        except RuntimeError as error:
            return str(error).strip().splitlines()[-1]
        return workers[-1]

    parts: dict[str, Any] = {
        "quadrotor": lambda: quadrotor(casadi(), trajax(), 5 if quick else 41),
        "starts": lambda: starts(casadi(), 50 if quick else 1000),
        "agreement": lambda: agreement(casadi()),
        "mpc": lambda: receding(100 if quick else 1000),
        "learning": learning,
        "calls": calls,
    }
    content: dict[str, Any] = {"limits": LIMITS, "peers": PEERS}
    if options.part is not None:
        content = json.loads(out.read_text()) if out.exists() else content
        parts = {options.part: parts[options.part]}
    try:
        for name, part in parts.items():
            content[name] = {"machine": describe(), "checks": part().rows}
    finally:
        for worker in workers:
            worker.close()
    if not quick:
        out.write_text(json.dumps(content, indent=1) + "\n")
        print(f"\nwritten: {out}")


def main() -> None:
    """Run under both settings."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.planning")
    parser.add_argument("--quick", action="store_true", help="small sizes, no file")
    parser.add_argument("--part", help="one table alone, again")
    parser.add_argument("--trajax", help="a checkout of Google's trajax")
    run_in_settings(parser, measure)


if __name__ == "__main__":
    main()
