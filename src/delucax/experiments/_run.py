"""Run experiments: here, on all cores, or on a cluster."""

import contextlib
import hashlib
import inspect
import os
import tempfile
import threading
import traceback
from collections.abc import Generator, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import jax

from .._check import check_count
from .._extras import extra
from ._execute import Outcome, Plan, precision, Runner
from ._experiment import as_experiment, as_seeds, Case, Experiment
from ._provenance import provenance
from ._results import Results
from ._store import Store


BACKENDS = ("loky", "dask")


class _Job(NamedTuple):
    number: int
    made: Experiment
    case: Case
    seeds: tuple[int, ...]


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
    """Run the cases of experiments that are not in the store yet.

    A case that fails is recorded with its traceback and harms no other, one that kills
    its worker neither. Each result is in the store as soon as it is there; what is
    there already is not run again unless its code or parameters changed, so that a run
    that was killed goes on with the same call.

    **Arguments:**

    - `*experiments`: what to run, each an [`delucax.experiments.Experiment`][].
    - `store`: a results file, made if it is not there; in memory alone by default.
    - `workers`: processes; 1, this one, by default; -1 is one for each core. Each has
        one thread of its own for its computations.
    - `backend`: what starts them: `"loky"` (default), on this machine, or `"dask"`, on
        the cluster of the `dask.distributed.Client` that is open. Both need the extra
        `experiments`, the second `dask` as well.
    - `select`: which cases, by their names, such as `"lqr and not cartpole"`; all by
        default.
    - `marks`: which cases, by their marks, likewise.
    - `slow`: also those marked `slow`; not by default.
    - `seeds`: other seeds than the experiments' own, how many or which.
    - `mesh`: a `jax.sharding.Mesh` over whose first axis the seeds of each case are
        spread; none by default. With one worker only.
    - `fresh`: run also what is in the store; not by default.
    - `retry`: run again what failed; not by default.
    - `progress`: show progress, for the whole and for each worker; shown by default.

    **Returns:** the [`delucax.experiments.Results`][] of the cases asked for.

    **Raises:** `ValueError` on an argument that does not fit, before anything is run;
    `OSError` if the store cannot be written, with what was done so far kept.

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
        assert again.rows == results.rows
        ```
    """
    where = "run"
    made = [as_experiment(one) for one in experiments]
    if not made:
        raise ValueError(f"{where}: experiments must be one at least.")
    names = [one.name for one in made]
    if len(set(names)) < len(names):
        raise ValueError(f"{where}: experiments must have different names: {names}.")
    workers = _workers(workers, where)
    if backend not in BACKENDS:
        raise ValueError(
            f"{where}: backend must be one of {', '.join(map(repr, BACKENDS))}, got "
            f"{backend!r}."
        )
    if mesh is not None and (workers > 1 or backend == "dask"):
        raise ValueError(f"{where}: mesh needs workers=1, got {workers} {backend}.")
    chosen = None if seeds is None else as_seeds(seeds, where)
    book = Store(store, where)
    jobs, asked = [], []
    for one in made:
        wanted = one.seeds if chosen is None else chosen
        wanted = wanted if {"key", "seed"} & {*one.arguments} else wanted[:1]
        if mesh is not None and "key" not in one.arguments:
            raise ValueError(
                f"{where}: mesh spreads what takes a key, and {one.name} has no "
                "argument `key`."
            )
        if mesh is not None and len(wanted) % mesh.devices.shape[0]:
            raise ValueError(
                f"{where}: mesh has {mesh.devices.shape[0]} devices on its first axis, "
                f"which do not divide the {len(wanted)} seeds of {one.name}."
            )
        for case in one.cases(select, marks, slow):
            if case.mark("skip"):
                continue
            asked.append((case, wanted))
            missing = _missing(book, case, wanted, fresh, retry)
            if missing:
                jobs.append(_Job(len(jobs), one, case, missing))
    if jobs:
        book.open()
    try:
        if jobs:
            _work_off(jobs, book, made, workers, backend, mesh, progress)
    finally:
        book.close()
    return Results._of(book, asked)


