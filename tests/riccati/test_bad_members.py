"""Members of a batch that have no solution, and data that cannot be looked at."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import assert_close, needs_x64, user_error

import delucax as dlx


pytestmark = needs_x64


B, EYE = jnp.array([[0.0], [1.0]]), jnp.eye(2)
RESULTS = dlx.RESULTS


def test_bad_members_harm_no_other():
    """And the gradients of the others are central differences. `test_hinfinity.py` has
    bad members in discrete time."""
    h, way = 1e-6, np.array([[0.3, -0.7], [0.5, 0.2]])
    good = np.array([[-0.9, 0.3], [0.1, -0.2]])
    chain = np.array([[1.0, 1.0], [0.0, 1.0]])
    As = np.stack([good, -good, good.T, chain, good + h * way, good - h * way])
    Qs = np.stack([np.eye(2)] * 4 + [np.eye(2) * (1 + h), np.eye(2) * (1 - h)])
    spoilt = As.copy()
    spoilt[1], spoilt[2] = np.diag([2.0, -0.5]), np.diag([np.nan, -0.5])

    def value(A, Q):
        found = dlx.riccati.care(A, B, Q, EYE[:1, :1], throw=False)
        return jnp.sum(found.X) + jnp.sum(found.K), found.result == RESULTS.successful

    both = jax.value_and_grad(value, argnums=(0, 1), has_aux=True)
    both = jax.jit(jax.vmap(both))
    (values, solved), gradients = both(As, Qs)
    assert np.all(solved)
    (beside, solved), gradients_beside = both(spoilt, Qs)
    np.testing.assert_array_equal(solved, [True, False, False, True, True, True])
    others = np.array([0, 3, 4, 5])
    assert_close(beside[others], values[others], rtol=1e-14)
    for found, expected in zip(gradients_beside, gradients, strict=True):
        assert_close(found[others], expected[others], rtol=1e-12)
        assert_close(found[1:3], np.zeros((2, 2, 2)))
    slope = np.sum(gradients[0][0] * way) + np.trace(gradients[1][0])
    assert_close(slope, (values[4] - values[5]) / (2 * h), rtol=1e-6)
    # And what NumPy computes of concrete numbers.
    assert_close(value(good, np.eye(2))[0], values[0], rtol=1e-11)


@pytest.mark.parametrize("n, least, most", [(30, 0, 1e-12), (40, 1e-12, 1e-11)])
def test_as_close_as_rounding_allows(n, least, most):
    """Of 30 states, the solution itself leaves 4.4e-13 when it is rounded."""
    rng = np.random.default_rng(32)
    A, B = rng.normal(size=(n, n)) / np.sqrt(n), rng.normal(size=(n, 2))
    solution = dlx.riccati.care(A, B, np.eye(n), np.eye(2))
    assert least < solution.residual < most


def test_games_need_a_semidefinite_weight():
    with user_error(match="hinf_dare: Q must be positive semidefinite"):
        dlx.riccati.hinf_dare(EYE, B, None, np.diag([1.0, -1.0]), EYE[:1, :1])
