import jax
import numpy as np
import pytest
import riccati_systems
import scipy.linalg
from helpers import assert_close, dtype, once, tolerance, user_error

import delucax as dlx


A = np.array([[0.0, 1.0], [0.0, 0.0]])
B = np.array([[0.0], [1.0]])
Q, R = np.eye(2), np.eye(1)


def test_double_integrator():
    solution = dlx.riccati.care(A, B, Q, R)
    root = np.sqrt(3)
    assert_close(solution.X, [[root, 1], [1, root]], rtol=tolerance(1e-6, 1e-14))
    assert_close(solution.K, [[1, root]], rtol=tolerance(1e-6, 1e-14))
    assert_close(solution.closed_loop, A - B @ solution.K)
    abscissa = np.max(np.linalg.eigvals(solution.closed_loop).real)
    assert_close(solution.spectral_abscissa, abscissa, rtol=tolerance(1e-5, 1e-8))
    assert solution.spectral_radius is None
    assert solution.result == dlx.RESULTS.successful
    true = riccati_systems.true_residual(False, A, B, Q, R, solution.X)
    assert true < tolerance(1e-6, 1e-15)
    # A bound: more digits are spent on it where it is above what counts as solved.
    assert true <= solution.residual < tolerance(1e-5, 1e-14)


def test_cross_weight_and_descriptor():
    rng = np.random.default_rng(0)
    A, B = rng.normal(size=(3, 3)), rng.normal(size=(3, 2))
    root = rng.normal(size=(5, 5))
    weight = root @ root.T
    E = np.eye(3) + 0.3 * rng.normal(size=(3, 3))
    Q, R, S = weight[:3, :3], weight[3:, 3:], weight[:3, 3:]
    solution = dlx.riccati.care(A, B, Q, R, S, E)
    X = scipy.linalg.solve_continuous_are(A, B, Q, R, E, S)
    assert np.linalg.norm(solution.X - X) < tolerance(1e-4, 1e-12) * np.linalg.norm(X)
    gain = np.linalg.solve(R, B.T @ X @ E + S.T)
    assert_close(solution.K, gain, atol=tolerance(1e-5, 1e-13))
    loop = np.linalg.solve(E, A - B @ gain)
    assert_close(solution.closed_loop, loop, atol=tolerance(1e-4, 1e-12))
    assert solution.spectral_abscissa < 0


ROTATION = np.array([[1.0, 0.3], [-0.4, 1.0]])


def rotated(modes, B, seen):
    """Modes in other coordinates, so that nothing is zero by luck."""
    back = np.linalg.inv(ROTATION)
    A = ROTATION @ np.diag(modes) @ back
    Q = back.T @ np.diag(seen) @ back
    return A, ROTATION @ np.array(B)[:, None], (Q + Q.T) / 2


compiled = jax.jit(lambda *data: dlx.riccati.care(*data, throw=False))


@pytest.mark.parametrize(
    "A, B, Q, status",
    [
        (*rotated([1.2, -0.5], [0.0, 1], [1.0, 1]), "not_stabilisable"),
        ([[0.0, 0], [0, -0.5]], [[0.0], [1]], np.eye(2), "not_stabilisable"),
        ([[0.0, 1], [0, 0]], [[0.0], [1]], np.zeros((2, 2)), "on_boundary"),
        ([[0.0, 1], [-1, 0]], [[0.0], [1]], np.zeros((2, 2)), "on_boundary"),
        (*rotated([0.0, -0.5], [1.0, 1], [0.0, 1]), "on_boundary"),
        ([[1.1, 1], [0, 0.9]], [[0.0], [1]], -5 * np.eye(2), "not_stabilising"),
    ],
)
def test_no_stabilising_solution(A, B, Q, status):
    A, B, Q = (np.asarray(M, dtype()) for M in (A, B, Q))
    solution = dlx.riccati.care(A, B, Q, R, throw=False)
    assert solution.result == getattr(dlx.RESULTS, status)
    assert compiled(A, B, Q, np.asarray(R, dtype())).result == solution.result
    with pytest.raises(RuntimeError, match="care: .*abscissa.*throw=False"):
        dlx.riccati.care(A, B, Q, R)


def test_least_energy():
    # Unstable modes are mirrored at the axis.
    unstable = np.array([[2.0, 1.0], [0.0, 1.5]])
    solution = dlx.riccati.care(unstable, B, np.zeros((2, 2)), R)
    moved = np.sort(np.linalg.eigvals(solution.closed_loop).real)
    assert_close(moved, [-2, -1.5], rtol=tolerance(1e-5, 1e-12))


def test_weights_of_controls_in_different_units():
    R = np.array([1.0, 1e-8], dtype())
    eye = np.eye(2, dtype=dtype())
    solution = dlx.riccati.care(-eye, eye, eye, np.diag(R))
    # Each entry for itself: X^2 / r + 2 X = 1.
    expected = R * (np.sqrt(1 + 1 / R) - 1)
    assert_close(np.diag(solution.X), expected, rtol=tolerance(1e-4, 1e-11))


def test_compiled_and_where_it_cannot_be_seen():
    data = [np.asarray(M, dtype()) for M in (A, B, Q, R)]
    solve, ill_posed = compiled, dlx.RESULTS.ill_posed
    found, at_once = solve(*data), dlx.riccati.care(*data)
    assert found.result == at_once.result == dlx.RESULTS.successful
    assert_close(found.X, at_once.X, rtol=tolerance(3e-4, 1e-11))
    assert_close(found.K, at_once.K, rtol=tolerance(3e-4, 1e-11))
    unknown = np.where([[True, False], [False, False]], np.nan, A)
    assert solve(unknown, *data[1:]).result == ill_posed
    assert solve(*data[:3], 0 * data[3]).result == ill_posed
    assert solve(*data[:3], -data[3]).result == ill_posed


def test_complex_data():
    turn = np.diag(np.exp([0.3j, -0.4j]))
    plain = dlx.riccati.care(A, B, Q, R)
    turned = dlx.riccati.care(turn @ A @ turn.conj(), turn @ B, Q, R)
    X = turn @ plain.X @ turn.conj()
    assert_close(turned.X, X, atol=tolerance(1e-5, 1e-14))


@once
@pytest.mark.parametrize(
    "change, match",
    [
        ({"A": np.ones((2, 3))}, r"care: A must be square, got shape \(2, 3\)"),
        ({"B": np.array([[np.inf], [0]])}, "care: B must be finite"),
        ({"B": np.ones((3, 1))}, r"as many rows as A \(2\), got shape \(3, 1\)"),
        ({"Q": np.array([[1.0, 1.0], [0.0, 1.0]])}, "Q must be symmetric"),
        ({"R": np.zeros((1, 1))}, "R must be positive definite"),
        ({"R": -np.eye(1)}, "R must be positive definite.*eigenvalue is -1"),
        ({"S": np.ones((1, 2))}, r"S must have shape \(2, 1\).*got \(1, 2\)"),
        ({"E": np.eye(3)}, r"E must have shape \(2, 2\).*got \(3, 3\)"),
    ],
)
def test_wrong_arguments(change, match):
    with user_error(match=match):
        dlx.riccati.care(**({"A": A, "B": B, "Q": Q, "R": R} | change))
