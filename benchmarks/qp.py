"""`python -m benchmarks.qp --data FOLDER`: quadratic programs against their peers.

In double precision: the public programs of `mpc_qpbenchmark` (Apache-2.0) against
Clarabel and PIQP, judged by the benchmark's own criteria; 128 bounded linear-quadratic
problems against PIQP's staged solver in a loop, with the gradient, and one of them
against HPIPM, OSQP and PIQP behind CasADi; and the seconds of first answers. Prints
tables, and writes `benchmarks/results/qp.json`, and the same pinned to one core in
`pinned/`. `--data` is the folder with the programs as `.npz` files. The peers are
`clarabel`, `piqp` and `casadi`; one that is not installed is missing from the table.
"""

import argparse
import functools
import importlib.util
import json
import statistics
import time
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd

import delucax as dlx
from benchmarks._machine import compile_anew, describe, run_in_settings
from benchmarks._timing import Contender, in_fresh_process, python, race


FAMILIES = "LIPMWALK", "WHLIPBAL", "QUADCMPC", "QUADCMPC in stages"
QUADRUPED = 12
"""The states of the programs in stages, and their controls."""
STATES, CONTROLS, HORIZON, COUNT = 8, 4, 20, 128
FIRST = """
import time
import jax, jax.numpy as jnp, numpy as np
import delucax as dlx
from delucax import qp
start = time.perf_counter()
{make}
jax.block_until_ready(qp.solve(problem).x)
print(time.perf_counter() - start)
"""
PROBLEMS = {
    "dense, 8 variables": "problem = qp.Dense(np.eye(8), np.ones(8), bounds=(-0.5, 1))",
    "staged, n = 8, m = 4, T = 20": (
        "A, B = np.eye(8), np.ones((8, 4)) * 0.1\n"
        "problem = qp.Staged(A, B, A, np.eye(4), start=np.ones(8), horizon=20,"
        " controls=(-1, 1))"
    ),
}


def has(name: str) -> bool:
    """Whether a peer is installed."""
    return importlib.util.find_spec(name) is not None


def load(file: Path) -> dict[str, Any]:
    """A public program, with empty matrices for what it does not have."""
    data = np.load(file)
    get = lambda k: data[k].astype(float) if k in data and data[k].ndim else None
    names = "P", "q", "G", "h", "A", "b", "lb", "ub"
    given = {name: get(name) for name in names}
    n = len(given["q"])
    for matrix, vector in (("G", "h"), ("A", "b")):
        if given[matrix] is None:
            given |= {matrix: np.zeros((0, n)), vector: np.zeros(0)}
    given["bounded"] = given["lb"] is not None or given["ub"] is not None
    for name, value in (("lb", -np.inf), ("ub", np.inf)):
        if given[name] is None:
            given[name] = np.full(n, value)
    return given


@functools.partial(jax.jit, static_argnames="bounded")
def compiled(d: dict[str, Any], tolerance: Any, bounded: bool) -> dlx.qp.Solution:
    """Our solution, one program for all data of one shape."""
    options = {}
    if len(d["b"]):
        options["equalities"] = d["A"], d["b"]
    if bounded:
        options["bounds"] = d["lb"], d["ub"]
    if len(d["h"]):
        options["rows"] = dlx.qp.Rows(d["G"], upper=d["h"])
    problem = dlx.qp.Dense(d["P"], d["q"], **options)
    return dlx.qp.solve(problem, rtol=0.0, atol=tolerance, throw=False)


def ours(d: dict[str, Any], tolerance: float) -> Callable[[], Any]:
    """A call of it; the arrays are on the device before."""
    arrays = {k: jnp.asarray(v) for k, v in d.items() if k != "bounded"}
    return lambda: jax.block_until_ready(compiled(arrays, tolerance, d["bounded"]))


