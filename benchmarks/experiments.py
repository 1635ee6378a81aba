"""The experiment tool: what it costs, what it survives, and how it scales.

`python -m benchmarks.experiments` writes `results/experiments.json`; with `--quick`,
smaller sizes and nothing written. The parts, any of which can be named: `overhead`,
`store`, `kills`, `workers`, `dask`, `sharding`.
"""

import argparse
import json
import os
import random
import resource
import signal
import sqlite3
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks._machine import compile_anew, describe
from delucax.experiments import experiment, Results, run
from delucax.experiments._results import TIMES


OUT = Path(__file__).parent / "results" / "experiments.json"
ONE_THREAD = "--xla_cpu_multi_thread_eigen=false"


def _trivial(name: str, cases: int) -> Any:
    """A sweep whose cases do next to nothing: in Python, or traced."""
    import jax

    def plain(x, y):
        return x * y

    def traced(x, y, key):
        return x * y + jax.random.normal(key)

    side = round(cases**0.5)
    made = plain if name == "plain" else traced
    made = experiment.parametrize("y", range(side))(made)
    return experiment.parametrize("x", range(side))(made)


def overhead(quick: bool) -> dict[str, Any]:
    """Milliseconds a case beyond the call, and the memory of the process."""
    cases = 900 if quick else 10_000
    found: dict[str, Any] = {"cases": cases}
    with tempfile.TemporaryDirectory() as folder:
        for name in ("plain", "traced"):
            made = _trivial(name, cases)
            store = Path(folder, name)
            begin = time.perf_counter()
            results = run(made, store=store, progress=False)
            total = time.perf_counter() - begin
            own = sum(r["compile_seconds"] + r["run_seconds"] for r in results.rows)
            begin = time.perf_counter()
            run(made, store=store, progress=False)
            found[name] = {
                "ms_a_case": 1e3 * total / cases,
                "ms_a_case_beyond_the_call": 1e3 * (total - own) / cases,
                "seconds_to_find_all_done": time.perf_counter() - begin,
                "bytes_a_case": store.stat().st_size / cases,
            }
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    found["peak_memory_mb"] = peak / 1024
    return found


def store(quick: bool) -> dict[str, Any]:
    """Microseconds to write the results of a case with 8 seeds: a line of JSON,
    against a transaction of SQLite."""
    cases = 1000 if quick else 10_000
    record = {
        "kind": "case",
        "experiment": "cost",
        "case": "cost[pendulum-LQR]",
        "hash": "0123456789abcdef",
        "parameters": {"task": "pendulum", "method": "LQR"},
        "seeds": list(range(8)),
        "values": {"cost": [1.2345678901234] * 8, "end": [0.1] * 8},
    }
    found: dict[str, Any] = {"cases": cases}
    with tempfile.TemporaryDirectory(dir=".") as folder:
        file = os.open(Path(folder, "lines"), os.O_CREAT | os.O_APPEND | os.O_WRONLY)
        begin = time.perf_counter()
        for _ in range(cases):
            os.write(file, (json.dumps(record) + "\n").encode())
        found["json_lines_us"] = 1e6 * (time.perf_counter() - begin) / cases
        os.close(file)
        base = sqlite3.connect(Path(folder, "base"), isolation_level=None)
        base.execute("pragma journal_mode=wal")
        base.execute("pragma synchronous=normal")
        base.execute("create table r (e text, c text, s int, h text, p text, v text)")
        begin = time.perf_counter()
        for _ in range(cases):
            rows = [
                (
                    record["experiment"],
                    record["case"],
                    seed,
                    record["hash"],
                    json.dumps(record["parameters"]),
                    json.dumps({n: v[seed] for n, v in record["values"].items()}),
                )
                for seed in record["seeds"]
            ]
            base.execute("begin")
            base.executemany("insert into r values (?, ?, ?, ?, ?, ?)", rows)
            base.execute("commit")
        found["sqlite_us"] = 1e6 * (time.perf_counter() - begin) / cases
        base.close()
    return found


KILLED = """
import sys, time
import jax
from delucax.experiments import experiment, run

@experiment.parametrize("x", [float(k) for k in range(int(sys.argv[2]))])
@experiment.seeds(3)
def slow(x, key):
    return {"a": x * jax.random.normal(key), "b": jax.random.uniform(key, (2,))}

if __name__ == "__main__":
    run(slow, store=sys.argv[1], progress=False)
"""