def _work_off(jobs, book, made, workers, backend, mesh, progress) -> None:
    number = book.begin(provenance(_folder(made[0])))
    outcomes = (
        _here(jobs, mesh)
        if workers == 1 and backend == "loky"
        else _elsewhere(jobs, workers, backend)
    )
    with _Progress(len(jobs), workers, progress) as bars, contextlib.closing(outcomes):
        for job, outcome in outcomes:
            status = _status(job.case, outcome)
            record = {
                "kind": "case",
                "run": number,
                "experiment": job.case.experiment,
                "case": job.case.id,
                "order": job.case.index,
                "hash": job.case.hash,
                "parameters": job.case.shown,
                "seeds": job.seeds,
                "status": status,
                "values": outcome.values,
                "error": outcome.error,
                "traceback": outcome.trace,
                "compile_seconds": round(outcome.compile_seconds, 6),
                "run_seconds": round(outcome.run_seconds, 6),
                "device": outcome.device,
            }
            book.append(record)
            bars.tick(outcome.worker, job.case.id, status)


def _missing(book, case, wanted, fresh, retry) -> tuple[int, ...]:
    entry = book.cases.get((case.experiment, case.id))
    if fresh or entry is None or entry["hash"] != case.hash:
        return wanted
    done = {
        seed
        for seed, (record, _) in entry["seeds"].items()
        if not (retry and record["status"] == "failed")
    }
    return tuple(seed for seed in wanted if seed not in done)


def _status(case: Case, outcome: Outcome) -> str:
    if case.mark("xfail"):
        return "passed unexpectedly" if outcome.error is None else "failed as expected"
    return "passed" if outcome.error is None else "failed"


def _folder(made: Experiment) -> Path:
    try:
        return Path(inspect.getfile(inspect.unwrap(made.function))).resolve().parent
    except (TypeError, OSError):
        return Path.cwd()


def _workers(workers: Any, where: str) -> int:
    if workers == -1:
        usable = getattr(os, "sched_getaffinity", None)
        return len(usable(0)) if usable else os.cpu_count() or 1
    return check_count(workers, "workers", where)


def _here(jobs: list[_Job], mesh: Any) -> Generator[tuple[_Job, Outcome], None, None]:
    runner = None
    plan_of = None
    try:
        for job in jobs:
            if plan_of is not job.made:
                if runner is not None:
                    runner.close()
                runner, plan_of = Runner(Plan.of(job.made)), job.made
            assert runner is not None
            yield job, runner.run(job.case.index, job.seeds, mesh)
    finally:
        if runner is not None:
            runner.close()


def _elsewhere(
    jobs: list[_Job], workers: int, backend: str
) -> Generator[tuple[_Job, Outcome], None, None]:
    """By joblib. If a worker dies, those that were under way are run one by one, so
    that the one that kills it is known."""
    joblib = extra("joblib", "experiments")
    if backend == "dask":
        extra("distributed", "dask")
    pending = {job.number: job for job in jobs}
    plans = {job.made.name: _packed(job.made) for job in jobs}
    with tempfile.TemporaryDirectory() as folder, _one_thread():
        while pending:
            marks = folder if backend == "loky" else None
            try:
                for number, outcome in _parallel(
                    joblib, list(pending.values()), plans, workers, backend, marks
                ):
                    yield pending.pop(number), outcome
            except Exception as error:
                if not _died(error):
                    raise
                begun = [n for n in pending if Path(folder, str(n)).exists()]
                for n in begun if marks else list(pending):
                    job = pending.pop(n)
                    yield job, _alone(joblib, job, plans, backend)