def in_stages(d: dict[str, Any], n: int = QUADRUPED) -> dict[str, np.ndarray]:
    """The stages of a program of a quadruped: its variables are the states 1 to T, then
    the controls; its start is zero, and its rows are of the controls alone."""
    T = len(d["b"]) // n
    m, p = (len(d["q"]) - T * n) // T, len(d["h"]) // T
    blocks = lambda M, rows, columns: np.stack(
        [M[rows(k), columns(k)] for k in range(T)]
    )
    x = lambda k: slice(k * n, (k + 1) * n)
    u = lambda k: slice(T * n + k * m, T * n + (k + 1) * m)
    # The first state is not a variable.
    before = lambda a: np.concatenate([np.zeros_like(a[:1]), a[:-1]])
    Q, q = blocks(d["P"], x, x), d["q"][: T * n].reshape(T, n)
    back = lambda k: x(max(k - 1, 0))
    A = blocks(d["A"], x, back)
    A[0] = 0
    controls = lambda a: a[T * n :].reshape(T, m)
    return {
        "A": A,
        "B": blocks(d["A"], x, u),
        "Q": before(Q),
        "R": blocks(d["P"], u, u),
        "d": -d["b"].reshape(T, n),
        "q": before(q),
        "r": controls(d["q"]),
        "final": Q[-1],
        "final_q": q[-1],
        "D": blocks(d["G"], lambda k: slice(k * p, (k + 1) * p), u),
        "upper": d["h"].reshape(T, p),
        "low": controls(d["lb"]),
        "high": controls(d["ub"]),
    }


@jax.jit
def compiled_stages(s: dict[str, Any], tolerance: Any) -> dlx.qp.Solution:
    """Our solution of a program in stages."""
    names = "A", "B", "Q", "R", "d", "q", "r", "final", "final_q"
    n, p = s["A"].shape[-1], s["D"].shape[-2]
    problem = dlx.qp.Staged(
        **{name: s[name] for name in names},
        start=jnp.zeros(n),
        controls=(s["low"], s["high"]),
        rows=dlx.qp.Rows(jnp.zeros((p, n)), s["D"], upper=s["upper"]),
    )
    return dlx.qp.solve(problem, rtol=0.0, atol=tolerance, throw=False)


def our_stages(d: dict[str, Any], tolerance: float) -> Callable[[], Any]:
    """A call of it; the program is taken apart before."""
    arrays = jax.tree.map(jnp.asarray, in_stages(d))
    return lambda: jax.block_until_ready(compiled_stages(arrays, tolerance))


def as_dense(d: dict[str, Any], solution: Any) -> Any:
    """The solution of a program in stages in the variables that it came in."""
    y, flat = solution.multipliers, lambda *a: np.concatenate(list(map(np.ravel, a)))
    none = np.zeros(len(d["b"]))
    multipliers = SimpleNamespace(
        equalities=-flat(y.costates[1:]),
        rows=tuple(map(flat, y.rows)),
        bounds=tuple(flat(none, side) for side in y.controls),
    )
    return SimpleNamespace(x=flat(solution.x[1:], solution.u), multipliers=multipliers)


def clarabel_peer(d: dict[str, Any], tolerance: float) -> Callable[[], Any]:
    """Clarabel on the same data, in cones."""
    import clarabel
    import scipy.sparse as sp

    n = len(d["q"])
    low, high = np.isfinite(d["lb"]), np.isfinite(d["ub"])
    eye = np.eye(n)
    A = np.vstack([d["A"], d["G"], eye[high], -eye[low]])
    b = np.concatenate([d["b"], d["h"], d["ub"][high], -d["lb"][low]])
    cones = [
        clarabel.ZeroConeT(len(d["b"])),
        clarabel.NonnegativeConeT(len(b) - len(d["b"])),
    ]
    settings = clarabel.DefaultSettings()
    settings.verbose = False
    settings.tol_feas = settings.tol_gap_abs = tolerance
    settings.tol_gap_rel = 0.0
    P, A = sp.csc_matrix(np.triu(d["P"])), sp.csc_matrix(A)
    return lambda: clarabel.DefaultSolver(P, d["q"], A, b, cones, settings).solve()


def piqp_peer(d: dict[str, Any], tolerance: float) -> Callable[[], Any]:
    """PIQP's dense solver on the same data."""
    import piqp

    def solve():
        solver = piqp.DenseSolver()
        solver.settings.eps_abs = solver.settings.eps_duality_gap_abs = tolerance
        solver.settings.eps_rel = solver.settings.eps_duality_gap_rel = 0.0
        solver.settings.check_duality_gap = True
        rows = d["G"], np.full(len(d["h"]), -np.inf), d["h"], d["lb"], d["ub"]
        solver.setup(d["P"], d["q"], d["A"], d["b"], *rows)
        solver.solve()
        return solver.result

    return solve


