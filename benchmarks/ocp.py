"""`python -m benchmarks.ocp`: problems of optimal control with published optima.

In double precision, each from the start of its page: `planning.SQP` against IPOPT with
CasADi, by the same steps from the same guess, functions expanded; the objective and the
violation of our controls with adaptive steps; derivatives of optima against central
differences; and the seconds of first answers, each in a fresh process. Prints tables,
and writes `benchmarks/results/ocp.json`, and the same pinned to one core in `pinned/`.
CasADi is installed into an environment of its own. `--draw` solves the problems and
draws `docs/assets/optimal_control.svg`, no more.
"""

import argparse
import json
import time
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd

import delucax as dlx
from benchmarks._machine import compile_anew, describe, run_in_settings
from benchmarks._optimal import PROBLEMS
from benchmarks._timing import in_fresh_process
from benchmarks.planning import PEERS, Worker


FIGURE = Path(__file__).parents[1] / "docs/assets/optimal_control.svg"
LIMITS = {
    "objective, relative": 1e-4,
    "violation": 1e-5,
    "ratio": 5.0,
    "first answer, s": 15.0,
    "derivative, relative": 1e-5,
}


def guess_of(name: str, problem: Any) -> dict[str, Any]:
    """The guess of a problem and the lengths of its steps, for a peer."""
    states = problem.states
    if states is None:
        states = dlx.open_loop(problem.dynamics, problem.x0, problem.controls)
    dynamics, guess = problem.dynamics, {}
    widths = [float(dynamics.dt)] * problem.horizon
    if PROBLEMS[name].rates:
        widths = dynamics.widths.tolist()
        guess["rates"] = dynamics.inner.system.rates.tolist()
    return guess | dict(
        states=states.tolist(), controls=problem.controls.tolist(), widths=widths
    )


def solves(casadi: Worker, rounds: int) -> list[dict[str, Any]]:
    """Each problem, in turn with the peer."""
    rows = []
    for name in dlx.problems.NAMES:
        problem = getattr(dlx.problems, name)()
        solve = lambda p=problem: jax.block_until_ready(p.solve(throw=False))
        plan = solve()
        built = casadi.ask(build=name, **guess_of(name, problem))
        seconds: dict[str, list[float]] = {"ours": [], "ipopt": []}
        answer: dict[str, Any] = {}
        for _ in range(rounds):
            began = time.perf_counter()
            solve()
            seconds["ours"].append(time.perf_counter() - began)
            answer = casadi.ask(solve=built["id"])
            seconds["ipopt"].append(answer["seconds"])
        simulated = problem.simulate(plan)
        ms = {who: 1e3 * float(np.median(s)) for who, s in seconds.items()}
        found, reference = float(simulated.objective), problem.reference
        rows.append(
            {
                "problem": name,
                "result": str(dlx.RESULTS[plan.result]) or "successful",
                "iterations": int(plan.iterations),
                "published": reference,
                "objective": float(problem.objective(plan)),
                "simulated": found,
                "relative difference": (found - reference) / abs(reference),
                "violation": float(simulated.violation),
                "IPOPT's objective": abs(answer["objective"]) * np.sign(reference),
                "IPOPT's iterations": answer["iterations"],
                "IPOPT succeeds": answer["success"],
                "ms": ms["ours"],
                "IPOPT, ms": ms["ipopt"],
                "ratio": ms["ours"] / ms["ipopt"],
            }
        )
        print(pd.DataFrame(rows[-1:]).to_string(index=False, header=len(rows) == 1))
    return rows


FIRST = """
import time
import jax
import delucax as dlx
jax.block_until_ready(jax.numpy.zeros(1) + 1)
start = time.perf_counter()
plan = dlx.problems.{name}().solve(throw=False)
jax.block_until_ready(plan.cost)
print(time.perf_counter() - start)
"""


def first_answers() -> dict[str, float]:
    """Seconds from a name to a solution, each in a fresh process."""
    names = dlx.problems.NAMES
    return {name: in_fresh_process(FIRST.format(name=name)) for name in names}


