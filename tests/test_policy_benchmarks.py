"""The parts of `python -m benchmarks.policies` count, judge and store as they say."""

import importlib
import os
from pathlib import Path

import pytest
from helpers import once


pytestmark = once

ROOT = Path(__file__).parents[1]


@pytest.fixture
def module(monkeypatch):
    """Imports a module of the benchmarks."""
    monkeypatch.syspath_prepend(str(ROOT))
    return lambda name: importlib.import_module(f"benchmarks.{name}")


@pytest.mark.skipif(
    not hasattr(os, "sched_getaffinity"), reason="threads are not bound to cores here"
)
def test_a_case_has_the_cores_that_its_benchmark_began_with(
    module, tmp_path, monkeypatch
):
    cases = module("_cases")
    (tmp_path / "tiny.py").write_text(
        "from benchmarks import _cases\n_cases.answer(lambda seed: {'seconds': 0.5})\n"
    )
    path = [str(tmp_path), str(ROOT), str(ROOT / "src")]
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(path))
    given: tuple = "tiny", tmp_path / "store.jsonl", [{"seed": 0}], str
    usable = os.sched_getaffinity(0)
    try:
        os.sched_setaffinity(0, {min(usable)})
        (row,) = cases.run(*given)
        assert os.sched_getaffinity(0) == {min(usable)}
    finally:
        os.sched_setaffinity(0, usable)
    assert row["machine"]["cores_used"] == len(cases.CORES)
    assert (row["seed"], row["seconds"]) == (0, 0.5)