def kills(quick: bool) -> dict[str, Any]:
    """Kill a sweep at random moments, go on each time, and compare with one that was
    left alone."""
    cases, times = (2000, 3) if quick else (20_000, 10)
    chance = random.Random(0)
    with tempfile.TemporaryDirectory() as folder:
        script = Path(folder, "slow.py")
        script.write_text(KILLED)
        command = lambda store: [
            sys.executable,
            str(script),
            str(Path(folder, store)),
            str(cases),
        ]
        subprocess.run(command("alone"), check=True)
        whole = _size(Path(folder, "alone"))
        store, moments, torn = Path(folder, "killed"), [], 0
        for target in sorted(chance.uniform(0, 0.97) for _ in range(times)):
            process = subprocess.Popen(command("killed"))
            while _size(store) < target * whole and process.poll() is None:
                time.sleep(chance.uniform(0, 0.001))
            process.send_signal(signal.SIGKILL)
            process.wait()
            content = store.read_bytes()
            moments.append(content.count(b'"kind":"case"'))
            torn += not content.endswith(b"\n")
        subprocess.run(command("killed"), check=True)
        alone, killed = (
            json.dumps(
                [
                    {k: v for k, v in row.items() if k not in TIMES}
                    for row in Results.read(Path(folder, name)).rows
                ]
            )
            for name in ("alone", "killed")
        )
        twice = _lines(store) - _lines(Path(folder, "alone")) - len(moments)
    return {
        "cases": cases,
        "killed_after_cases": moments,
        "lines_cut_short": torn,
        "cases_run_twice": twice,
        "same_table": alone == killed,
    }


def _size(path: Path) -> int:
    return path.stat().st_size if path.exists() else 0


def _lines(path: Path) -> int:
    return path.read_bytes().count(b"\n") if path.exists() else 0


@experiment.parametrize("n", range(12))
def busy(n: int) -> float:
    """A second or two of one thread's work."""
    import jax
    import jax.numpy as jnp

    import delucax as dlx

    env = dlx.make("pendulum")
    agent = dlx.controllers.Linear(jnp.array([[20.0, 5.0]]))
    total = 0.0
    for k in range(BUSY):
        run = dlx.rollout(
            env,
            agent,
            key=jax.random.key(100 * n + k),
            horizon=2_000_000,
            keep=(),
            throw=False,
        )
        total += float(run.total_cost)
    return total


BUSY = 20


def workers(quick: bool) -> dict[str, Any]:
    """Two workers against one, each with one thread, started beforehand."""
    rounds = 1 if quick else 2
    script = (
        "import sys, time\n"
        "from benchmarks.experiments import busy\n"
        "from delucax.experiments import run\n"
        "if __name__ == '__main__':\n"
        "    count = int(sys.argv[1])\n"
        "    warm = dict(workers=count, progress=False, select='0 or 1')\n"
        "    run(busy, **warm)\n"
        "    begin = time.perf_counter()\n"
        "    results = run(busy, workers=count, progress=False)\n"
        "    print(time.perf_counter() - begin)\n"
        "    print(sum(r['run_seconds'] for r in results.rows) / len(results.rows))\n"
    )
    flags = f"{os.environ.get('XLA_FLAGS', '')} {ONE_THREAD}".strip()
    environment = {**os.environ, "XLA_FLAGS": flags, "OMP_NUM_THREADS": "1"}
    seconds: dict[int, list[float]] = {1: [], 2: []}
    case: dict[int, list[float]] = {1: [], 2: []}
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder, "two.py")
        file.write_text(script)
        environment["PYTHONPATH"] = os.pathsep.join(
            [str(Path.cwd()), environment.get("PYTHONPATH", "")]
        )
        for _ in range(rounds):
            for count in (1, 2):
                done = subprocess.run(
                    [sys.executable, str(file), str(count)],
                    env=environment,
                    capture_output=True,
                    text=True,
                    check=True,
                )
                whole, one = map(float, done.stdout.split()[-2:])
                seconds[count].append(whole)
                case[count].append(one)
    return {
        "cases": 12,
        "seconds_a_case": {k: float(np.median(v)) for k, v in case.items()},
        "seconds": {k: float(np.median(v)) for k, v in seconds.items()},
        "speed_up": float(np.median(seconds[1]) / np.median(seconds[2])),
        # What is left when the machine is shared: how many were at work on average.
        "busy_of_two": float(12 * np.median(case[2]) / np.median(seconds[2])),
    }


DASK = """
import os, random, signal, sys, threading, time
from dask.distributed import Client, LocalCluster
from delucax.experiments import experiment, run

@experiment.parametrize("n", range(int(sys.argv[1])))
def case(n):
    time.sleep(0.02)
    return n * n

if __name__ == "__main__":
    kills = int(sys.argv[2])
    killed = []
    with LocalCluster(
        n_workers=2, threads_per_worker=1, dashboard_address=None, silence_logs=50
    ) as cluster, Client(cluster):
        over = threading.Event()
        def kill():
            chance = random.Random(0)
            while len(killed) < kills and not over.wait(chance.uniform(2, 4)):
                alive = [w.pid for w in cluster.workers.values() if w.pid]
                if alive:
                    os.kill(chance.choice(alive), signal.SIGKILL)
                    killed.append(1)
        thread = threading.Thread(target=kill, daemon=True)
        thread.start()
        found = run(
            case, store="dask.jsonl", workers=2, backend="dask", progress=False
        )
        over.set()
        thread.join()
    right = all(row["value"] == row["n"] ** 2 for row in found.rows)
    lines = open("dask.jsonl").read().count('"kind":"case"')
    print(len(found.rows), lines, int(right), len(killed))
"""


