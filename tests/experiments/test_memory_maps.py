"""A long sweep does not run out of what a compiled program takes."""

import sys

import jax
import jax.numpy as jnp
import pytest
from helpers import once

from delucax.experiments import _execute, experiment, run
from delucax.experiments._execute import clear_programs


pytestmark = [
    once,
    pytest.mark.skipif(sys.platform != "linux", reason="only Linux counts the maps"),
]


def test_programs_go_when_they_take_too_much():
    programs = [jax.jit(lambda x, n=n: jnp.sin(x) + n) for n in range(20)]
    for program in programs:
        program(0.0)
    taken = len(_execute._IN_USE.read_bytes().splitlines())
    assert not clear_programs() and programs[1]._cache_size() == 1
    assert clear_programs(limit=1) and programs[1]._cache_size() == 0
    assert len(_execute._IN_USE.read_bytes().splitlines()) < taken
    assert programs[1](0.0) == 1.0


def test_elsewhere_nothing_is_done(monkeypatch, tmp_path):
    monkeypatch.setattr(_execute, "_IN_USE", tmp_path / "none")
    assert not clear_programs(limit=1)


def test_a_sweep_forgets_programs_and_keeps_its_results(monkeypatch):
    """Every case that compiled may be the one that leaves too little."""
    seen = []
    release = lambda: seen.append(clear_programs(limit=1))
    monkeypatch.setattr(_execute, "clear_programs", release)

    @experiment.parametrize("n", [2, 3, 4])
    @experiment.seeds(2)
    def total(n, key):
        return jnp.sum(jnp.arange(n)) + 0 * jax.random.normal(key)

    results = run(total, progress=False)
    assert [row["value"] for row in results.rows] == [1, 1, 3, 3, 6, 6]
    assert seen and all(seen)
