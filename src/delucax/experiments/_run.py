"""Runs experiments: in this process, on all cores, or on a cluster."""

import atexit
import contextlib
import dataclasses
import functools
import hashlib
import inspect
import itertools
import os
import tempfile
import threading
import traceback
from collections.abc import Callable, Generator, Iterator
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias

import jax

from .._check import check_choice, check_count
from .._extras import extra
from .._provenance import provenance
from ._cases import as_seeds, Case
from ._execute import Outcome, Runner
from ._experiment import as_experiment, Experiment
from ._results import Results
from ._store import FAILED, Store


class Job(NamedTuple):
    """A case and the seeds to run it with."""

    number: int
    experiment: Experiment
    case: Case
    seeds: tuple[int, ...]


Outcomes: TypeAlias = Generator[tuple[Job, Outcome], None, None]
Packed: TypeAlias = dict[str, tuple[str, bytes]]
"""Experiments by name, each as a hash and as bytes."""


def run(
    *experiments: Experiment,
    store: str | os.PathLike | None = None,
    workers: int = 1,
    backend: str = "loky",
    select: str = "",
    marks: str = "",
    slow: bool = False,
    seeds: Any = None,
    mesh: Any = None,
    fresh: bool = False,
    retry: bool = False,
    progress: bool = True,
) -> Results:
    """Run those cases of experiments whose results are not stored yet.

    If a case fails, its traceback is recorded and the other cases are still run, even
    if the case kills its worker process. Each result is stored at once. A stored case
    is run again only if its code or parameters changed. So if a run was interrupted,
    call `run` with the same arguments to continue it.

    **Arguments:**

    - `*experiments`: the experiments, each a [`delucax.experiments.Experiment`][].
    - `store`: a results file, which is created if it does not exist. By default the
        results are only kept in memory.
    - `workers`: the number of processes, 1 by default. With 1, the cases run in the
        current process. With -1, there is one process for each core. If there are
        several workers, each worker computes with one thread.
    - `backend`: how workers are started: `"loky"` (default), on this machine, or
        `"dask"`, on the cluster of the open `dask.distributed.Client`. Both backends
        need the extra `experiments`, and `"dask"` also needs the extra `dask`.
    - `select`: selects cases by words in their names, such as `"lqr and not cartpole"`;
        all by default.
    - `marks`: selects cases by their marks, with the same syntax as `select`; all by
        default.
    - `slow`: whether to include cases that are marked `slow`; `False` by default.
    - `seeds`: a number of seeds, or a sequence of seeds, to use in place of the seeds
        of the experiments.
    - `mesh`: a `jax.sharding.Mesh`. The seeds of each case are distributed over the
        devices along the first axis of the mesh. If the store lacks one seed of a case,
        all seeds of this case are run. None by default. A mesh needs `workers=1`.
    - `fresh`: whether to run cases that are already stored; `False` by default.
    - `retry`: whether to run stored cases again that raised an error, even if the error
        was expected; `False` by default.
    - `progress`: whether to show the progress of the run and of each worker; `True` by
        default.

    **Returns:** the [`delucax.experiments.Results`][] of the selected cases.

    **Raises:** `ValueError` if an argument is invalid; this is checked before any case
    is run. `OSError` if the store cannot be written. The results so far are kept.

    !!! example

        ```python
        import tempfile
        from delucax import experiments
        from delucax.experiments import experiment

        @experiment.parametrize("x", [1.0, 2.0])
        def half(x):
            return {"half": x / 2}

        with tempfile.TemporaryDirectory() as folder:
            path = f"{folder}/results.jsonl"
            results = experiments.run(half, store=path, progress=False)
            again = experiments.run(half, store=path, progress=False)  # runs nothing
        again.rows == results.rows
        ```

        ```text
        True
        ```
    """
    where = "run"
    chosen = [*map(as_experiment, experiments)]
    if not chosen:
        raise ValueError(f"{where}: at least one experiment must be given.")
    names = [one.name for one in chosen]
    if len(set(names)) < len(names):
        raise ValueError(f"{where}: experiments must have different names: {names}.")
    if workers == -1:
        usable = getattr(os, "sched_getaffinity", None)  # not on every system
        workers = len(usable(0)) if usable else os.cpu_count() or 1
    workers = check_count(workers, "workers", where)
    check_choice(backend, ("loky", "dask"), "backend", where)
    if mesh is not None and (workers > 1 or backend == "dask"):
        raise ValueError(
            f"{where}: mesh needs workers=1 and backend='loky', got workers={workers} "
            f"and backend={backend!r}."
        )
    other_seeds = None if seeds is None else as_seeds(seeds, where)
    opened = Store(store, where)
    jobs, asked, changed = [], [], []
    for one in chosen:
        wanted = one.seeds if other_seeds is None else other_seeds
        wanted = wanted if one.is_random else wanted[:1]
        if mesh is not None and "key" not in one.arguments:
            raise ValueError(
                f"{where}: mesh needs experiments that take a key, but {one.name} has "
                "no argument `key`."
            )
        if mesh is not None and len(wanted) % mesh.devices.shape[0]:
            raise ValueError(
                f"{where}: mesh has {mesh.devices.shape[0]} devices on its first axis, "
                f"which do not divide the {len(wanted)} seeds of {one.name}."
            )
        for case in one.cases(select, marks, slow):
            asked.append((case, wanted))
            if case.mark("skip"):
                continue
            stored = {} if fresh else opened.stored(case.key, case.hash)
            if retry:
                stored = {s: r for s, r in stored.items() if r["error"] is None}
            missing = tuple(seed for seed in wanted if seed not in stored)
            if missing:
                # The devices of a mesh divide all seeds, but not any part of them.
                missing = missing if mesh is None else wanted
                jobs.append(Job(len(jobs), one, case, missing))
            kept = [stored[seed] for seed in wanted if seed not in missing]
            changed += _with_new_status(case, kept)
    with contextlib.closing(opened):
        if jobs or changed:
            opened.open()
        for record in changed:
            opened.append(record)
        if jobs:
            here = workers == 1 and backend == "loky"
            in_workers = lambda: _run_in_workers(jobs, workers, backend)
            outcomes = _run_here(jobs, mesh) if here else in_workers()
            bars = _progress(len(jobs), workers, progress)
            _write_outcomes(jobs, outcomes, opened, bars)
    return Results._of(opened, asked)


