import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import needs_x64

from delucax.math._linear_solve import SMALL, solve
from delucax.riccati._spectrum import spectral_abscissa, spectral_radius


pytestmark = needs_x64


def matrices(n):
    rng = np.random.default_rng(n)
    A = rng.normal(size=(n, n)) / np.sqrt(n)
    return A, A - A.T, np.triu(A), A @ np.diag(np.logspace(-3, 3, n))


@pytest.mark.parametrize("n", [3, 40])
def test_radius_and_abscissa(n):
    radius, abscissa = jax.jit(spectral_radius), jax.jit(spectral_abscissa)
    for A in matrices(n):
        eigenvalues = np.linalg.eigvals(A)
        exact = np.max(np.abs(eigenvalues))
        assert -1e-12 < float(radius(A)) / exact - 1 < 1e-7
        assert abs(float(abscissa(A)) - np.max(eigenvalues.real)) < 1e-8 * exact


def test_nilpotent():
    A, radius = jnp.eye(4, k=1), jax.jit(spectral_radius)
    assert radius(A) == 0
    assert radius(0 * A) == 0
    assert abs(jax.jit(spectral_abscissa)(0 * A)) < 1e-6


@pytest.mark.parametrize("n", [1, 4, SMALL, SMALL + 1])
def test_solve(n):
    rng = np.random.default_rng(n)
    # A zero in the corner, so that rows have to be exchanged.
    matrix = rng.normal(size=(20, n, n))
    if n > 1:
        matrix[:, 0, 0] = 0
    matrix, right = jnp.asarray(matrix), jnp.asarray(rng.normal(size=(20, n, 3)))
    found = jax.jit(jax.vmap(solve))(matrix, right)
    exact = np.linalg.solve(matrix, right)
    error = np.max(np.abs(found - exact)) / np.max(np.abs(exact))
    assert error < 1e-12
    transposed = jax.linear_transpose(lambda b: solve(matrix[0], b), right[0])
    (back,) = jax.jit(transposed)(right[0])
    exact = np.linalg.solve(matrix[0].T, right[0])
    assert np.max(np.abs(back - exact)) < 1e-11 * np.max(np.abs(exact))
