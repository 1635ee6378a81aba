"""Experiments on several processes and devices, from the command line, and reports."""

import os
import re
import socket
import subprocess
import sys
import textwrap
from html.parser import HTMLParser
from pathlib import Path

import pytest
from helpers import once, user_error

from delucax import experiments
from delucax.__main__ import main
from delucax.experiments import commands, experiment, Results
from delucax.experiments._report import diff


pytestmark = once

FILE = '''
import os, signal
import jax
import delucax as dlx
from delucax.experiments import experiment


@experiment.fixture(scope="process")
def env(length):
    return dlx.make("pendulum", length=length)


@experiment.parametrize("length", [0.8, 1.2])
@experiment.seeds(2)
def cost(env, key):
    """What it costs to do nothing."""
    run = dlx.rollout(env, dlx.controllers.Zero(1), key=key, horizon=5)
    return {"cost": run.total_cost, "kind": env.state_size}


def helper(n):
    return n + OFFSET


OFFSET = 1


@experiment.parametrize(
    "n", [*range(5), experiment.param(9, marks=experiment.mark.slow)]
)
def count(n):
    if n == 2:
        raise ArithmeticError("two <is> bad")
    if n == 9:
        os.kill(os.getpid(), signal.SIGKILL)
    return helper(n)
'''


@pytest.fixture
def file(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "sweep.py").write_text(FILE)
    yield "sweep.py"
    sys.modules.pop("sweep", None)
    sys.path[:] = [place for place in sys.path if place != str(tmp_path)]


def test_workers_give_the_same_and_their_death_harms_no_other(file, capfd):
    """With two processes, one of which a case kills, the rows are those of one."""
    assert main(["run", file, "--quiet"]) == 1
    alone = Results.read("results/sweep.jsonl")
    args = ["--workers", "2", "--slow", "--store", "both.jsonl"]
    assert main(["run", file, *args]) == 1
    both = Results.read("both.jsonl")
    dead = both.where(case="count[9]").rows
    assert [row["status"] for row in dead] == ["failed"]
    assert "was killed, or crashed" in dead[0]["error"]
    keep = lambda row: (row["case"], row["seed"], row.get("value"), row.get("cost"))
    kept = [keep(row) for row in both.rows if row["case"] != "count[9]"]
    assert kept == [keep(row) for row in alone.rows]
    out = capfd.readouterr()
    assert "FAILED count[2]: ArithmeticError: two <is> bad" in out.err
    assert "worker" in out.err and "8/8" in out.err
    assert "The results of 8 cases are in both.jsonl" in out.out


class Deadly:
    """Kills the process that reads it."""

    def __reduce__(self):
        return os._exit, (1,)


def test_a_worker_that_dies_while_it_reads_the_experiment():
    deadly = Deadly()

    @experiment.parametrize("x", [1, 2])
    def read(x):
        return deadly and x

    found = experiments.run(read, workers=2, progress=False)
    assert len(found.failed) == 2
    assert "was killed, or crashed" in found.failed[0]["error"]


def test_fixtures_of_workers_are_let_go_with_the_run(tmp_path):
    folder = str(tmp_path)

    @experiment.fixture(scope="process")
    def camera(place):
        yield place
        Path(folder, place).write_text(str(os.getpid()))
        raise OSError("no such camera")

    @experiment.use(camera=camera)
    @experiment.parametrize("place", ["here", "there"])
    def look(camera):
        return os.getpid()

    for _ in range(2):  # and the next run finds workers again
        found = experiments.run(look, workers=2, progress=False)
        gone = {path.name: int(path.read_text()) for path in tmp_path.iterdir()}
        assert gone == {row["place"]: row["value"] for row in found.rows}
        assert os.getpid() not in gone.values()


def test_what_cannot_be_sent_is_an_error():
    lock = __import__("threading").Lock()

    @experiment.parametrize("x", [1, 2])
    def locked(x):
        return lock and x

    with user_error(match="locked cannot be sent to another process"):
        experiments.run(locked, workers=2, progress=False)


class Tables(HTMLParser):
    def __init__(self):
        super().__init__()
        self.count, self.links = {}, []

    def handle_starttag(self, tag, attrs):
        self.count[tag] = self.count.get(tag, 0) + 1
        self.links += [v for k, v in attrs if k in ("src", "href") and v[0] != "#"]


