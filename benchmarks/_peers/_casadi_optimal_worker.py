"""Runs inside CasADi's virtual environment: solves problems of optimal control by
multiple shooting and IPOPT.

Reads one JSON request a line from standard input and answers each with one JSON line:

- `{"build": "robot_arm", "states": ..., "controls": ..., "widths": ..., "rates": ...}`:
  the guess and the lengths of the steps -> `{"id": 0, "seconds": 0.2}`
- `{"solve": 0}` -> `{"seconds": ..., "objective": ..., "success": ..., "iterations":
  ...}`
- `{"versions": true}` -> `{"casadi": "3.8.2"}`
"""

import json
import sys
import time
from typing import Any

import casadi as ca  # pyright: ignore[reportMissingImports]
import numpy as np

from benchmarks._optimal import Optimal, PROBLEMS
from benchmarks._peers._casadi_worker import solved


def stepped(case: Optimal, n: int, m: int) -> Any:
    """One step by the classical Runge-Kutta method, of a length that is an argument."""
    x, u = ca.SX.sym("x", n), ca.SX.sym("u", m)
    rates, length = ca.SX.sym("rates", case.rates), ca.SX.sym("length")
    f = lambda x: ca.vertcat(*case.field(ca, x, u, rates))
    at, h = x, length / case.substeps
    for _ in range(case.substeps):
        k1 = f(at)
        k2 = f(at + h / 2 * k1)
        k3 = f(at + h / 2 * k2)
        k4 = f(at + h * k3)
        at = at + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
    return ca.Function("step", [x, u, rates, length], [at])


def build(case: Optimal, request: dict[str, Any]) -> Any:
    """The problem, with its guess."""
    states, controls = np.array(request["states"]), np.array(request["controls"])
    widths = request["widths"]
    T, n = len(states) - 1, states.shape[1]
    m = controls.shape[1] if controls.size else 0
    step, opti = stepped(case, n, m), ca.Opti()
    rates = opti.variable(case.rates) if case.rates else ca.DM(0, 1)
    scale = opti.variable() if case.duration else 1.0
    X, U = [opti.variable(n)], []
    for _ in range(T):
        U.append(opti.variable(m) if m else ca.DM(0, 1))
        X.append(opti.variable(n))
    opti.subject_to(X[0] == states[0])
    for k in range(T):
        opti.subject_to(X[k + 1] == step(X[k], U[k], rates, scale * widths[k]))
        if case.limits is not None:
            opti.subject_to(opti.bounded(case.limits[0], U[k], case.limits[1]))
        for i, (low, high) in enumerate(zip(case.low, case.high, strict=True)):
            if np.isfinite(low) or np.isfinite(high):
                opti.subject_to(opti.bounded(low, X[k + 1][i], high))
        opti.set_initial(X[k + 1], states[k + 1])
        if m:
            opti.set_initial(U[k], controls[k])
    opti.set_initial(X[0], states[0])
    for i, value in case.end.items():
        opti.subject_to(X[-1][i] == value)
    total = sum(widths)
    if case.duration:
        low, high = case.duration
        opti.subject_to(opti.bounded(low / total, scale, high / total))
        opti.set_initial(scale, 1.0)
    if case.rates:
        opti.subject_to(rates >= 0)
        opti.set_initial(rates, request["rates"])
    if case.objective is None:
        opti.minimize(sum(ca.sumsqr(x - y) for x, y in zip(X, states, strict=True)))
    else:
        opti.minimize(case.objective(X, scale * total))
    quiet = {"print_time": False, "expand": True}
    quiet["ipopt"] = {"print_level": 0, "sb": "yes", "tol": 1e-8, "max_iter": 3000}
    opti.solver("ipopt", quiet)
    return opti


def main() -> None:
    """Answer requests until standard input ends."""
    ready: list[Any] = []
    for line in sys.stdin:
        request = json.loads(line)
        if "build" in request:
            began = time.perf_counter()
            ready.append(build(PROBLEMS[request["build"]], request))
            seconds = time.perf_counter() - began
            answer: dict[str, Any] = {"id": len(ready) - 1, "seconds": seconds}
        elif "solve" in request:
            answer = solved(ready[request["solve"]])
        else:
            answer = {"casadi": ca.__version__}
        print(json.dumps(answer), flush=True)


if __name__ == "__main__":
    main()
