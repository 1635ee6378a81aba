"""Products in more digits, against fractions."""

from fractions import Fraction

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import dtype, tolerance

from delucax.math._accurate import product, product_in_parts, units_of_sum
from delucax.math._norms import power_of_two


def exact(left, right, *added):
    """The product and the sum, rounded once, and that of all absolute values."""
    fractions = np.vectorize(Fraction, otypes=[object])
    left, right, *added = (fractions(M.astype(float)) for M in (left, right, *added))
    sizes = abs(left) @ abs(right) + sum(abs(M) for M in added)
    return left @ right + sum(added), sizes.astype(float)


def draw(n, k, m, spread, seed):
    """Factors of scales that differ, and what cancels their product up to rounding."""
    rng = np.random.default_rng(seed)
    scale = lambda *shape: 10.0 ** rng.uniform(-spread, spread, shape)  # noqa: E731
    left = rng.normal(size=(n, k)) * scale(n, 1) * scale(1, k)
    right = rng.normal(size=(k, m)) * scale(k, 1) * scale(1, m)
    left, right = left.astype(dtype()), right.astype(dtype())
    return left, right, -(left @ right)


@pytest.mark.parametrize("spread", [0, 3])
@pytest.mark.parametrize("n, k, m", [(3, 5, 2), (1, 1, 1), (33, 32, 34)])
def test_its_error_is_bounded_and_small(n, k, m, spread):
    data = draw(n, k, m, spread, seed=n)
    total, lost = (np.asarray(M, float) for M in jax.jit(product)(*data))
    true, sizes = exact(*data)
    error = np.abs(np.vectorize(Fraction, otypes=[object])(total) - true).astype(float)
    assert np.all(error <= lost)
    eps = np.finfo(dtype()).eps
    assert np.all(lost <= eps * (np.abs(total) + tolerance(0.1, 1e-3) * sizes))


@pytest.mark.parametrize("k", [5, 70])
def test_in_parts(k):
    left, right, _ = draw(4, k, 3, 1, seed=k)
    total, units = jax.jit(product_in_parts)(left, right), units_of_sum(left.shape[1])
    true, sizes = exact(left, right)
    error = np.abs(
        np.vectorize(Fraction, otypes=[object])(np.asarray(total, float)) - true
    )
    assert np.all(error.astype(float) <= units * np.finfo(dtype()).eps / 2 * sizes)
    assert units <= min(k, 17)


def test_a_power_of_two_has_no_rounding():
    whole = np.arange(-120, 121)
    near = jnp.asarray(1.1 * 2.0**whole, dtype())
    np.testing.assert_array_equal(np.asarray(power_of_two(near), float), 2.0**whole)
