import jax.numpy as jnp
import numpy as np
import scipy.linalg
from helpers import assert_close, tolerance, user_error

import delucax as dlx


rng = np.random.default_rng(0)
A, C = rng.normal(size=(3, 3)) / 2, rng.normal(size=(2, 3))
noise = rng.normal(size=(5, 5))
noise = noise @ noise.T
W, V, S = noise[:3, :3], noise[3:, 3:], noise[:3, 3:]


def test_discrete():
    solution = dlx.riccati.filter_dare(A, C, W, V, S)
    X = scipy.linalg.solve_discrete_are(A.T, C.T, W, V, s=S)
    assert_close(solution.X, X, rtol=tolerance(1e-4, 1e-10))
    K = np.linalg.solve(V + C @ X @ C.T, (A @ X @ C.T + S).T).T
    assert_close(solution.K, K, atol=tolerance(1e-4, 1e-10))
    assert_close(solution.closed_loop, A - K @ C, atol=tolerance(1e-4, 1e-10))
    assert solution.spectral_radius < 1
    # It is what the recursion of the predictor comes to.
    P = np.eye(3)
    for _ in range(200):
        gain = np.linalg.solve(V + C @ P @ C.T, (A @ P @ C.T + S).T).T
        P = A @ P @ A.T + W - gain @ (A @ P @ C.T + S).T
    assert_close(solution.X, P, rtol=tolerance(1e-4, 1e-10))


def test_continuous():
    solution = dlx.riccati.filter_care(A, C, W, V, S)
    X = scipy.linalg.solve_continuous_are(A.T, C.T, W, V, s=S)
    assert_close(solution.X, X, rtol=tolerance(1e-4, 1e-9))
    K = np.linalg.solve(V, (X @ C.T + S).T).T
    assert_close(solution.K, K, atol=tolerance(1e-4, 1e-9))
    assert_close(solution.closed_loop, A - K @ C, atol=tolerance(1e-4, 1e-9))
    assert solution.spectral_abscissa < 0


def test_undetectable():
    A, C = jnp.diag(jnp.array([1.2, 0.5])), jnp.array([[0.0, 1.0]])
    solve = dlx.riccati.filter_dare
    solution = solve(A, C, jnp.eye(2), jnp.eye(1), throw=False)
    assert solution.result == dlx.RESULTS.not_stabilisable


def test_wrong_arguments():
    with user_error(match=r"filter_dare: C must have as many columns as A \(3\)"):
        dlx.riccati.filter_dare(A, C[:, :2], W, V)
    with user_error(match="filter_care: V must be positive definite"):
        dlx.riccati.filter_care(A, C, W, 0 * V)
    with user_error(match=r"filter_dare: W must have shape \(3, 3\)"):
        dlx.riccati.filter_dare(A, C, V, V)