def test_reports(file, capsys):
    main(["run", file, "--quiet", "--html", "page.html"])
    page = Path("page.html").read_text()
    tables = Tables()
    tables.feed(page)
    assert tables.count["table"] == 3 and tables.count["svg"] >= 2
    assert tables.links == []  # nothing but itself
    assert "two &lt;is&gt; bad" in page and "Traceback" in page
    args = ["--export", "t.csv", "--export", "t.tex", "-k", "cost"]
    assert main(["report", "results/sweep.jsonl", *args]) == 0
    assert Path("t.csv").read_text().count("\n") == 5
    text = Path(file).read_text().replace("OFFSET = 1", "OFFSET = 2")
    sys.modules.pop("sweep")
    Path(file).write_text(text.replace("range(5)", "range(4)"))
    main(["run", file, "--quiet", "--store", "after.jsonl"])
    capsys.readouterr()
    args = ["report", "--diff", "results/sweep.jsonl", "after.jsonl"]
    assert main([*args, "--html", "diff.html"]) == 0
    out = capsys.readouterr().out
    assert "| count | count[3] | value | 4 | 5 | 1 | 1 | 1 | 1 |" in out
    assert "count[4]: only in results/sweep.jsonl" in out
    assert "3 cases are the same, 3 differ" in out
    assert "results differ" in Path("diff.html").read_text()


def test_reports_tell_of_seeds_that_are_not_finite_or_not_in_common(tmp_path):
    @experiment.parametrize("x", [1, 2])
    @experiment.seeds(4)
    def cost(x, seed):
        return {"value": float("nan") if seed == 3 == x + 1 else x + seed}

    found = experiments.run(cost, progress=False)
    experiments.report(found, tmp_path / "page.html")
    page = (tmp_path / "page.html").read_text()
    assert "2 (1 not finite)" in page and "1 (1 not finite)" not in page
    first, second = (experiments.run(cost, seeds=s, progress=False) for s in ([0], [1]))
    keys = [("cost", "cost[1]"), ("cost", "cost[2]")]
    assert diff(first, second) == ([], [], 0, (keys, keys))


def test_modules_of_a_package_have_stores_of_their_own(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "swept").mkdir()
    for name in ("one", "two"):
        (tmp_path / "swept" / f"{name}.py").write_text(FILE)
        assert main(["run", f"swept.{name}", "-k", "count and 0", "--quiet"]) == 0
        assert Path(f"results/swept.{name}.jsonl").exists()
    sys.path.remove(str(tmp_path))


def test_an_interruption_says_what_continues(file, capsys, monkeypatch):
    def interrupted(*args, **options):
        raise KeyboardInterrupt

    monkeypatch.setattr(commands, "run", interrupted)
    assert main(["run", file]) == main(["run", file, "--fresh"]) == 130
    err = capsys.readouterr().err
    assert "The same command continues" in err
    assert "The same command without --fresh continues" in err


def test_the_command_line(file, capsys):
    assert main(["list"]) == 0
    out = capsys.readouterr().out
    assert "planar_quadrotor" in out and "HInfinity" in out and "scoreboard" in out
    assert main(["list", file, "-k", "count and not 0"]) == 0
    out = capsys.readouterr().out
    assert "count[9]  (slow)" in out and "5 cases" in out
    for args, message in (
        (["run", "none.py"], "run: there is no file"),
        (["list", "none.py"], "list: there is no file"),
        (["run", "json"], "there is no experiment in json"),
        (["run", "no.such.module"], "cannot be imported"),
        (["run", file, "-k", "a b"], "select must be words"),
        (["report", "none.jsonl"], "there is no file"),
        (["report", "--diff", "a"], "--diff needs two"),
        (["bench", "no_such"], "bench: "),
    ):
        assert main(args) == 2
        assert message in capsys.readouterr().err
    with pytest.raises(SystemExit):
        main(["--help"])
    out = capsys.readouterr().out
    for command in ("demo", "list", "run", "report", "bench"):
        assert re.search(rf"^ +{command} +\w", out, re.MULTILINE)


SHARDED = """
import jax, numpy as np
from jax.sharding import AxisType
import delucax as dlx
from delucax import experiments
from delucax.experiments import experiment

assert jax.device_count() == 8
env = dlx.make("pendulum")
controller = dlx.controllers.Linear(np.array([[2.0, 0.5]], np.float32))

@experiment.seeds(16)
def cost(key):
    return dlx.rollout(env, controller, key=key, horizon=20).total_cost

a = experiments.run(cost, progress=False)
mesh = jax.make_mesh((8,), ("batch",), axis_types=(AxisType.Auto,))
b = experiments.run(cost, progress=False, mesh=mesh)
np.testing.assert_allclose(
    [row["value"] for row in a.rows], [row["value"] for row in b.rows], rtol=1e-5
)
print("equal")
"""