SLOPES = {
    ("particle_steering", "dynamics.system.acceleration"): 0.1,
    ("robot_arm", "dynamics.system.length"): 1e-3,
    ("goddard_rocket", "dynamics.system.drag"): 1.0,
    ("hang_glider", "dynamics.system.updraft"): 1e-3,
    ("catalyst_mixing", "dynamics.system.rate"): 1e-2,
    ("alpha_pinene", "x0"): 0.1,
}
"""A constant of a problem, and the step of its differences."""


def derivatives() -> list[dict[str, Any]]:
    """The derivative of an optimum against central differences."""
    rows = []
    for (name, path), step in SLOPES.items():
        problem = getattr(dlx.problems, name)()
        planner = dlx.planning.SQP(states=problem.states, tolerance=1e-10)
        node = problem
        for part in path.split("."):
            node = getattr(node, part)
        along = (jnp.arange(jnp.size(node)) == 0).reshape(jnp.shape(node))

        @jax.jit
        def optimum(change, given=(problem, planner, path, node, along)):
            problem, planner, path, node, along = given
            moved = dlx.replace(problem, {path: node + change * along})
            return moved.solve(planner, throw=False).cost

        slope = float(jax.grad(optimum)(0.0))
        difference = float(optimum(step) - optimum(-step)) / (2 * step)
        rows.append(
            {
                "problem": name,
                "constant": path,
                "derivative": slope,
                "difference": difference,
                "relative error": abs(slope / difference - 1),
            }
        )
    return rows


TITLES = {
    "particle_steering": "particle: angle, rad",
    "robot_arm": "robot arm: slide, turn, lift",
    "goddard_rocket": "rocket: thrust",
    "hang_glider": "glider: lift",
    "catalyst_mixing": "catalysts: mixture",
    "hanging_chain": "chain: slope",
    "gas_oil_cracking": "gas oil: fractions",
    "methanol_to_hydrocarbons": "methanol: fractions",
    "alpha_pinene": "alpha-pinene: shares, %",
}


def draw() -> None:
    """The controls that were found, and the fits beside the measurements."""
    import matplotlib.pyplot as plt

    plt.style.use("delucax.plotting.style")
    figure, axes = plt.subplots(3, 3, figsize=(9.5, 6.5), layout="constrained")
    for (name, title), ax in zip(TITLES.items(), axes.flat, strict=True):
        problem = getattr(dlx.problems, name)()
        plan = problem.solve()
        if PROBLEMS[name].rates:
            simulated = problem.simulate(plan)
            widths = np.repeat(problem.dynamics.widths / 10, 10)
            times = np.concatenate([[0.0], np.cumsum(widths)])
            lines = ax.plot(times, simulated.states, lw=1.2)
            for i, line in enumerate(lines):
                ax.plot(times[::10], problem.states[:, i], ".", color=line.get_color())
        else:
            times = np.linspace(0, plan.duration, problem.horizon + 1)
            for control in plan.controls.T:
                ax.stairs(control, times, baseline=None, lw=1.2)
        ax.set_title(title, fontsize=10)
    figure.supxlabel("time")
    figure.savefig(FIGURE, metadata={"Date": None})
    lines = FIGURE.read_text().splitlines()
    FIGURE.write_text("\n".join(line.rstrip() for line in lines) + "\n")


def measure(options: argparse.Namespace, folder: Path) -> None:
    """All tables under one setting."""
    jax.config.update("jax_enable_x64", True)
    if options.draw:
        draw()
        return
    compile_anew()
    began = time.perf_counter()
    casadi = Worker("casadi", *PEERS["casadi"], worker="casadi_optimal")
    results: dict[str, Any] = {"machine": describe(), "limits": LIMITS}
    results["solves"] = solves(casadi, options.rounds)
    casadi.close()
    results["derivatives"] = derivatives()
    print(pd.DataFrame(results["derivatives"]).to_string(index=False))
    results["first answers, s"] = first_answers()
    print(pd.Series(results["first answers, s"]).to_string())
    results["seconds"] = time.perf_counter() - began
    (folder / "ocp.json").write_text(json.dumps(results, indent=1) + "\n")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rounds", type=int, default=11)
    parser.add_argument("--draw", action="store_true", help="the figure alone")
    run_in_settings(parser, measure)