def dask(quick: bool) -> dict[str, Any]:
    """A sweep over a local cluster whose workers are killed on the way."""
    cases, count = (200, 1) if quick else (1000, 5)
    with tempfile.TemporaryDirectory() as folder:
        Path(folder, "sweep.py").write_text(DASK)
        begin = time.perf_counter()
        done = subprocess.run(
            [sys.executable, "sweep.py", str(cases), str(count)],
            cwd=folder,
            capture_output=True,
            text=True,
        )
        seconds = time.perf_counter() - begin
    if done.returncode:
        raise RuntimeError(done.stderr[-4000:])
    rows, lines, right, killed = map(int, done.stdout.split()[-4:])
    return {
        "cases": cases,
        "workers_killed": killed,
        "results": rows,
        "stored_lines": lines,
        "all_right": bool(right),
        "seconds": seconds,
    }


SHARDING = """
import json, sys, time
import equinox as eqx, jax, jax.numpy as jnp, numpy as np
from jax.sharding import AxisType, NamedSharding, PartitionSpec
import delucax as dlx

env = dlx.make("pendulum")
controller = dlx.controllers.mlp_policy(env, width=16, depth=1, key=jax.random.key(1))
keys = jax.random.split(jax.random.key(0), 4096)

@eqx.filter_jit
@eqx.filter_value_and_grad
def mean_cost(controller, keys):
    run = lambda key: dlx.rollout(env, controller, key=key, keep=(), throw=False)
    return jnp.mean(jax.vmap(run)(keys).total_cost)

found = {}
flat = {}
for count in (1, 2, 4, 8):
    if count > jax.device_count():
        break
    mesh = jax.make_mesh((count,), ("batch",), axis_types=(AxisType.Auto,),
                         devices=jax.devices()[:count])
    spread = jax.device_put(keys, NamedSharding(mesh, PartitionSpec("batch")))
    same = jax.device_put(controller, NamedSharding(mesh, PartitionSpec()))
    flat[count] = jax.block_until_ready(mean_cost(same, spread))
    best = np.inf
    for _ in range(int(sys.argv[1])):
        begin = time.perf_counter()
        jax.block_until_ready(mean_cost(same, spread))
        best = min(best, time.perf_counter() - begin)
    found[count] = best
worst = 0.0
for count, value in flat.items():
    for a, b in zip(jax.tree.leaves(value), jax.tree.leaves(flat[1]), strict=True):
        scale = np.abs(np.asarray(b)).max()
        worst = max(worst, float(np.abs(np.asarray(a) - np.asarray(b)).max() / scale))
print(json.dumps({"seconds": found, "largest_difference": worst}))
"""


def sharding(quick: bool) -> dict[str, Any]:
    """A batch of 4,096 rollouts and its gradient over devices of this machine."""
    flags = f"{ONE_THREAD} --xla_force_host_platform_device_count=8"
    environment = {**os.environ, "XLA_FLAGS": flags, "JAX_PLATFORMS": "cpu"}
    done = subprocess.run(
        [sys.executable, "-c", SHARDING, "2" if quick else "5"],
        env=environment,
        capture_output=True,
        text=True,
    )
    if done.returncode:
        raise RuntimeError(done.stderr[-4000:])
    return json.loads(done.stdout.splitlines()[-1])


PARTS = {
    "overhead": overhead,
    "store": store,
    "kills": kills,
    "workers": workers,
    "dask": dask,
    "sharding": sharding,
}


def main(arguments: list[str] | None = None) -> int:
    """Measure, print and write."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.experiments")
    parser.add_argument("parts", nargs="*", help=f"of {', '.join(PARTS)}; all if none")
    parser.add_argument("--quick", action="store_true")
    options = parser.parse_args(arguments)
    compile_anew()
    wrong = [part for part in options.parts if part not in PARTS]
    if wrong:
        parser.error(f"parts must be of {', '.join(PARTS)}, got {wrong[0]}")
    found = json.loads(OUT.read_text()) if OUT.exists() else {}
    for part in options.parts or PARTS:
        result = PARTS[part](options.quick)
        print(part, json.dumps(result, indent=2), flush=True)
        found[part] = {**result, "machine": describe()}
        if not options.quick:
            OUT.write_text(json.dumps(found, indent=2) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
