"""`python -m benchmarks.export`: controllers in C against JAX, and against C by hand.

Accuracy of every controller in both precisions; the C under a strict compiler and under
sanitizers; the same on a Cortex-M4F under QEMU; speed against C by hand, the compiled
step of JAX, and HPIPM behind CasADi; how long an MPC takes to write, and its size; a
step of Gymnasium's tasks with `backend="c"`. Prints tables, and writes
`benchmarks/results/export.json`; `--part` runs one table again.
"""

import json
import subprocess
import tempfile
import time
from pathlib import Path
from typing import Any

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd

import delucax as dlx
from benchmarks import _embedded as embedded
from benchmarks._adapter import IDS, OURS, single, THEIRS
from benchmarks._export_accuracy import in_both_precisions
from benchmarks._exports import (
    ALL,
    build,
    by_hand,
    Exported,
    KEY,
    lqr,
    mlp,
    nanoseconds,
    ON_THE_BOARD,
    pendulum_mpc,
    SANITIZED,
    table,
    undefined,
    write,
)
from benchmarks._machine import RESULTS
from benchmarks._results import run_in_parts
from benchmarks._timing import race
from benchmarks._venv import interpreter, ROOT
from benchmarks.qp import bounded_lq, HORIZON


LIMITS = {
    "LQR / by hand": 1.2,
    "MLP / by hand": 1.3,
    "warm MPC step / JAX": 1 / 3,
    "real-time iteration / HPIPM": 3.0,
    "seconds to write an MPC": 10.0,
    "kB of an MPC": 300.0,
    "backend c, largest difference": 1e-6,
}
GYMNASIUM = {"CartPole-v1": 0.6, "MountainCarContinuous-v0": 1.5}
"""The step of these, over Gymnasium's own; the others are faster than it."""
ALLOWED = {"memcpy", "memset"}
MATH = """acos acosh asin asinh atan atan2 atanh cbrt ceil copysign cos cosh erf erfc
exp exp2 expm1 fabs fdim floor fma fmax fmin fmod frexp hypot ilogb ldexp lgamma log
log10 log1p log2 logb lrint lround modf nearbyint nextafter pow remainder rint round
scalbn sin sincos sinh sqrt tan tanh tgamma trunc"""
"""Those of `math.h`; `sincos` is how GCC calls a sine and a cosine of one number."""
LIMIT = 1.0
"""Of each control of the bounded problem, as in `benchmarks.qp`."""
HPIPM = """
import json
import numpy as np
from benchmarks.qp import bounded_lq, casadi_peer, CONTROLS, STATES
from benchmarks._timing import python, race
starts = bounded_lq()[-1]
solve = casadi_peer("hpipm", starts[0], {limit})
best = race([python("hpipm", 1, solve)], rounds=51)[0].best
first = np.array(solve()["x"]).ravel()[STATES : STATES + CONTROLS]
print(json.dumps(dict(ns=best, first=first.tolist())))
"""


def show(rows: Any) -> Any:
    """Print a table."""
    print(pd.DataFrame(rows).to_string(index=False), flush=True)
    return rows


def accuracy(quick: bool) -> list[dict[str, Any]]:
    """A row for each controller and precision."""
    return show(in_both_precisions(quick))


def controls_of(controller: Any, observations: int) -> int:
    """The size of its control."""
    y = jnp.zeros(observations)
    act = lambda: controller(jnp.zeros(()), y, controller.init(key=KEY))
    return jax.eval_shape(act)[0].shape[0]


def hygiene(quick: bool) -> list[dict[str, Any]]:
    """Warnings, symbols and sanitizers: a row for each controller that is exported."""
    rows = []
    allowed = ALLOWED | {name + f for name in MATH.split() for f in ("", "f")}
    for name, case in list(ALL.items())[: 4 if quick else None]:
        with tempfile.TemporaryDirectory() as inside:
            folder = Path(inside)
            source = write(case, folder)
            row: dict[str, Any] = {"controller": name, "strict": True}
            size = controls_of(case.make(), case.observations)
            # One row in three is not finite: that is computed with too.
            rows_in = table(case, 30, size)
            rows_in[::3, 1] = np.array([np.nan, np.inf])[np.arange(10) % 2]
            try:
                needed = undefined(source, folder)
                row["other symbols"] = sorted(needed - allowed)
                build(source, rows_in, *SANITIZED)
                row["sanitizers"] = "clean"
            except RuntimeError as error:
                row["strict"] = "other symbols" in row
                row["sanitizers"] = str(error)[-300:]
            rows.append(row)
    return show(rows)


