import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import riccati_systems
import scipy.linalg
from helpers import assert_close, dtype, needs_x64, once, tolerance, user_error

import delucax as dlx


A = np.array([[1.0, 1.0], [0.0, 1.0]])
B = np.array([[0.0], [1.0]])
Q, R = np.eye(2), np.eye(1)


def random_problem(seed, n, m):
    rng = np.random.default_rng(seed)
    A, B = 1.2 * rng.normal(size=(n, n)) / np.sqrt(n), rng.normal(size=(n, m))
    E = np.eye(n) + 0.3 * rng.normal(size=(n, n)) / np.sqrt(n)
    root = rng.normal(size=(n + m, n + m))
    weight = root @ root.T / n
    return A, B, weight[:n, :n], weight[n:, n:], weight[:n, n:], E


def equation(A, B, Q, R, S, E, X):
    cross = A.T @ X @ B + S
    gain = np.linalg.solve(R + B.T @ X @ B, cross.T)
    terms = A.T @ X @ A, E.T @ X @ E, cross @ gain, Q
    left = terms[0] - terms[1] - terms[2] + terms[3]
    return np.linalg.norm(left) / sum(map(np.linalg.norm, terms)), gain


def test_double_integrator():
    solution = dlx.riccati.dare(A, B, Q, R)
    assert_close(solution.K, [[0.42208244, 1.24392885]], rtol=tolerance(1e-6, 1e-8))
    X = [[2.94712, 2.36921], [2.36921, 4.61313]]
    assert_close(solution.X, X, rtol=1e-5)
    assert_close(jnp.trace(solution.X), 7.56026, rtol=1e-6)
    assert_close(solution.closed_loop, A - B @ solution.K)
    radius = np.max(np.abs(np.linalg.eigvals(solution.closed_loop)))
    assert_close(solution.spectral_radius, radius, rtol=tolerance(1e-5, 1e-8))
    assert solution.result == dlx.RESULTS.successful
    true = riccati_systems.true_residual(True, A, B, Q, R, solution.X)
    assert true < tolerance(1e-6, 1e-15)
    # A bound: more digits are spent on it where it is above what counts as solved.
    assert true <= solution.residual < tolerance(1e-5, 1e-14)
    assert solution.iterations < 10


@needs_x64
@pytest.mark.parametrize("n, m", [(1, 1), (4, 2)])
def test_matches_scipy(n, m):
    for seed in range(10):
        A, B, Q, R, S, _ = random_problem(seed, n, m)
        X = scipy.linalg.solve_discrete_are(A, B, Q, R, s=S)
        solution = dlx.riccati.dare(A, B, Q, R, S)
        assert np.linalg.norm(solution.X - X) < 1e-9 * np.linalg.norm(X)
        residual, gain = equation(A, B, Q, R, S, np.eye(n), np.asarray(solution.X))
        assert residual < 1e-13 and solution.residual < 1e-12
        assert_close(solution.K, gain, rtol=1e-13, atol=1e-13)


@needs_x64
def test_descriptor_form():
    for seed in range(10):
        A, B, Q, R, S, E = random_problem(seed, 4, 2)
        # SciPy gives up on some of these: it is given the plain problem.
        plain = np.linalg.solve(E, A), np.linalg.solve(E, B)
        Y = scipy.linalg.solve_discrete_are(*plain, Q, R, s=S)
        solution = dlx.riccati.dare(A, B, Q, R, S, E)
        assert np.linalg.norm(E.T @ solution.X @ E - Y) < 1e-9 * np.linalg.norm(Y)
        residual, gain = equation(A, B, Q, R, S, E, np.asarray(solution.X))
        assert residual < 1e-13 and solution.residual < 1e-12
        assert_close(solution.K, gain, rtol=1e-12, atol=1e-12)
        loop = np.linalg.solve(E, A - B @ gain)
        assert_close(solution.closed_loop, loop, atol=1e-12)
        # A bound, so from above but for rounding, and a close one.
        radius = np.max(np.abs(np.linalg.eigvals(loop)))
        assert -1e-12 < float(solution.spectral_radius) - radius < 1e-8
    solution = dlx.riccati.dare(A, B, Q, R, S, np.diag([1.0, 1, 1, 0]), throw=False)
    assert solution.result != dlx.RESULTS.successful


