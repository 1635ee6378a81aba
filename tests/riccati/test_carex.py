"""Published continuous-time systems, and families of them."""

import jax
import numpy as np
import pytest
import riccati_systems
import scipy.linalg
from helpers import minutes, needs_x64

import delucax as dlx


pytestmark = needs_x64


SYSTEMS = riccati_systems.carex()


def exam(name, *problem):
    A, B, Q, R = (np.asarray(M, float) for M in problem)
    solution = dlx.riccati.care(A, B, Q, R, throw=False)
    X = np.asarray(solution.X)
    residual, loop = riccati_systems.continuous_residual(A, B, Q, R, X)
    if len(A) < 10 and "," not in name or name.startswith("CAREX 8"):
        # Where R is of high condition, double precision does not measure it.
        residual = riccati_systems.true_residual(False, A, B, Q, R, X)
        assert residual <= solution.residual, name
    assert residual < 1e-12 and solution.residual < 1e-12, name
    if name == "CAREX 11":
        # X = [[2, 1], [1, 1]], whose loop has the eigenvalues +-i.
        assert solution.result == dlx.RESULTS.on_boundary
        np.testing.assert_allclose(X, [[2, 1], [1, 1]], atol=1e-6)
        return solution
    assert solution.result == dlx.RESULTS.successful, name
    assert solution.spectral_abscissa < 0, name
    assert np.max(np.linalg.eigvals(loop).real) < 0, name
    return solution


@pytest.mark.parametrize(
    "number", [*range(1, 20), pytest.param(20, marks=minutes("421 states"))]
)
def test_published_systems(number):
    name, A, B, Q, R = SYSTEMS[number - 1]
    solution = exam(name, A, B, Q, R)
    if number in (7, 8, 11, 12, 13, 14, 17, 18, 19, 20):
        # SciPy's own residual is large, or the condition allows fewer digits.
        return
    X = scipy.linalg.solve_continuous_are(A, B, Q, R)
    assert np.linalg.norm(solution.X - X) < 1e-9 * np.linalg.norm(X)


compiled = jax.jit(lambda *problem: dlx.riccati.care(*problem, throw=False))


def test_compiled():
    """One program, of those of two states and one control. `test_care.py` has
    others."""
    shapes = [(2, 2), (2, 1)]
    numbers = [
        k for k, M in enumerate(SYSTEMS, 1) if [m.shape for m in M[1:3]] == shapes
    ]
    assert len(numbers) >= 5
    for k in numbers:
        if not is_on_the_axis(k):
            check_compiled(k)


def is_on_the_axis(number):
    """Whether rounding alone decides the status: the best closed loop is not stable."""
    A, B, Q, R = (np.asarray(M, float) for M in SYSTEMS[number - 1][1:])
    H = np.block([[A, -B @ np.linalg.solve(R, B.T)], [-Q, -A.T]])
    return np.abs(np.linalg.eigvals(H).real).min() < 1e-6


@minutes("a program is compiled for each size, the largest of 421 states")
def test_all_compiled():
    for number in range(1, 21):
        check_compiled(number)


def check_compiled(number):
    _, *problem = SYSTEMS[number - 1]
    problem = [np.asarray(M, float) for M in problem]
    riccati_systems.check_both_ways(False, problem, compiled(*problem))


def test_families():
    # In sizes of published systems, but for CAREX 15, which is left to its one.
    families = riccati_systems.carex_families(sizes=(4,), half_sizes=(4,))
    systems = [case for case in families if not case[0].startswith("CAREX 15")]
    assert len(systems) >= 130
    for system in systems:
        exam(*system)
