"""One fit to public data, in a process of its own."""

import importlib
import os
import time
from pathlib import Path
from typing import Any

import jax

from benchmarks import _cases


DATA = "DELUCAX_DATA"
"""The variable that names the folder of the data."""


def case(problem: str, method: str, seed: int) -> dict[str, Any]:
    """The errors on the tests, by model, and the seconds of the fit, which contain its
    compilation."""
    jax.config.update("jax_enable_x64", True)
    from delucax.training import sysid

    module: Any = importlib.import_module(f"benchmarks._identified.{problem}")
    estimation, tests = module.records(Path(os.environ[DATA]))
    began = time.perf_counter()
    extra: dict[str, Any] = {}
    if method == "linear":
        # A model in discrete time knows the controls at the samples alone.
        estimation, *parts = map(_held, (estimation, *tests.values()))
        tests = dict(zip(tests, parts, strict=True))
        order = len(module.first(estimation))
        models = {"linear": sysid.subspace(estimation, order, affine=True).model}
        first = lambda record: [0.0] * order
    else:
        grey = module.fitted(estimation, seed)
        models = {"physics": grey.physics.model, "grey box": grey.model}
        first = module.first
        extra = {"spread": grey.spread}
    seconds = time.perf_counter() - began
    rmse = lambda model, test: float(
        sysid.validate(model, test, x0=first(test), start=module.START).rmse[0]
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
