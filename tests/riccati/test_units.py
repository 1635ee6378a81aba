"""Equations whose states are in other units have the same solutions in these."""

import functools

import jax.numpy as jnp
import numpy as np
import pytest
import riccati_systems
from helpers import dtype, needs_x64, tolerance

import delucax as dlx


N, M = 4, 2


def solver(name):
    return functools.partial(getattr(dlx.riccati, name), throw=False)


def problem(seed, descriptor):
    rng = np.random.default_rng(seed)
    A, B = rng.normal(size=(N, N)), rng.normal(size=(N, M))
    E = np.eye(N) + rng.normal(size=(N, N)) / 8 if descriptor else None
    return A, B, np.eye(N), np.eye(M), None, E


def in_units(units, A, B, Q, R, S, E):
    """The same in states that are `units` times the first."""
    up, across = units[:, None], units[:, None] / units
    E = None if E is None else E * across
    return A * across, B * up, Q / (up * up.T), R, S, E


def as_dtype(data):
    return tuple(None if D is None else np.asarray(D, dtype()) for D in data)


@needs_x64
@pytest.mark.parametrize("descriptor", [False, True])
@pytest.mark.parametrize("name", ["dare", "care"])
def test_the_gain_is_that_of_the_plain_problem(name, descriptor):
    solve = solver(name)
    rng = np.random.default_rng(0)
    for seed in range(8):
        plain = problem(seed, descriptor)
        units = 10.0 ** rng.uniform(-5, 5, N)
        data = as_dtype(in_units(units, *plain))
        wanted, solution = solve(*as_dtype(plain)), solve(*data)
        assert solution.result == wanted.result == dlx.RESULTS.successful
        error = np.max(np.abs(solution.K * units - wanted.K))
        assert error < 1e-11 * np.max(np.abs(wanted.K))
        A, B, Q, R, S, E = data
        true = riccati_systems.true_residual(
            name == "dare", A, B, Q, R, solution.X, S, E
        )
        assert true <= solution.residual


def test_a_gain_in_single_precision():
    """A double integrator whose velocity is in units of a few millionths."""
    s = 10**5.6
    A = jnp.array([[1.0025, 0.0497 / s], [0.0995 * s, 0.9877]])
    B, Q = jnp.array([[0.00125], [0.05 * s]]), jnp.diag(jnp.array([1.0, s**-2]))
    K = solver("dare")(A, B, Q, jnp.eye(1)).K
    np.testing.assert_allclose(K * jnp.array([1, s]), [[4.067, 2.676]], rtol=1e-3)


CHAINS = {
    "double": (np.diag([1.0], 1), np.array([[0.0], [1.0]])),
    "triple": (np.diag([1.0, 1.0], 1), np.array([[0.0], [0.0], [1.0]])),
    "triangular": (np.array([[0.5, 0.3], [0.0, 1.0]]), np.array([[0.0], [1.0]])),
}


@pytest.mark.parametrize("rows", [False, True])
@pytest.mark.parametrize(
    "chain",
    [pytest.param(c, marks=needs_x64) for c in ("double", "triangular")] + ["triple"],
)
@pytest.mark.parametrize("name", ["dare", "care"])
def test_chains_of_integrators(name, chain, rows):
    """One state moves the next alone: nothing but the control and the cost tells how
    their units compare. With `rows`, those of an E are in other units than the states.
    """
    A, B = CHAINS[chain]
    n = len(A)
    if name == "dare":
        A, B = np.eye(n) + A / 10, B / 10
    E = np.eye(n) + np.ones((n, n)) / 8 if rows else None
    R = np.eye(1)
    for weight in np.diag([1.0] + [0.0] * (n - 1)), np.eye(n):
        wanted = solver(name)(*as_dtype((A, B, weight, R, None, E))).K
        for power in tolerance((1, 2), (4, 8)):
            d = 10.0 ** np.linspace(-power, power, n)
            for by in (d, 1 / d, d / d[0]):
                *data, F = in_units(by, A, B, weight, R, None, E)
                if rows:
                    data[0], data[1], F = (M / by[:, None] ** 2 for M in (*data[:2], F))
                solution = solver(name)(*as_dtype((*data, F)))
                assert solution.result == dlx.RESULTS.successful
                error = np.max(np.abs(solution.K * by - wanted))
                assert error < tolerance(1e-3, 1e-9) * np.max(np.abs(wanted))
