"""gymnax, in a virtual environment of its own since its pins exclude current JAX.

The environment is made on first use, by the running interpreter and pip, and kept. A
worker process in it compiles the cases, then runs one at a time when it is asked to, so
that gymnax takes its turn in the same round-robin as everyone else and sees the same
noise. Between its turns it sleeps.
"""

import atexit
import functools
import json
import os
import shutil
import subprocess
import sys
import venv
from dataclasses import asdict
from pathlib import Path
from typing import Any, Literal

import numpy as np

from benchmarks._problem import Case, Episodes
from benchmarks._timing import Contender, Missing


NAME = "gymnax"
# gymnax imports six but doesn't ask for it.
REQUIREMENTS = ("gymnax==1.0.1", "six")
ROOT = Path(__file__).resolve().parents[2]
FOLDER = ROOT / "benchmarks" / ".venvs" / "gymnax"

Stepping = Literal["step", "step_env", "raw"]


def environment() -> Path:
    """The interpreter of gymnax's virtual environment, which is made if need be.

    A stamp file holds what was installed and for which Python; where it doesn't fit,
    the environment is made anew.

    **Raises:** `RuntimeError` with pip's words if the installation fails.
    """
    stamp = FOLDER / "stamp.json"
    wanted = json.dumps({"python": sys.version, "requirements": REQUIREMENTS})
    folder, name = ("Scripts", "python.exe") if os.name == "nt" else ("bin", "python")
    interpreter = FOLDER / folder / name
    if stamp.exists() and stamp.read_text() == wanted:
        return interpreter
    shutil.rmtree(FOLDER, ignore_errors=True)
    venv.create(FOLDER, with_pip=True, symlinks=os.name != "nt")
    install = [interpreter, "-m", "pip", "install", "--quiet", *REQUIREMENTS]
    done = subprocess.run(install, capture_output=True, text=True)
    if done.returncode:
        raise RuntimeError(f"pip could not install gymnax: {done.stderr[-300:]}")
    stamp.write_text(wanted)
    return interpreter


class Worker:
    """The process in gymnax's virtual environment; `ask` sends it one request."""

    def __init__(self) -> None:
        outside = {k: v for k, v in os.environ.items() if k != "PYTHONPATH"}
        self._process = subprocess.Popen(
            [environment(), "-m", "benchmarks._peers._gymnax_worker"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            cwd=ROOT,
            env=outside,
        )
        atexit.register(self.close)

    def ask(self, **request: Any) -> dict[str, Any]:
        """The answer to a request.

        **Raises:** `RuntimeError` if the process has ended.
        """
        assert self._process.stdin is not None and self._process.stdout is not None
        try:
            self._process.stdin.write(json.dumps(request) + "\n")
            self._process.stdin.flush()
            line = self._process.stdout.readline()
        except BrokenPipeError:
            line = ""
        if not line:
            code = self._process.wait()
            raise RuntimeError(f"the gymnax process ended with status {code}")
        return json.loads(line)

    def close(self) -> None:
        """End the process."""
        if self._process.stdin is not None and not self._process.stdin.closed:
            self._process.stdin.close()
        self._process.wait()


@functools.cache
def worker() -> Worker | str:
    """The one worker of this process, or the reason in words why there is none."""
    try:
        started = Worker()
        started.ask(versions=True)
        return started
    except (OSError, RuntimeError, subprocess.CalledProcessError) as error:
        return str(error)


def versions() -> dict[str, str]:
    """Versions of gymnax and of the JAX that it runs on; empty if it can't run."""
    running = worker()
    return {} if isinstance(running, str) else running.ask(versions=True)


def contender(
    case: Case, *, stepping: Stepping = "step", name: str | None = None
) -> Contender | Missing:
    """Compile the case in gymnax's environment and return it ready to race.

    - `stepping="step"`: gymnax's default, with its automatic reset every 200 steps.
    - `stepping="step_env"`: the pendulum alone, the fastest way that gymnax offers.
    - `stepping="raw"`: not gymnax but `raw.py`, under gymnax's version of JAX, so that
      the difference between the versions can be told from gymnax itself.
    """
    if name is None:
        name = "raw, gymnax's JAX" if stepping == "raw" else f"gymnax {stepping}"
    if case.method != "gym" and stepping != "raw":
        return Missing(name, "gymnax has Gymnasium's step only")
    if case.method == "tsit5":
        return Missing(name, "Diffrax isn't installed in gymnax's environment")
    if case.workload == "gradient" and stepping == "step":
        return Missing(name, "its automatic reset cuts the gradient")
    running = worker()
    if isinstance(running, str):
        return Missing(name, running)
    answer = running.ask(prepare=asdict(case), stepping=stepping)

    def measure() -> float:
        return running.ask(measure=answer["id"])["seconds"]

    return Contender(name, case.total_steps, measure, answer["compile_seconds"])


TASKS = {
    "acrobot": ("Acrobot-v1", 2),
    "cartpole": ("CartPole-v1", 1),
    "mountain_car": ("MountainCarContinuous-v0", 0.5),
    "mountain_car_discrete": ("MountainCar-v0", 2),
    "pendulum": ("Pendulum-v1", 0.5),
}
"""The tasks that gymnax has too: its name for each, and the action that is held."""


def episodes(case: Episodes, *, stepping: Stepping = "step") -> Contender | Missing:
    """Compile whole episodes of a named task in gymnax's environment."""
    name = f"gymnax {stepping}"
    if case.task not in TASKS:
        return Missing(name, "gymnax has no such task")
    running = worker()
    if isinstance(running, str):
        return Missing(name, running)
    theirs, action = TASKS[case.task]
    answer = running.ask(
        episodes=asdict(case), name=theirs, action=action, stepping=stepping
    )

    def measure() -> float:
        return running.ask(measure=answer["id"])["seconds"]

    return Contender(name, case.total_steps, measure, answer["compile_seconds"])


def simulate(
    case: Case, *, stepping: Stepping = "step"
) -> dict[str, np.ndarray] | None:
    """What a run returns, as `raw.simulate` gives it; `None` without gymnax."""
    running = worker()
    if isinstance(running, str):
        return None
    answer = running.ask(simulate=asdict(case), stepping=stepping)
    return {key: np.asarray(value) for key, value in answer.items()}
