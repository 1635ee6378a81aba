"""The bounds of a window against quadratic programs, and what cannot hold."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import assert_close, needs_x64

import delucax as dlx


c = dlx.estimators
pytestmark = needs_x64
N, n, k = 8, 2, 1
A = np.array([[0.9, 0.4], [-0.3, 0.8]])
E, C = np.array([[0.5], [1.0]]), np.array([[1.0, 0.3]])
DYNAMICS = dlx.LinearDynamics(A, np.zeros((2, 1)), C, E)
W, V, P = np.eye(1), 0.5 * np.eye(1), np.array([[1.0, 0.4], [0.4, 0.5]])


@jax.jit
def estimated(mhe, ys):
    """The window once all observations are in it, as one program for all records."""
    return c.run_estimator(mhe, ys, throw=False).states


def by_dense_program(mean, ys, low, high):
    """The states of a window, by the disturbances as the unknowns."""
    roots = np.linalg.cholesky(P), np.linalg.cholesky(W)
    size = n + k * (N - 1)
    x, w = np.zeros((N, n, size + 1)), np.zeros((N - 1, k, size + 1))
    x[0, :, :n], x[0, :, -1] = roots[0], mean
    for t in range(N - 1):
        w[t, :, n + k * t : n + k * (t + 1)] = roots[1]
        x[t + 1] = A @ x[t] + E @ w[t]
    seen = (C @ x)[:, 0] / np.sqrt(V[0, 0])
    error = ys[:, 0] / np.sqrt(V[0, 0]) - seen[:, -1]
    M = np.concatenate([np.eye(size), seen[:, :-1]])
    q = -seen[:, :-1].T @ error
    G = np.concatenate([x.reshape(-1, size + 1), w.reshape(-1, size + 1)])
    along = lambda end: np.concatenate([np.tile(end[:n], N), np.tile(end[n:], N - 1)])
    lower, upper = (along(end) - G[:, -1] for end in (low, high))
    rows = dlx.qp.Rows(G[:, :-1], lower=lower, upper=upper)
    z = dlx.qp.solve(dlx.qp.Dense(M.T @ M, q, rows=rows), rtol=1e-11, atol=1e-11).x
    return x[:, :, :-1] @ np.asarray(z) + x[:, :, -1]


LOW, HIGH = np.array([-0.4, -0.6, -0.5]), np.array([0.5, 0.7, 0.3])


def bounded(mean, low=LOW, high=HIGH, window=N):
    options = dict(bounds=(low[:n], high[:n]), disturbance_bounds=(low[n:], high[n:]))
    return c.MHE(DYNAMICS, W, V, window, mean=mean, covariance=P, **options)


@pytest.mark.parametrize("seed", range(8))
def test_against_a_dense_program(seed):
    """Tight bounds of states and disturbances, of which many are active."""
    rng = np.random.default_rng(seed)
    mean, ys = rng.normal(size=2), 2 * rng.normal(size=(N, 1))
    states = estimated(bounded(mean), ys)
    assert np.all(states.result == dlx.RESULTS.successful)
    assert np.sum(states.sides[-1] != 0) > 2
    assert_close(states.x[-1], by_dense_program(mean, ys, LOW, HIGH), atol=1e-7)


def test_the_barrier_finds_the_active_bounds(monkeypatch):
    """Of one guess alone, few end at the solution: the others are left to it."""
    monkeypatch.setattr("delucax.estimators._window_bounds._GUESSES", 1)
    rng = np.random.default_rng(0)
    mean, ys = rng.normal(size=2), 2 * rng.normal(size=(N, 1))
    estimated.clear_cache()
    states = estimated(bounded(mean), ys)
    estimated.clear_cache()
    assert np.sum(states.sides[-1] != 0) > 2
    assert_close(states.x[-1], by_dense_program(mean, ys, LOW, HIGH), atol=1e-7)


def test_a_constant_between_bounds():
    """A parameter that does not move is bounded once, though at every stage: the
    estimate is the least-squares one, clipped."""
    still = dlx.LinearDynamics(np.eye(1), np.zeros((1, 1)))
    zero, one = np.zeros((1, 1)), np.eye(1)
    ys = np.linspace(0.5, 2.0, N)[:, None]
    mhe = c.MHE(still, zero, one, N, bounds=(-1.0, 0.8))
    kalman = c.KalmanFilter(still, zero, one, mean=[0.0])
    expected = np.minimum(c.run_filter(kalman, ys).updated.mean, 0.8)
    found = c.run_estimator(mhe, ys)
    assert_close(found.updated.mean, expected, atol=1e-9)
    assert expected[-1, 0] == 0.8 > expected[0, 0]


def test_equal_bounds_are_an_equation():
    low, high = LOW.copy(), HIGH.copy()
    low[1] = high[1] = 0.1
    low[2], high[2] = -np.inf, np.inf
    rng = np.random.default_rng(2)
    mean, ys = rng.normal(size=2), rng.normal(size=(N, 1))
    states = estimated(bounded(mean, low, high), ys)
    assert np.all(states.result == dlx.RESULTS.successful)
    assert_close(states.x[-1][:, 1], np.full(N, 0.1), atol=1e-12)
    assert_close(states.x[-1], by_dense_program(mean, ys, low, high), atol=1e-7)


def test_bounds_that_cannot_hold():
    """A state that is known to be outside: the status says so, and the estimate goes
    on."""
    still = dlx.LinearDynamics(0.5 * np.eye(1), np.zeros((1, 1)))
    zero = np.zeros((1, 1))
    mhe = c.MHE(still, zero, np.eye(1), 2, mean=[4.0], covariance=zero, bounds=(0, 1))
    found = c.run_estimator(mhe, np.ones((5, 1)), throw=False)
    failed = np.asarray(found.results == dlx.RESULTS.no_feasible_point)
    assert failed.tolist() == [True, True, True, False, False]
    assert_close(found.updated.mean[-1], [0.25], atol=1e-12)


def test_an_observation_that_is_not_finite():
    mhe = c.MHE(DYNAMICS, W, V, 3)
    update = jax.jit(lambda y, state: mhe.update(0.0, y, state))
    before = mhe.init()
    after = update(jnp.array([jnp.nan]), before)
    assert mhe.status(after) == dlx.RESULTS.diverged
    assert_close(mhe.estimate(after).mean, mhe.estimate(before).mean)
    assert mhe.status(update(jnp.array([1.0]), after)) == dlx.RESULTS.successful


def test_single_precision_of_data_is_kept():
    """Also with bounds in double precision."""
    rng = np.random.default_rng(0)
    mean, ys = rng.normal(size=2), 2 * rng.normal(size=(N, 1))
    given = DYNAMICS, W, V, mean, P, ys
    single = jax.tree.map(lambda a: jnp.asarray(a, jnp.float32), given)
    dynamics, *noise, start, spread, seen = single
    options = dict(bounds=(LOW[:n], HIGH[:n]), disturbance_bounds=(LOW[n:], HIGH[n:]))
    mhe = c.MHE(dynamics, *noise, N, mean=start, covariance=spread, **options)
    found = estimated(mhe, seen).x[-1]
    assert found.dtype == jnp.float32
    assert_close(found, by_dense_program(mean, ys, LOW, HIGH), atol=1e-4)