def _parallel(joblib, jobs, plans, workers, backend, marks) -> Iterator:
    precise = bool(jax.config.jax_enable_x64)
    task = joblib.delayed(work)
    with joblib.parallel_config(backend=backend, n_jobs=workers):
        parallel = joblib.Parallel(return_as="generator_unordered")
        yield from parallel(
            task(
                *plans[job.made.name],
                job.number,
                job.case.index,
                job.seeds,
                precise,
                marks,
            )
            for job in jobs
        )


def _alone(joblib, job: _Job, plans, backend) -> Outcome:
    try:
        # Two workers, for joblib runs a single one in this process.
        ((_, outcome),) = _parallel(joblib, [job], plans, 2, backend, None)
        return outcome
    except Exception as error:
        if not _died(error):
            raise
        message = "WorkerDied: the process that ran the case was killed, or crashed."
        trace = "".join(traceback.format_exception(error))
        return Outcome({}, message, trace, 0.0, 0.0, None, 0)


def _died(error: Exception) -> bool:
    return type(error).__name__ in (
        "TerminatedWorkerError",
        "BrokenProcessPool",
        "KilledWorker",
    )


def _packed(made: Experiment) -> tuple[str, bytes]:
    """The plan as bytes that any process can read, and their hash."""
    cloudpickle = extra("cloudpickle", "experiments")
    try:
        content = cloudpickle.dumps(Plan.of(made))
    except Exception as error:
        raise ValueError(
            f"run: {made.name} cannot be sent to another process: {error}. Make what "
            "cannot be sent in the function or in a fixture."
        ) from error
    name = hashlib.sha256(content).hexdigest()
    # As bytes: an array would be put on one worker of a cluster, and die with it.
    return name, content


_local = threading.local()


def work(
    name: str,
    content: bytes,
    number: int,
    index: tuple[int, ...],
    seeds: tuple[int, ...],
    precise: bool,
    marks: str | None,
) -> tuple[int, Outcome]:
    """What a worker does: one case. It keeps the runner for the next one."""
    import cloudpickle

    with precision(precise):
        runners = _local.__dict__.setdefault("runners", {})
        if (name, precise) not in runners:
            for old in runners.values():
                old.close()
            runners.clear()
            plan = cloudpickle.loads(content)
            runners[name, precise] = Runner(plan)
        if marks is not None:
            Path(marks, str(number)).touch()
        return number, runners[name, precise].run(index, seeds, None)


@contextlib.contextmanager
def _one_thread() -> Iterator[None]:
    """Processes that are started meanwhile compute with one thread each."""
    flag = "--xla_cpu_multi_thread_eigen=false"
    flags = os.environ.get("XLA_FLAGS", "")
    wanted = {"XLA_FLAGS": flags if flag in flags else f"{flags} {flag}".strip()}
    for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
        wanted[name] = "1"
    before = {name: os.environ.get(name) for name in wanted}
    os.environ.update(wanted)
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value


class _Progress:
    """A bar for the whole, and one for each worker that has answered."""

    def __init__(self, total: int, workers: int, shown: bool):
        self.shown, self.workers = shown, workers
        self.bars: dict[int, Any] = {}
        self.failed = 0
        if shown:
            from tqdm.auto import tqdm

            self.make = tqdm
            self.whole = tqdm(total=total, desc="cases", unit="case")

    def __enter__(self) -> "_Progress":
        return self

    def __exit__(self, *_: Any) -> None:
        if self.shown:
            for bar in (*self.bars.values(), self.whole):
                bar.close()

    def tick(self, worker: int, case: str, status: str) -> None:
        """A case is done."""
        if not self.shown:
            return
        self.failed += status in ("failed", "passed unexpectedly")
        if self.failed:
            self.whole.set_postfix_str(f"{self.failed} failed", refresh=False)
        self.whole.update()
        if self.workers == 1:
            return
        if worker not in self.bars:
            place = len(self.bars) + 1
            bar = self.make(position=place, unit="case", leave=False)
            self.bars[worker] = bar
        bar = self.bars[worker]
        bar.set_description_str(f"worker {worker}: {case[:40]}", refresh=False)
        bar.update()