def criteria(d: dict[str, Any], solution: Any) -> float:
    """The largest of the benchmark's three: primal, dual, and gap."""
    x, y = np.asarray(solution.x), solution.multipliers
    none = np.zeros(0), np.zeros(0)
    (_, z), (low, high) = y.rows or none, y.bounds or (0 * x, 0 * x)
    z, low, high = map(np.asarray, (z, low, high))
    equal = np.asarray(y.equalities)
    over = [d["G"] @ x - d["h"], d["lb"] - x, x - d["ub"], np.abs(d["A"] @ x - d["b"])]
    primal = max(np.max(part, initial=0) for part in over)
    gradient = d["P"] @ x + d["q"] + d["A"].T @ equal + d["G"].T @ z + high - low
    ends = np.where(np.isfinite(d["ub"]), d["ub"], 0) @ high
    ends -= np.where(np.isfinite(d["lb"]), d["lb"], 0) @ low
    gap = x @ d["P"] @ x + d["q"] @ x + d["b"] @ equal + d["h"] @ z + ends
    return float(max(primal, np.abs(gradient).max(), abs(gap)))


def public(folder: Path, rounds: int) -> list[dict[str, Any]]:
    """A row for each family and tolerance."""
    peers = {"clarabel": clarabel_peer, "piqp": piqp_peer}
    rows = []
    for family in FAMILIES:
        staged, name = "stages" in family, family.split()[0]
        programs = [load(f) for f in sorted(folder.glob(f"{name}*.npz"))]
        for tolerance in (1e-6, 1e-9):
            times: dict[str, list[float]] = {}
            good = false = 0
            for d in programs:
                solve = (our_stages if staged else ours)(d, tolerance)
                solution = solve()
                claims = bool(solution.result == dlx.RESULTS.successful)
                dense = as_dense(d, solution) if staged else solution
                right = criteria(d, dense) <= tolerance
                good, false = good + (claims and right), false + (claims and not right)
                contenders = [python("delucax", 1, solve)]
                for name, peer in peers.items():
                    if has(name):
                        contenders.append(python(name, 1, peer(d, tolerance)))
                for timing in race(contenders, rounds=rounds):
                    times.setdefault(timing.name, []).append(timing.best / 1e6)
            row = {"family": family, "programs": len(programs), "tolerance": tolerance}
            row |= {"solved": good, "false claims": false}
            row |= {f"{name} ms": statistics.median(t) for name, t in times.items()}
            rows.append(row)
            print(row, flush=True)
    return rows


def bounded_lq() -> tuple[np.ndarray, ...]:
    """The matrices and starts of Frey et al. (differentiable NMPC)."""
    rng = np.random.RandomState(42)
    n, m = STATES, CONTROLS
    A, B = np.eye(n) + 0.2 * rng.randn(n, n), rng.randn(n, m)
    return A, B, rng.randn(n), rng.randn(COUNT, n)


def staged(A: Any, B: Any, b: Any, H: Any, x0: Any, limit: float) -> dlx.qp.Solution:
    """Our solution of one of them."""
    n = STATES
    weights = H[:n, :n] + H[:n, :n].T, H[n:, n:] + H[n:, n:].T, H[:n, n:] + H[n:, :n].T
    problem = dlx.qp.Staged(
        A,
        B,
        *weights,
        d=b,
        final=weights[0],
        start=x0,
        horizon=HORIZON,
        controls=(-limit, limit),
    )
    return dlx.qp.solve(problem, throw=False)


def sparse_data(x0: np.ndarray, limit: float) -> tuple[Any, ...]:
    """The same problem as one sparse program in stages."""
    import scipy.sparse as sp

    A, B, b, _ = bounded_lq()
    n, m, T = STATES, CONTROLS, HORIZON
    size = T * (n + m) + n
    E, f = sp.lil_matrix(((T + 1) * n, size)), np.zeros((T + 1) * n)
    E[:n, :n], f[:n] = np.eye(n), x0
    for k in range(T):
        row, at = (k + 1) * n, k * (n + m)
        E[row : row + n, at : at + n] = -A
        E[row : row + n, at + n : at + n + m] = -B
        E[row : row + n, at + n + m : at + 2 * n + m] = np.eye(n)
        f[row : row + n] = b
    high = np.full(size, np.inf)
    for k in range(T):
        high[k * (n + m) + n : (k + 1) * (n + m)] = limit
    return sp.csc_matrix(2 * sp.eye(size)), np.zeros(size), sp.csc_matrix(E), f, high


def piqp_loop(starts: np.ndarray, limit: float) -> Callable[[], Any]:
    """PIQP's staged solver, one problem after the other."""
    import piqp

    P, q, E, f, high = sparse_data(starts[0], limit)

    def solve():
        solver = piqp.SparseSolver()
        solver.settings.kkt_solver = piqp.KKTSolver.sparse_multistage
        solver.setup(P, q, E, f, None, None, None, -high, high)
        first = []
        for x0 in starts:
            changed = f.copy()
            changed[:STATES] = x0
            solver.update(b=changed)
            solver.solve()
            first.append(solver.result.x[STATES : STATES + CONTROLS].copy())
        return np.array(first)

    return solve


