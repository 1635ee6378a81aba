"""One fit to public data, in a process of its own."""

import importlib
import os
import time
from pathlib import Path
from typing import Any

import jax

from benchmarks import _cases
from benchmarks._identified import others


DATA = "DELUCAX_DATA"
"""The variable that names the folder of the data."""
LINEAR, NEURAL, GREY_BOX = "linear", "neural state space", "grey box"
KNOWN = "physics, structure known"
START, PAST = 50, 20
"""The samples from which the state is estimated, as `nonlinear_benchmarks` has it, and
those that the encoder takes."""


def module_of(problem: str) -> Any:
    """The module of a problem, or the folder of one without a module."""
    if problem.startswith(others.FOLDER):
        return others.Folder(problem)
    return importlib.import_module(f"benchmarks._identified.{problem}")


def case(problem: str, method: str, seed: int) -> dict[str, Any]:
    """The errors on the tests, by model, and the seconds of the fit, which contain its
    compilation."""
    jax.config.update("jax_enable_x64", True)
    from delucax.training import sysid

    module, folder = module_of(problem), Path(os.environ[DATA])
    estimation, tests = module.records(folder)
    began = time.perf_counter()
    extra: dict[str, Any] = {}
    if method not in (GREY_BOX, KNOWN):
        # A model in discrete time knows the controls at the samples alone.
        estimation, *parts = map(_held, (estimation, *tests.values()))
        tests = dict(zip(tests, parts, strict=True))
    order = len(module.first(estimation))
    first = lambda record: [0.0] * order
    if method == KNOWN:
        models = {KNOWN: module.known(estimation).model}
    elif method == LINEAR:
        models = {LINEAR: sysid.subspace(estimation, order, affine=True).model}
    elif method == NEURAL:
        options: Any = dict(past=PAST, progress=False, key=jax.random.key(seed))
        networks = sysid.state_space(estimation, order, **options)
        models = {NEURAL: networks.model}
    else:
        grey = module.fitted(estimation, seed)
        models = {"physics": grey.physics.model, GREY_BOX: grey.model}
        first = module.first
        extra = {"spread": grey.spread}
    seconds = time.perf_counter() - began
    rmse = lambda model, test: float(
        sysid.validate(model, test, x0=first(test), start=START).rmse[0]
    )
    errors = {
        name: {part: rmse(model, test) for part, test in tests.items()}
        for name, model in models.items()
    }
    return {"errors": errors, "seconds": seconds} | extra


def _held(record: Any) -> Any:
    """The record with its controls held between the samples."""
    return type(record)(record.outputs, record.controls, dt=record.dt, hold="zero")


if __name__ == "__main__":
    _cases.answer(case)