@needs_x64
def test_single_precision():
    problem = random_problem(0, 4, 2)
    exact, _ = equation(*problem, np.zeros((4, 4)))
    assert exact > 0.1
    single = [jnp.asarray(M, jnp.float32) for M in problem]
    solution = dlx.riccati.dare(*single)
    assert solution.X.dtype == solution.K.dtype == jnp.float32
    X = np.asarray(solution.X, np.float64)
    residual, _ = equation(*problem, X)
    assert residual < 1e-5


ROTATION = np.array([[1.0, 0.3], [-0.4, 1.0]])


def rotated(modes, B, seen):
    """Modes in other coordinates, so that nothing is zero by luck."""
    back = np.linalg.inv(ROTATION)
    A = ROTATION @ np.diag(modes) @ back
    Q = back.T @ np.diag(seen) @ back
    return A, ROTATION @ np.array(B)[:, None], (Q + Q.T) / 2


compiled = jax.jit(lambda *data: dlx.riccati.dare(*data, throw=False))


@pytest.mark.parametrize(
    "A, B, Q, status",
    [
        (*rotated([1.2, 0.5], [0.0, 1], [1.0, 1]), "not_stabilisable"),
        ([[1.2, 0], [0, 0.5]], [[0.0], [1]], np.eye(2), "not_stabilisable"),
        ([[1.0, 0], [0, 0.5]], [[0.0], [1]], np.eye(2), "not_stabilisable"),
        ([[1.0, 1], [0, 1]], [[0.0], [1]], np.zeros((2, 2)), "on_boundary"),
        (*rotated([-1.0, 0.5], [1.0, 1], [0.0, 1]), "on_boundary"),
        ([[0.5, 0], [0, 0.2]], [[0.0], [1]], np.diag([1.0, -9]), "not_stabilising"),
    ],
)
def test_no_stabilising_solution(A, B, Q, status):
    A, B, Q = (np.asarray(M, dtype()) for M in (A, B, Q))
    solution = dlx.riccati.dare(A, B, Q, R, throw=False)
    assert solution.result == getattr(dlx.RESULTS, status)
    assert compiled(A, B, Q, np.asarray(R, dtype())).result == solution.result
    with pytest.raises(RuntimeError, match="dare: .*throw=False"):
        dlx.riccati.dare(A, B, Q, R)


@once
def test_a_compiled_solve_raises():
    A = np.diag([1.2, 0.5])
    with pytest.raises(eqx.EquinoxRuntimeError, match="dare: .*stabilis"):
        jax.block_until_ready(eqx.filter_jit(dlx.riccati.dare)(A, B, Q, R))


def test_compiled_and_where_it_cannot_be_seen():
    data = [np.asarray(M, dtype()) for M in (A, B, Q, R)]
    solve, ill_posed = compiled, dlx.RESULTS.ill_posed
    found, at_once = solve(*data), dlx.riccati.dare(*data)
    assert found.result == at_once.result == dlx.RESULTS.successful
    assert_close(found.X, at_once.X, rtol=tolerance(3e-4, 1e-11))
    assert_close(found.K, at_once.K, rtol=tolerance(3e-4, 1e-11))
    unknown = np.where([[True, False], [False, False]], np.nan, A)
    assert solve(unknown, *data[1:]).result == ill_posed
    assert solve(*data[:3], -data[3]).result == ill_posed
    asymmetric = np.array([[1.0, 0.5], [0.0, 1.0]], dtype())
    assert solve(*data[:2], asymmetric, data[3]).result == ill_posed
    E = np.diag([1.0, 0.0])
    assert dlx.riccati.dare(*data, None, E, throw=False).result == ill_posed