def casadi_peer(name: str, x0: np.ndarray, limit: float) -> Callable[[], Any]:
    """A solver behind CasADi, on one problem."""
    import casadi as ca

    P, q, E, f, high = sparse_data(x0, limit)
    H, A = ca.DM(P), ca.DM(E)
    options: dict[str, Any] = {"error_on_fail": False}
    if name == "hpipm":
        # Its equations stand stage by stage, the start as bounds of the first state.
        n, T = STATES, HORIZON
        options |= {
            "N": T,
            "nx": [n] * (T + 1),
            "nu": [CONTROLS] * T + [0],
            "ng": [0] * (T + 1),
        }
        A, f = A[n:, :], f[n:]
        low, high = (
            -np.where(np.isfinite(high), high, 1e6),
            np.where(np.isfinite(high), high, 1e6),
        )
        low[:n] = high[:n] = x0
    else:
        low = -high
    solver = ca.conic("solver", name, {"h": H.sparsity(), "a": A.sparsity()}, options)
    given = dict(h=H, g=q, a=A, lba=f, uba=f, lbx=low, ubx=high)
    return lambda: solver(**given)


def batch(limit: float, rounds: int) -> dict[str, Any]:
    """128 problems, their gradient, and one of them."""
    A, B, b, starts = bounded_lq()
    H = np.eye(STATES + CONTROLS)
    given = tuple(map(jnp.asarray, (A, B, b, H)))
    many = lambda *m: jax.vmap(lambda x0: staged(*m, x0, limit))(jnp.asarray(starts))
    forward = jax.jit(many)
    adjoint = jax.jit(jax.grad(lambda m: jnp.sum(many(*m).u[:, 0])))
    one = jax.jit(lambda x0, start: staged(*given, x0, limit))
    cold = one(starts[0], None)
    solution = forward(*given)
    contenders: list[Contender] = [
        python("128 forward", 1, lambda: jax.block_until_ready(forward(*given))),
        python("128 adjoint", 1, lambda: jax.block_until_ready(adjoint(given))),
        python("one", 1, lambda: jax.block_until_ready(one(starts[0], None))),
    ]
    row: dict[str, Any] = {"limit": limit}
    row["converged"] = int(np.sum(solution.result == dlx.RESULTS.successful))
    row["iterations"] = float(np.median(solution.iterations))
    if has("piqp"):
        peer = piqp_loop(starts, limit)
        row["largest difference"] = float(np.abs(peer() - solution.u[:, 0]).max())
        contenders.append(python("128 PIQP, staged", 1, peer))
    if has("casadi"):
        for name in ("hpipm", "osqp", "piqp"):
            try:
                peer = casadi_peer(name, starts[0], limit)
                x = np.array(peer()["x"]).ravel()[STATES : STATES + CONTROLS]
                row[f"one {name}, difference"] = float(np.abs(x - cold.u[0]).max())
                contenders.append(python(f"one, CasADi's {name}", 1, peer))
            except (RuntimeError, NotImplementedError) as error:
                row[f"one, CasADi's {name}"] = str(error)[-200:]
    for timing in race(contenders, rounds=rounds):
        row[f"{timing.name} ms"] = timing.best / 1e6
    return row


def first_answers() -> dict[str, float]:
    """Seconds from a problem to its solution, each in a fresh process."""
    programs = {name: FIRST.format(make=make) for name, make in PROBLEMS.items()}
    return {name: in_fresh_process(code) for name, code in programs.items()}


def measure(options: argparse.Namespace, folder: Path) -> None:
    """All tables under one setting."""
    jax.config.update("jax_enable_x64", True)
    compile_anew()
    begin = time.perf_counter()
    results: dict[str, Any] = {"machine": describe()}
    if options.data is not None:
        results["public"] = public(options.data, options.rounds)
        print(pd.DataFrame(results["public"]).to_string(index=False))
    results["bounded"] = [batch(limit, options.rounds) for limit in (1e4, 1.0)]
    print(pd.DataFrame(results["bounded"]).T.to_string())
    results["first answers, s"] = first_answers()
    print(results["first answers, s"])
    results["seconds"] = time.perf_counter() - begin
    (folder / "qp.json").write_text(json.dumps(results, indent=1) + "\n")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", type=Path, help="the folder of the public programs")
    parser.add_argument("--rounds", type=int, default=7)
    run_in_settings(parser, measure)