def _write_outcomes(
    jobs: list[Job], outcomes: Outcomes, opened: Store, bars: Any
) -> None:
    """Store each outcome as it arrives."""
    try:
        file = inspect.getfile(inspect.unwrap(jobs[0].experiment.function))
        folder = Path(file).resolve().parent
    except (TypeError, OSError):  # the function is not in a file
        folder = Path.cwd()
    number = opened.write_run(provenance(folder))
    with bars as tick, contextlib.closing(outcomes):
        for job, outcome in outcomes:
            status = _status(job.case, outcome.error)
            fields = outcome._asdict()
            worker = fields.pop("worker")
            made = {"kind": "case", "run": number, "seeds": job.seeds}
            opened.append({**made, **job.case.described, "status": status, **fields})
            tick(worker, job.case.id, status)


def _with_new_status(case: Case, stored: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """The records of stored cases whose status changed with their marks."""
    again = []
    for record in stored:
        status = _status(case, record["error"])
        if record["status"] != status:
            line = {**record, "status": status}
            line["seeds"] = [line.pop("seed")]
            line["values"] = {n: [value] for n, value in record["values"].items()}
            again.append(line)
    return again


def _status(case: Case, error: str | None) -> str:
    if case.mark("xfail"):
        return "passed unexpectedly" if error is None else "failed as expected"
    return "passed" if error is None else "failed"


def _run_here(jobs: list[Job], mesh: Any) -> Outcomes:
    for _, group in itertools.groupby(jobs, key=lambda job: job.experiment.name):
        same = list(group)
        with contextlib.closing(Runner(same[0].experiment)) as runner:
            for job in same:
                yield job, runner.run(job.case.index, job.seeds, mesh)


def _run_in_workers(jobs: list[Job], workers: int, backend: str) -> Outcomes:
    """Run jobs with joblib. If a worker dies, the jobs that were running are repeated
    one by one, to find out which one kills it. If workers hold fixtures with a
    teardown, the teardown runs at the end."""
    extra("joblib", "experiments")
    if backend == "dask":
        extra("distributed", "dask")
    pending = {job.number: job for job in jobs}
    packed = {job.experiment.name: _packed(job.experiment) for job in jobs}
    with tempfile.TemporaryDirectory() as folder, _one_thread():
        marks = folder if backend == "loky" else None
        while pending:
            try:
                for number, outcome in _parallel(
                    list(pending.values()), packed, workers, backend, marks
                ):
                    yield pending.pop(number), outcome
            except Exception as error:
                if type(error).__name__ not in _DEATHS:
                    raise
                started = [n for n in pending if Path(folder, str(n)).exists()]
                # Without marks any of them may have been running.
                for job in [pending.pop(n) for n in started or [*pending]]:
                    yield job, _alone(job, packed, backend)
        if any(
            fixture.scope == "process" and inspect.isgeneratorfunction(fixture.function)
            for job in jobs
            for fixture in job.experiment.used_fixtures().values()
        ):
            _end_fixtures(backend)


def _end_fixtures(backend: str) -> None:
    """Tear down the fixtures of idle workers. Those of loky end with their process."""
    if backend == "dask":
        client = extra("distributed", "dask").default_client()
        client.run(_close_runners, on_error="ignore")
    else:
        loky = extra("joblib.externals.loky", "experiments")
        loky.get_reusable_executor(reuse=True).shutdown(wait=True)


def _parallel(
    jobs: list[Job], packed: Packed, workers: int, backend: str, marks: str | None
) -> Iterator[Any]:
    import joblib

    options = bool(jax.config.jax_enable_x64), marks
    task, parallel = joblib.delayed(_work), joblib.Parallel
    with joblib.parallel_config(backend=backend, n_jobs=workers):
        yield from parallel(return_as="generator_unordered")(
            task(packed[experiment.name], number, case.index, seeds, *options)
            for number, experiment, case, seeds in jobs
        )


def _alone(job: Job, packed: Packed, backend: str) -> Outcome:
    try:
        # Two workers, because joblib runs a single worker in this process.
        ((_, outcome),) = _parallel([job], packed, 2, backend, None)
        return outcome
    except Exception as error:
        if type(error).__name__ not in _DEATHS:
            raise
        message = "WorkerDied: the process that ran the case was killed, or crashed."
        trace = "".join(traceback.format_exception(error))
        return Outcome({}, message, trace, 0.0, 0.0, None, 0)


# By name, because the packages of these classes may not be installed.
_DEATHS = ("TerminatedWorkerError", "BrokenProcessPool", "KilledWorker")


def _packed(experiment: Experiment) -> tuple[str, bytes]:
    """The experiment as bytes that any process can read, and their hash."""
    cloudpickle = extra("cloudpickle", "experiments")
    # Look up its fixtures here: in another process the globals of its module are
    # missing.
    experiment = dataclasses.replace(experiment, fixtures=experiment.used_fixtures())
    try:
        content = cloudpickle.dumps(experiment)
    except Exception as error:
        raise ValueError(
            f"run: {experiment.name} cannot be sent to another process: {error}. Make "
            "the object in the function or in a fixture."
        ) from error
    # As bytes, because Dask would keep an array on one worker, and lose it if that
    # worker dies.
    return hashlib.sha256(content).hexdigest(), content


_local = threading.local()
# The runners of this process, in all its threads.
_held: set[Runner] = set()


@atexit.register
def _close_runners() -> None:
    while _held:
        _held.pop().close()


def _work(
    packed: Any, number: int, index: tuple, seeds: tuple, precise: bool, marks: Any
) -> tuple[int, Outcome]:
    """Run one case in a worker, which keeps the runner for the next case."""
    import cloudpickle

    name, content = packed
    # First, because the process may die while it reads the experiment.
    if marks is not None:
        Path(marks, str(number)).touch()
    with jax.enable_x64(precise):
        runners = _local.__dict__.setdefault("runners", {})
        if (name, precise) not in runners:
            for old in runners.values():
                old.close()
                _held.discard(old)
            runners.clear()
            runners[name, precise] = Runner(cloudpickle.loads(content))
        runner = runners[name, precise]
        _held.add(runner)
        return number, runner.run(index, seeds, None)


@contextlib.contextmanager
def _one_thread() -> Iterator[None]:
    """Let processes that are started meanwhile compute with one thread each."""
    flag, flags = "--xla_cpu_multi_thread_eigen=false", os.environ.get("XLA_FLAGS", "")
    names = "XLA_FLAGS", "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"
    before = {name: os.environ[name] for name in names if name in os.environ}
    os.environ.update(dict.fromkeys(names, "1"))
    os.environ["XLA_FLAGS"] = flags if flag in flags else f"{flags} {flag}".strip()
    try:
        yield
    finally:
        for name in names:
            os.environ.pop(name, None)
        os.environ.update(before)


@contextlib.contextmanager
def _progress(
    total: int, workers: int, shown: bool
) -> Iterator[Callable[[int, str, str], None]]:
    """A progress bar for the whole run, and one for each worker that has answered."""
    from .._progress import tqdm

    make = functools.partial(tqdm, unit="case", disable=not shown)
    bars: dict[int, Any] = {}
    failed = 0

    def tick(worker: int, case: str, status: str) -> None:
        nonlocal failed
        failed += status in FAILED
        if failed:
            whole.set_postfix_str(f"{failed} failed", refresh=False)
        whole.update()
        if workers == 1:
            return
        is_new = worker not in bars
        if is_new:
            bar = make(position=len(bars) + 1, leave=False)
            bars[worker] = stack.enter_context(bar)
        name = f"worker {worker}: {case[:40]}"
        # Later ones are shown with the next tick that tqdm draws.
        bars[worker].set_description_str(name, refresh=is_new)
        bars[worker].update()

    with contextlib.ExitStack() as stack:
        whole = stack.enter_context(make(total=total, desc="cases"))
        yield tick
