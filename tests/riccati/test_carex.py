"""Published continuous-time systems, and families of them."""

import numpy as np
import pytest
import riccati_systems
import scipy.linalg
from helpers import needs_x64

import delucax as dlx


def exam(name, A, B, Q, R):
    solution = dlx.riccati.care(A, B, Q, R, throw=False)
    X = np.asarray(solution.X)
    residual, loop = riccati_systems.continuous_residual(A, B, Q, R, X)
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


@needs_x64
@pytest.mark.parametrize("number", range(1, 21))
def test_published_systems(number):
    name, A, B, Q, R = riccati_systems.carex()[number - 1]
    solution = exam(name, A, B, Q, R)
    if number in (7, 8, 11, 12, 13, 14, 17, 18, 19, 20):
        # SciPy's own residual is large, or the condition allows fewer digits.
        return
    X = scipy.linalg.solve_continuous_are(A, B, Q, R)
    assert np.linalg.norm(solution.X - X) < 1e-9 * np.linalg.norm(X)


@needs_x64
def test_families():
    systems = riccati_systems.carex_families()
    assert len(systems) >= 130
    for system in systems:
        exam(*system)