def test_least_energy():
    # With Q = 0 the cost sees no state, yet unstable modes must be moved: they are
    # mirrored at the unit circle, where plain doubling would rest at X = 0.
    unstable = jnp.array([[2.0, 1.0], [0.0, 1.5]])
    solution = dlx.riccati.dare(unstable, B, jnp.zeros((2, 2)), R)
    moved = np.sort(np.abs(np.linalg.eigvals(solution.closed_loop)))
    assert_close(moved, [1 / 2, 1 / 1.5], rtol=tolerance(1e-4, 1e-12))


@needs_x64
def test_free_control():
    # R = 0: one-step dead-beat control of what B reaches.
    solution = dlx.riccati.dare(2 * jnp.eye(2), jnp.eye(2), Q, jnp.zeros((2, 2)))
    assert_close(solution.K, 2 * np.eye(2), atol=1e-14)
    assert_close(solution.X, np.eye(2), atol=1e-14)
    assert solution.spectral_radius < 1e-5


@needs_x64
def test_complex_data():
    turn = np.diag(np.exp([0.3j, -0.4j]))
    plain = dlx.riccati.dare(A, B, Q, R)
    turned = dlx.riccati.dare(turn @ A @ turn.conj(), turn @ B, Q, R)
    X = turn @ plain.X @ turn.conj()
    assert_close(turned.X, X, atol=1e-13)
    assert_close(turned.K, plain.K @ turn.conj(), atol=1e-13)


@needs_x64
def test_dead_beat_loop_has_a_gradient():
    nilpotent = jnp.array([[0.0, 1.0], [0.0, 0.0]])
    rest = np.zeros((2, 1)), Q, R
    assert dlx.riccati.dare(nilpotent, *rest).spectral_radius == 0
    total = lambda A: jnp.sum(dlx.riccati.dare(A, *rest, throw=False).X)
    gradient = jax.jit(jax.grad(total))(nilpotent)
    # X is the sum of (A^k)' A^k, and A^2 = 0: so dX = dA' A + A' dA.
    assert_close(gradient, [[2.0, 2.0], [0.0, 0.0]], atol=1e-12)


@once
@pytest.mark.parametrize(
    "change, match",
    [
        ({"A": np.ones((2, 3))}, r"A must be square, got shape \(2, 3\)"),
        ({"A": np.ones(2)}, r"A must be a matrix, got shape \(2,\)"),
        ({"A": np.array([[np.nan, 0], [0, 1]])}, "A must be finite"),
        ({"B": np.ones((3, 1))}, r"as many rows as A \(2\), got shape \(3, 1\)"),
        ({"Q": np.eye(3)}, r"Q must have shape \(2, 2\).*got \(3, 3\)"),
        ({"Q": np.array([[1.0, 1.0], [0.0, 1.0]])}, "Q must be symmetric"),
        ({"R": np.ones((1, 2))}, r"R must be square, got shape \(1, 2\)"),
        ({"R": -np.eye(1)}, "R must be positive semidefinite.*eigenvalue is -1"),
        ({"R": np.eye(2)}, r"R must have shape \(1, 1\).*got \(2, 2\)"),
        ({"S": np.ones((1, 2))}, r"S must have shape \(2, 1\).*got \(1, 2\)"),
        ({"E": np.eye(3)}, r"E must have shape \(2, 2\).*got \(3, 3\)"),
    ],
)
def test_wrong_arguments(change, match):
    with user_error(match=match):
        dlx.riccati.dare(**({"A": A, "B": B, "Q": Q, "R": R} | change))


@once
@pytest.mark.skipif(
    jax.__version_info__ < (0, 12), reason="XLA compiled small loops in other ways"
)
def test_a_small_program():
    """Of few operations, all but a few of them in loops that XLA on CPU compiles as a
    whole. A call of a library in one of the loops would end that."""
    A, B, Q, R, *_ = random_problem(0, 4, 1)
    solve = jax.jit(lambda *data: dlx.riccati.dare(*data, throw=False))
    text = solve.lower(A, B, Q, R).compile().as_text()
    entry = text[text.index("ENTRY") :]
    assert text.count(" fusion(") <= 200
    assert entry.count(" fusion(") <= 16
    assert entry.count(" while(") == 0
    assert text.count(" custom-call(") == text.count(" dot(") == 0
