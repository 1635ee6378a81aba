"""Eliminations and products of small matrices, alone and in a batch."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import assert_close, check_second_order, needs_x64, once

from delucax._jax import matmul
from delucax.math._linear_solve import factorised, is_definite, SMALL


@jax.jit
def _solved(A, b):
    return factorised(A)(b)


@needs_x64
@pytest.mark.parametrize("imaginary", [0, 1j])
@pytest.mark.parametrize("n", [1, 2, 4, SMALL, SMALL + 1])
def test_solve(n, imaginary):
    rng = np.random.default_rng(n)
    A, b = rng.normal(size=(3, n, n)), rng.normal(size=(3, n, 2))
    A[:, 0, 0] = 0 if n > 1 else 1  # a row exchange is needed
    if imaginary:
        A = A + imaginary * rng.normal(size=A.shape)
        b = b.astype(complex)
    expected = np.linalg.solve(A, b)
    assert_close(jax.jit(jax.vmap(_solved))(A, b), expected, rtol=1e-11, atol=1e-11)
    assert_close(_solved(A[0], b[0]), expected[0], rtol=1e-11, atol=1e-11)


@needs_x64
def test_derivatives_of_a_solve():
    # Reverse mode solves with the transposed factors.
    rng = np.random.default_rng(0)
    (A, step), (b, shift) = rng.normal(size=(2, 4, 4)), rng.normal(size=(2, 4, 2))
    line = lambda e: jnp.sum(jnp.sin(_solved(A + e * step, b + e * shift)))
    check_second_order(line, backwards=True)


@once
@pytest.mark.parametrize("n", [2, 5])
def test_singular_matrices_have_no_finite_solution(n):
    for A in jnp.zeros((n, n)), jnp.tile(jnp.arange(1.0, n + 1), (n, 1)):
        assert not np.any(np.isfinite(_solved(A, jnp.ones((n, 1)))))


@once
@pytest.mark.parametrize("n", [1, 3, SMALL, SMALL + 1])
def test_definite_matrices(n):
    root = np.random.default_rng(n).normal(size=(n, n))
    matrix = jnp.asarray(root @ root.T + np.eye(n))
    lowest = np.linalg.eigvalsh(matrix)[0]
    assert is_definite(matrix)
    assert not is_definite(matrix - 1.1 * lowest * jnp.eye(n))
    assert not is_definite(jnp.full((n, n), jnp.nan))


def _mapped(product):
    # Over both arguments, and over the left one alone.
    return lambda A, B: jax.vmap(jax.vmap(product, (0, None)), (None, 0))(A, B)


@needs_x64
def test_products_in_a_batch():
    rng = np.random.default_rng(0)
    A, B = rng.normal(size=(3, 2, 4)), rng.normal(size=(2, 4, 3))
    expected = _mapped(jnp.matmul)(A, B)
    assert_close(jax.jit(_mapped(matmul))(A, B), expected, atol=1e-14)
    assert "dot(" not in jax.jit(_mapped(matmul)).lower(A, B).compile().as_text()
    step, shift = rng.normal(size=A.shape), rng.normal(size=B.shape)
    product = lambda e: _mapped(matmul)(A + e * step, B + e * shift)
    check_second_order(lambda e: jnp.sum(jnp.sin(product(e))), backwards=True)
