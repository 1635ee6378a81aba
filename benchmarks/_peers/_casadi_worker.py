"""Runs inside CasADi's virtual environment: builds solvers, and solves on request.

Reads one JSON request a line from standard input and answers each with one JSON line:

- `{"build": "quadrotor", "solver": "fatrop"}` -> `{"id": 0, "seconds": 0.2}`
- `{"solve": 0, "starts": [[1, 1, 0, 0, 0, 0]]}` -> one solve after the other:
  `{"seconds": ..., "costs": [...], "success": [...], "iterations": [...],
  "controls": [...]}`, the controls of the last one
- `{"versions": true}` -> `{"casadi": "3.8.2"}`
"""

import json
import sys
import time
from typing import Any

import casadi as ca  # pyright: ignore[reportMissingImports]
import numpy as np

from benchmarks._plans import ALL, Plans


def build(case: Plans, solver: str) -> Any:
    """A function from a start and a guess to states, controls, cost and success."""
    n, m, T = len(case.x0), case.controls, case.horizon
    x, u = ca.SX.sym("x", n), ca.SX.sym("u", m)
    step = ca.Function("step", [x, u], [case.step(ca, x, u)])
    stage = ca.Function("stage", [x, u], [case.stage(ca, x, u)])
    opti = ca.Opti()
    X, U = [], []
    # The order x0 u0 x1 u1 ... is what FATROP finds the structure by.
    for _ in range(T):
        X.append(opti.variable(n))
        U.append(opti.variable(m))
    X.append(opti.variable(n))
    x0 = opti.parameter(n)
    cost = 0
    for k in range(T):
        opti.subject_to(X[k + 1] == step(X[k], U[k]))
        if k == 0:
            opti.subject_to(X[0] == x0)
        if case.limits is not None:
            low, high = case.limits
            opti.subject_to(opti.bounded(low, U[k], high))
        # The first state is given.
        if case.obstacle is not None and k > 0:
            opti.subject_to(case.obstacle(ca, X[k]) <= 0)
        if case.room is not None and k > 0:
            confine(opti, X[k], case.room)
        cost += stage(X[k], U[k])
    if case.room is not None:
        confine(opti, X[T], case.room)
    if case.arrival is not None:
        opti.subject_to(X[T] == np.asarray(case.arrival))
    opti.minimize(cost + case.final(ca, X[T]))
    quiet = {"print_time": False, "expand": True}
    if solver == "fatrop":
        quiet |= {"structure_detection": "auto", "fatrop": {"print_level": 0}}
        quiet["fatrop"]["tol"] = 1e-8
    else:
        quiet["ipopt"] = {"print_level": 0, "sb": "yes", "tol": 1e-10}
    opti.solver(solver, quiet)
    return opti, x0, X, U


def confine(opti: Any, x: Any, room: Any) -> None:
    """Bound the entries of a state that have bounds."""
    for i, (low, high) in enumerate(zip(*room, strict=True)):
        if np.isfinite(low) or np.isfinite(high):
            opti.subject_to(opti.bounded(low, x[i], high))


def solved(opti: Any) -> dict[str, Any]:
    """What one solve from the guess finds, and the time that it takes."""
    began = time.perf_counter()
    try:
        opti.solve()
    except RuntimeError:
        pass
    spent = time.perf_counter() - began
    stats = opti.stats()
    return {
        # Without what Opti does in Python, where the solver says how long it took.
        "seconds": stats.get("t_wall_total", spent),
        "objective": float(opti.debug.value(opti.f)),
        "success": bool(stats["success"]),
        "iterations": int(stats["iter_count"]),
    }


def solve(built: Any, case: Plans, starts: Any, guess: Any) -> dict[str, Any]:
    """One after the other, each from the guess."""
    opti, x0, X, U = built
    costs, fine, iterations, seconds = [], [], [], 0.0
    states, controls = guess
    for start in starts:
        opti.set_value(x0, start)
        for k, u in enumerate(U):
            opti.set_initial(X[k], states[k])
            opti.set_initial(u, controls[k])
        opti.set_initial(X[-1], states[-1])
        answer = solved(opti)
        seconds += answer["seconds"]
        costs.append(answer["objective"])
        fine.append(answer["success"])
        iterations.append(answer["iterations"])
    found = [np.atleast_1d(opti.debug.value(u)).tolist() for u in U]
    return {
        "seconds": seconds,
        "costs": costs,
        "success": fine,
        "iterations": iterations,
        "controls": found,
    }


def main() -> None:
    """Answer requests until standard input ends."""
    ready: list[Any] = []
    for line in sys.stdin:
        request = json.loads(line)
        answer: dict[str, Any]
        if "build" in request:
            began = time.perf_counter()
            case = ALL[request["build"]]
            try:
                ready.append((build(case, request["solver"]), case))
                seconds = time.perf_counter() - began
                answer = {"id": len(ready) - 1, "seconds": seconds}
            except Exception as error:  # what a plugin that is not there raises
                answer = {"error": str(error)[:300]}
        elif "solve" in request:
            built, case = ready[request["solve"]]
            answer = solve(built, case, request["starts"], request["guess"])
        else:
            answer = {"casadi": ca.__version__}
        print(json.dumps(answer), flush=True)


if __name__ == "__main__":
    main()
