"""Published discrete-time systems, and families of them."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import riccati_systems
import scipy.linalg
from helpers import minutes, needs_x64, once

import delucax as dlx


def as_floats(*problem):
    if any(map(np.iscomplexobj, problem)):
        return tuple(np.asarray(M, complex) for M in problem)
    return tuple(np.asarray(M, float) for M in problem)


def exam(name, *problem):
    A, B, Q, R = as_floats(*problem)
    solution = dlx.riccati.dare(A, B, Q, R, throw=False)
    residual, loop = riccati_systems.discrete_residual(A, B, Q, R, solution.X)
    assert solution.result == dlx.RESULTS.successful, name
    assert residual < 1e-12 and solution.residual < 1e-12, name
    if len(A) < 10 and "," not in name:
        true = riccati_systems.true_residual(True, A, B, Q, R, solution.X)
        assert true <= solution.residual, name
    assert solution.spectral_radius < 1, name
    assert np.max(np.abs(np.linalg.eigvals(loop))) < 1, name
    return solution


SYSTEMS = riccati_systems.darex()
SIZES = sorted({B.shape for _, _, B, _, _ in SYSTEMS})


@needs_x64
@pytest.mark.parametrize("size", SIZES)
def test_published_systems(size):
    assert len(SYSTEMS) == 19
    for name, A, B, Q, R in (system for system in SYSTEMS if system[2].shape == size):
        solution = exam(name, A, B, Q, R)
        if name == "DAREX 14":
            # A margin of 1e-8: the condition allows fewer digits.
            continue
        X = scipy.linalg.solve_discrete_are(A, B, Q, R)
        assert np.linalg.norm(solution.X - X) < 1e-9 * np.linalg.norm(X), name


compiled = jax.jit(lambda *problem: dlx.riccati.dare(*problem, throw=False))


@needs_x64
def test_compiled():
    """One program, of those of two states and one control."""
    shapes = [(2, 2), (2, 1)]
    numbers = [
        k for k, M in enumerate(SYSTEMS, 1) if [m.shape for m in M[1:3]] == shapes
    ]
    assert len(numbers) >= 5
    for k in numbers[1:]:  # the first is complex
        check_compiled(k)


@needs_x64
def test_complex_data_compiled():
    assert np.iscomplexobj(SYSTEMS[0][1])
    check_compiled(1)


@minutes("a program is compiled for each size")
def test_all_compiled():
    for number in range(1, len(SYSTEMS) + 1):
        check_compiled(number)


def check_compiled(number):
    _, *problem = SYSTEMS[number - 1]
    kind = complex if any(map(np.iscomplexobj, problem)) else float
    problem = [np.asarray(jnp.asarray(M, kind)) for M in problem]
    riccati_systems.check_both_ways(True, problem, compiled(*problem))


@needs_x64
def test_families():
    systems = riccati_systems.darex_families(sizes=(4,))
    assert len(systems) >= 70
    for system in systems:
        exam(*system)


@once
def test_single_precision():
    for name, *data in riccati_systems.darex():
        if any(map(np.iscomplexobj, data)):
            continue
        single = [np.asarray(M, np.float32) for M in data]
        solution = dlx.riccati.dare(*single, throw=False)
        X = np.asarray(solution.X, np.float64)
        residual, _ = riccati_systems.discrete_residual(*data, X)
        if name == "DAREX 14":
            # Its margin of 1e-8 is below the precision.
            assert solution.result != dlx.RESULTS.successful
        else:
            assert solution.result == dlx.RESULTS.successful, name
            assert residual < 1e-5, name