def board(quick: bool) -> list[dict[str, Any]]:
    """A Cortex-M4F: a row for each controller and precision."""
    if absent := embedded.missing():
        print(f"no board: {absent}")
        return []
    rows = []
    for name in ON_THE_BOARD[: 2 if quick else None]:
        case = ALL[name]
        for dtype in ("float32", "float64"):
            with tempfile.TemporaryDirectory() as inside:
                folder = Path(inside)
                source = write(case, folder, dtype=dtype)
                size = controls_of(case.make(), case.observations)
                rows_in = table(case, 20 if "MPC" in name else 200, size)
                run = embedded.run(folder, source.stem, rows_in.astype(dtype), dtype)
            rows.append(
                {
                    "controller": name,
                    "dtype": dtype,
                    "difference": run.difference,
                    "allowed": run.allowed,
                    "rounding functions": len(run.transcendental),
                    "ROM, bytes": run.rom,
                    "state, bytes": run.state,
                    "stack, bytes": run.stack,
                    "instructions, mean": float(np.mean(run.instructions)),
                    "instructions, most": float(np.max(run.instructions)),
                }
            )
    return show(rows)


def speed(quick: bool) -> dict[str, float]:
    """Nanoseconds a step, and the ratios."""
    found: dict[str, float] = {}
    rounds = 5 if quick else 51
    network = mlp().network
    weights = {f"W{i}": layer.weight for i, layer in enumerate(network.layers)}
    weights |= {f"b{i}": layer.bias for i, layer in enumerate(network.layers)}
    hands: Any = {
        "LQR": ("LQR of four states", {"K": lqr().K}, 2000),
        "MLP": ("MLP, two layers of 32", weights, 20),
    }
    for name, (long, numbers, times) in hands.items():
        with tempfile.TemporaryDirectory() as inside:
            folder, case = Path(inside), ALL[long]
            sources = write(case, folder), by_hand(folder, **numbers)
            rows = table(case, 100, 1)
            # In turn, so that both see the same noise.
            pairs = [
                [nanoseconds(source, rows, times) for source in sources]
                for _ in range(rounds // 5)
            ]
        ours, theirs = np.min(pairs, axis=0)
        found |= {f"{name}, ns": float(ours), f"{name} by hand, ns": float(theirs)}
        found[f"{name} / by hand"] = float(ours / theirs)
    return show([found | warm_mpc(rounds) | real_time(rounds)])[0]


def warm_mpc(rounds: int) -> dict[str, float]:
    """A step of the pendulum's MPC along its own loop: in C, and as JAX compiles it,
    called at each step as a loop in Python does."""
    mpc = pendulum_mpc()
    env = dlx.make("pendulum", dt=0.02)
    steps = 200
    run = dlx.rollout(
        env, mpc, key=jax.random.key(0), x0=jnp.array([0.3, 0.0]), horizon=steps
    )
    times, seen = np.asarray(run.times), np.asarray(run.observations)
    act = jax.jit(lambda t, y, state: mpc(t, y, state))
    start = jax.tree.map(jnp.asarray, mpc.init())
    best = np.inf
    for _ in range(rounds):
        state, began = start, time.perf_counter()
        for t, y in zip(times[:steps], seen[:steps], strict=True):
            u, state = act(t, y, state)
        jax.block_until_ready(u)
        best = min(best, (time.perf_counter() - began) / steps)
    rows = np.concatenate([times[:steps, None], seen[:steps]], axis=1)
    with tempfile.TemporaryDirectory() as inside:
        source = write(Exported(lambda: mpc), Path(inside))
        ours = nanoseconds(source, rows, 1, rounds)
    found = {"warm MPC step, us": ours / 1e3, "JAX, us": 1e6 * best}
    return found | {"warm MPC step / JAX": ours / 1e9 / best}


def bounded_mpc() -> Any:
    """The real-time iteration of the bounded problem."""
    A, B, b, _ = bounded_lq()
    n, m = B.shape
    cost = dlx.costs.Quadratic(np.eye(n), np.eye(m), final=np.eye(n))
    dynamics = dlx.LinearDynamics(A, B, dt=1.0, x_next=b)
    options: Any = dict(bounds=(-LIMIT, LIMIT), real_time=True, throw=False)
    # About rest: an LQR is not needed, for the program is exact wherever it is made.
    start = np.zeros((HORIZON, m))
    return dlx.controllers.MPC(dynamics, cost, HORIZON, start=start, **options)


def real_time(rounds: int) -> dict[str, float]:
    """A step from the first start of the bounded problem, against HPIPM."""
    mpc, x0 = bounded_mpc(), bounded_lq()[-1][0]
    with tempfile.TemporaryDirectory() as inside:
        source = write(Exported(lambda: mpc, len(x0), 1.0), Path(inside))
        ours = nanoseconds(source, np.append(0.0, x0)[None], 1, 10 * rounds)
        u, _ = dlx.export.load(inside)(0.0, x0, dlx.export.load(inside).init())
    python = interpreter("casadi_qp", "casadi==3.8.2", "pandas", "scipy")
    code = HPIPM.format(limit=LIMIT)
    done = subprocess.run(
        [python, "-c", code], cwd=ROOT, stdout=subprocess.PIPE, text=True, check=True
    )
    answer = json.loads(done.stdout.splitlines()[-1])
    return {
        "real-time iteration, us": ours / 1e3,
        "HPIPM, us": answer["ns"] / 1e3,
        "real-time iteration / HPIPM": ours / answer["ns"],
        "real-time iteration, difference": float(np.abs(u - answer["first"]).max()),
    }


def writing(quick: bool) -> list[dict[str, Any]]:
    """Seconds to write an MPC, its first time in this process, and kilobytes."""
    del quick
    rows = []
    for name, make in (
        ("pendulum, iLQR", pendulum_mpc),
        ("pendulum, real time", lambda: pendulum_mpc(real_time=True)),
    ):
        mpc = make()
        with tempfile.TemporaryDirectory() as inside:
            began = time.perf_counter()
            source = write(Exported(lambda mpc=mpc: mpc), Path(inside))
            seconds = time.perf_counter() - began
            files = source, source.with_suffix(".h")
            size = sum(file.stat().st_size for file in files)
        rows.append({"MPC": name, "seconds": seconds, "kB": size / 1e3})
    return show(rows)


def steps_of_gymnasium(quick: bool) -> list[dict[str, Any]]:
    """A step of the tasks of classic control, as they are and as they are made."""
    rows = []
    for id in IDS:
        contenders = single(id, 1000 if quick else 10_000, backend="c")
        ours, theirs, ours_made, theirs_made = race(
            contenders, rounds=3 if quick else 21
        )
        row: dict[str, Any] = {"id": id, f"{OURS}: us": ours.best / 1e3}
        row[f"{THEIRS}: us"] = theirs.best / 1e3
        row["ratio"] = ours.ratio(theirs)
        row["ratio, as made"] = ours_made.ratio(theirs_made)
        row["limit"] = GYMNASIUM.get(id, 1.0)
        row["largest difference"] = difference_of_backends(id)
        rows.append(row)
    return show(rows)


def difference_of_backends(id: str, steps: int = 200) -> float:
    """The largest difference of an observation or a reward to the backend of JAX, whose
    episode has the same seed and actions; of `max(1, |value|)`."""
    made = [gymnasium.make(f"delucax/{id}", backend=b) for b in ("jax", "c")]
    made[0].action_space.seed(0)
    actions = [made[0].action_space.sample() for _ in range(steps)]
    runs = []
    for env in made:
        env.reset(seed=0)
        run = []
        for action in actions:
            y, reward, terminated, truncated, _ = env.step(action)
            run.append(np.append(y, [float(reward), terminated, truncated]))
            if terminated or truncated:
                break
        runs.append(np.array(run))
    theirs, ours = runs
    return float(np.max(np.abs(ours - theirs) / np.maximum(1, np.abs(theirs))))


def judge(results: dict[str, Any]) -> None:
    """Print each limit that is missed."""
    missed = []
    for row in results["accuracy"]:
        who = f"{row['controller']}, {row['dtype']}"
        for what, limit in (("step", "limit"), ("loop", "loop limit")):
            if not row[what] <= row[limit]:
                missed.append(f"{who}: {what} {row[what]}")
    for row in results["hygiene"]:
        if row["sanitizers"] != "clean" or row["other symbols"]:
            missed.append(f"{row}")
    for row in results["board"]:
        if not row["difference"] <= row["allowed"]:
            missed.append(f"board, {row['controller']}: {row['difference']}")
    for name, value in results["speed"].items():
        if value > LIMITS.get(name, np.inf):
            missed.append(f"{name}: {value}")
    for row in results["writing"]:
        if row["seconds"] > LIMITS["seconds to write an MPC"]:
            missed.append(f"{row}")
        if row["kB"] > LIMITS["kB of an MPC"]:
            missed.append(f"{row}")
    for row in results["Gymnasium"]:
        if row["ratio"] > row["limit"]:
            missed.append(f"{row['id']}: {row['ratio']}")
        if row["largest difference"] > LIMITS["backend c, largest difference"]:
            missed.append(f"{row['id']}: {row['largest difference']}")
    print("\n".join(missed) or "all limits are met")


PARTS = {
    "accuracy": accuracy,
    "hygiene": hygiene,
    "board": board,
    "speed": speed,
    "writing": writing,
    "Gymnasium": steps_of_gymnasium,
}


if __name__ == "__main__":
    about = {"limits": LIMITS, "limits, Gymnasium": GYMNASIUM}
    run_in_parts("export", PARTS, about, RESULTS / "export.json", judge)