def test_eight_devices_agree_with_one():
    """Over the seeds of an experiment; a gradient is below, over two processes."""
    devices = "--xla_force_host_platform_device_count=8"
    flags = f"{os.environ.get('XLA_FLAGS', '')} {devices}"
    environment = {**os.environ, "XLA_FLAGS": flags, "JAX_PLATFORMS": "cpu"}
    command = [sys.executable, "-c", SHARDED]
    done = subprocess.run(command, env=environment, capture_output=True, text=True)
    assert done.stdout == "equal\n", done.stderr


PROCESSES = """
import sys
import equinox as eqx, jax, jax.numpy as jnp, numpy as np
from jax.sharding import AxisType, NamedSharding, PartitionSpec

jax.config.update("jax_cpu_collectives_implementation", "gloo")
jax.distributed.initialize(sys.argv[1], num_processes=2, process_id=int(sys.argv[2]))
import delucax as dlx

assert jax.process_count() == 2 and jax.device_count() == 8
env = dlx.make("pendulum")

@eqx.filter_jit
@eqx.filter_value_and_grad
def mean_cost(gain, seeds):
    controller = dlx.controllers.Linear(gain)
    def run(seed):
        key = jax.random.key(seed)
        return dlx.rollout(env, controller, key=key, horizon=20, throw=False)
    return jnp.mean(jax.vmap(run)(seeds).total_cost)

seeds, gain = np.arange(64, dtype=np.int32), np.array([[2.0, 0.5]], np.float32)
mesh = jax.make_mesh((8,), ("batch",), axis_types=(AxisType.Auto,))
spread = jax.device_put(seeds, NamedSharding(mesh, PartitionSpec("batch")))
same = jax.device_put(gain, NamedSharding(mesh, PartitionSpec()))
value, gradient = mean_cost(same, spread)
if jax.process_index() == 0:
    alone, alone_gradient = mean_cost(jnp.asarray(gain), jnp.asarray(seeds))
    local = lambda array: np.asarray(array.addressable_data(0))
    np.testing.assert_allclose(local(value), local(alone), rtol=2e-5)
    np.testing.assert_allclose(local(gradient), local(alone_gradient), rtol=1e-3)
print("equal")
"""


def test_two_processes_agree_with_one():
    """A batch of rollouts and its gradient over eight devices of two processes."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        address = f"127.0.0.1:{free.getsockname()[1]}"
    devices = "--xla_force_host_platform_device_count=4"
    flags = f"{os.environ.get('XLA_FLAGS', '')} {devices}"
    environment = {**os.environ, "XLA_FLAGS": flags, "JAX_PLATFORMS": "cpu"}
    both = [
        subprocess.Popen(
            [sys.executable, "-c", PROCESSES, address, str(k)],
            env=environment,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        for k in range(2)
    ]
    for process in both:
        out, error = process.communicate(timeout=120)
        assert out.endswith("equal\n"), error


DASK = """
import os, signal, threading, time
from pathlib import Path
from dask.distributed import Client, LocalCluster
from delucax import experiments
from delucax.experiments import experiment

@experiment.fixture(scope="process")
def power():
    yield 2
    Path(f"{os.getpid()} let go").touch()

@experiment.parametrize("n", range(60))
def work(n, power):
    time.sleep(0.05)
    return n ** power

if __name__ == "__main__":
    with LocalCluster(
        n_workers=2, threads_per_worker=1, dashboard_address=None
    ) as cluster, Client(cluster):
        def kill():
            time.sleep(1.5)
            victim = next(iter(cluster.workers.values())).pid
            os.kill(victim, signal.SIGKILL)
        threading.Thread(target=kill, daemon=True).start()
        options = dict(workers=2, backend="dask", progress=False)
        found = experiments.run(work, store="dask.jsonl", **options)
        assert list(Path().glob("* let go"))
    assert [row["value"] for row in found.rows] == [n * n for n in range(60)]
    lines = open("dask.jsonl").read().count('"kind":"case"')
    print(lines)
"""


def test_a_dask_worker_is_killed(tmp_path):
    """All results are there, and none twice."""
    pytest.importorskip("distributed")
    (tmp_path / "work.py").write_text(textwrap.dedent(DASK))
    done = subprocess.run(
        [sys.executable, "work.py"], cwd=tmp_path, capture_output=True, text=True
    )
    assert done.stdout == "60\n", done.stderr


def test_an_experiment_is_still_a_function():
    @experiment.seeds(3)
    def double(x=1, *, seed):
        """Twice."""
        return 2 * x

    assert double(4, seed=0) == 8 and double.__doc__ == "Twice."
    assert len(experiments.run(double, progress=False, seeds=2).rows) == 2
