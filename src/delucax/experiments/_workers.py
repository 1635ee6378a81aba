"""Cases in other processes."""

import atexit
import contextlib
import dataclasses
import hashlib
import inspect
import os
import tempfile
import threading
import traceback
from collections.abc import Generator, Iterator
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias

import jax

from .._extras import extra
from ._execute import Outcome, Runner
from ._experiment import Case, Experiment


class Job(NamedTuple):
    """A case and the seeds to run it with."""

    number: int
    experiment: Experiment
    case: Case
    seeds: tuple[int, ...]


Packed: TypeAlias = dict[str, tuple[str, bytes]]
"""Experiments by name, each as a hash and as bytes."""


def run_in_workers(
    jobs: list[Job], workers: int, backend: str
) -> Generator[tuple[Job, Outcome], None, None]:
    """Run jobs by joblib. If a worker dies, the jobs that were running are repeated one
    by one, to know which one kills it. Workers end with the run if they hold fixtures
    that must be ended."""
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
                for job in [pending.pop(n) for n in (started if marks else [*pending])]:
                    yield job, _alone(job, packed, backend)
        if any(
            fixture.scope == "process" and inspect.isgeneratorfunction(fixture.function)
            for job in jobs
            for fixture in job.experiment.used_fixtures().values()
        ):
            _end_fixtures(backend)


def _end_fixtures(backend: str) -> None:
    """End the fixtures of idle workers; those of loky end with the process."""
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
    task, parallel = joblib.delayed(work), joblib.Parallel
    with joblib.parallel_config(backend=backend, n_jobs=workers):
        yield from parallel(return_as="generator_unordered")(
            task(packed[experiment.name], number, case.index, seeds, *options)
            for number, experiment, case, seeds in jobs
        )


def _alone(job: Job, packed: Packed, backend: str) -> Outcome:
    try:
        # Two workers, for joblib runs a single one in this process.
        ((_, outcome),) = _parallel([job], packed, 2, backend, None)
        return outcome
    except Exception as error:
        if type(error).__name__ not in _DEATHS:
            raise
        message = "WorkerDied: the process that ran the case was killed, or crashed."
        trace = "".join(traceback.format_exception(error))
        return Outcome({}, message, trace, 0.0, 0.0, None, 0)


# By their names: the classes are in packages that need not be there.
_DEATHS = ("TerminatedWorkerError", "BrokenProcessPool", "KilledWorker")


def _packed(experiment: Experiment) -> tuple[str, bytes]:
    """The experiment as bytes that any process can read, and their hash."""
    cloudpickle = extra("cloudpickle", "experiments")
    # Its fixtures are looked up here: in another process it has no module's globals.
    experiment = dataclasses.replace(experiment, fixtures=experiment.used_fixtures())
    try:
        content = cloudpickle.dumps(experiment)
    except Exception as error:
        raise ValueError(
            f"run: {experiment.name} cannot be sent to another process: {error}. Make "
            "what cannot be sent in the function or in a fixture."
        ) from error
    # As bytes: an array would be put on one worker of a cluster, and die with it.
    return hashlib.sha256(content).hexdigest(), content


_local = threading.local()
# All that this process holds, in whatever thread.
_held: set[Runner] = set()


@atexit.register
def _close_runners() -> None:
    while _held:
        _held.pop().close()


def work(
    packed: Any, number: int, index: tuple, seeds: tuple, precise: bool, marks: Any
) -> tuple[int, Outcome]:
    """What a worker does: one case. It keeps the runner for the next one."""
    import cloudpickle

    name, content = packed
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
        if marks is not None:
            Path(marks, str(number)).touch()
        return number, runner.run(index, seeds, None)


@contextlib.contextmanager
def _one_thread() -> Iterator[None]:
    """Processes that are started meanwhile compute with one thread each."""
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
