import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg
from helpers import assert_close, needs_x64, user_error

import delucax as dlx


pytestmark = needs_x64


# Most problems have one shape, so that each solver is compiled once for them.
A = np.array([[1.0, 1.0], [0.0, 1.0]])
B = np.array([[0.0], [1.0]])
Q, R = np.eye(2), np.eye(1)
hinf_dare, hinf_care = dlx.riccati.hinf_dare, dlx.riccati.hinf_care
hinf_dre, hinf_cre = dlx.riccati.hinf_dre, dlx.riccati.hinf_cre


def random_game(seed, n=2, m=1, k=2):
    rng = np.random.default_rng(seed)
    C = rng.normal(size=(n, n) if seed % 2 else (1, n))
    A = 1.2 * rng.normal(size=(n, n)) / np.sqrt(n)
    return A, rng.normal(size=(n, m)), rng.normal(size=(n, k)), C.T @ C, np.eye(m)


def root(Q):
    """Some `C` with `C'C = Q`."""
    values, vectors = np.linalg.eigh(np.asarray(Q))
    return np.sqrt(np.maximum(values, 0))[:, None] * vectors.T


def worst_gain(loop, D, K, Q, R, points):
    """The H-infinity norm from `w` to the cost, by a sweep of `points` of the plane."""
    C = np.vstack([root(Q), np.linalg.cholesky(np.asarray(R)).T @ K])
    resolvent = points[:, None, None] * np.eye(len(loop)) - np.asarray(loop)
    D = np.broadcast_to(D, (len(points), *np.shape(D)))
    response = C @ np.linalg.solve(resolvent, D)
    return np.max(np.linalg.norm(response, 2, axis=(1, 2)))


CIRCLE = np.exp(1j * np.linspace(0, np.pi, 4001))
AXIS = 1j * np.concatenate([[0.0], np.logspace(-4, 4, 4001)])


def test_double_integrator():
    solution = hinf_dare(A, B, np.eye(2), Q, R)
    assert solution.result == dlx.RESULTS.successful
    assert_close(solution.gamma, 2.9563, atol=1e-4)
    # Published to a level some 3e-4 above the least.
    assert_close(solution.K, [[0.7129, 1.7128]], atol=2e-4)
    published = hinf_dare(A, B, None, Q, R, gamma=2.95655)
    assert_close(published.K, [[0.7129, 1.7128]], atol=1e-4)
    K = np.asarray(published.K, np.float64)
    loop = np.asarray(A) - np.asarray(B) @ K
    cost = scipy.linalg.solve_discrete_lyapunov(loop.T, np.eye(2) + K.T @ K)
    assert_close(np.trace(cost), 9.2923, atol=2e-3)
    # Without a limit to the level it is the linear-quadratic regulator.
    lqr = hinf_dare(A, B, None, Q, R, gamma=1e4)
    assert_close(lqr.K, [[0.4221, 1.2439]], atol=1e-4)


def test_value_iteration():
    game = random_game(1)
    A, B, D, Q, R = game
    gamma = 1.2 * float(hinf_dare(*game).gamma)
    solution = hinf_dare(*game, gamma=gamma)
    G = B @ B.T - D @ D.T / gamma**2
    M = np.zeros((2, 2))
    for _ in range(500):
        moved = np.linalg.solve(np.eye(2) + G @ M, A)
        M = Q + A.T @ M @ moved
    moved = np.linalg.solve(np.eye(2) + G @ M, A)
    assert_close(solution.X, M, rtol=1e-9, atol=1e-9)
    assert_close(solution.K, B.T @ M @ moved, atol=1e-9)
    assert_close(solution.L, D.T @ M @ moved / gamma**2, atol=1e-9)
    assert_close(solution.closed_loop, A - B @ np.asarray(solution.K), atol=1e-12)
    radius = np.max(np.abs(np.linalg.eigvals(solution.closed_loop)))
    assert_close(solution.spectral_radius, radius, rtol=1e-7)
    assert solution.residual < 1e-13


def test_least_level_is_the_norm_of_the_loop():
    for seed in range(2):
        game = random_game(seed)
        A, B, D, Q, R = game
        solution = hinf_dare(*game)
        gamma = float(solution.gamma)
        sweep = worst_gain(solution.closed_loop, D, solution.K, Q, R, CIRCLE)
        # No gain does better, so that this one meets its level, and not by much.
        assert 0.999 * gamma < sweep < (1 + 1e-9) * gamma
        below = hinf_dare(*game, gamma=(1 - 1e-9) * gamma, throw=False)
        assert below.result == dlx.RESULTS.infeasible
        X = scipy.linalg.solve_discrete_are(
            A,
            np.hstack([B, D]),
            Q,
            scipy.linalg.block_diag(R, -((1.1 * gamma) ** 2) * np.eye(2)),
        )
        assert_close(hinf_dare(*game, gamma=1.1 * gamma).X, X, rtol=1e-8, atol=1e-8)


def test_continuous_game():
    for seed in range(2):
        game = random_game(seed)
        A, B, D, Q, R = game
        least = float(hinf_care(*game).gamma)
        below = hinf_care(*game, gamma=0.999 * least, throw=False)
        assert below.result == dlx.RESULTS.infeasible
        gamma = 1.1 * least
        solution = hinf_care(*game, gamma=gamma)
        weight = scipy.linalg.block_diag(R, -(gamma**2) * np.eye(2))
        X = scipy.linalg.solve_continuous_are(A, np.hstack([B, D]), Q, weight)
        assert_close(solution.X, X, rtol=1e-8, atol=1e-8 * np.max(np.abs(X)))
        assert_close(solution.K, B.T @ X, rtol=1e-8, atol=1e-8 * np.max(np.abs(X)))
        assert_close(solution.L, D.T @ X / gamma**2, atol=1e-8 * np.max(np.abs(X)))
        abscissa = np.max(np.linalg.eigvals(solution.closed_loop).real)
        assert_close(solution.spectral_abscissa, abscissa, rtol=1e-6)
        sweep = worst_gain(solution.closed_loop, D, solution.K, Q, R, AXIS)
        assert 0.5 * gamma < sweep < gamma and solution.residual < 1e-13


def test_no_solution():
    for solve, unstable in ((hinf_dare, 1.2), (hinf_care, 0.2)):
        low = solve(A, B, None, Q, R, gamma=0.5, throw=False)
        assert low.result == dlx.RESULTS.infeasible
        assert np.all(np.isnan(low.X)) and np.all(np.isnan(low.K))
        with pytest.raises(RuntimeError, match=f"{solve.__name__}: .*gamma 0.5"):
            solve(A, B, None, Q, R, gamma=0.5)
        stuck = np.diag([unstable, -0.5])
        lost = solve(stuck, B, None, Q, R, throw=False)
        assert lost.result == dlx.RESULTS.not_stabilising
        assert lost.gamma == np.inf
    with user_error(match="hinf_dre: Q must be positive semidefinite"):
        hinf_dre(A, B, None, np.diag([2.0, -3.0]), R, horizon=2)


T = 60


def finite_game(seed):
    games = [random_game(seed + i) for i in range(T)]
    return [np.stack(parts) for parts in zip(*games, strict=True)]


def test_finite_horizon_game():
    A, B, D, Q, R = finite_game(2)
    final = np.eye(2)
    solution = hinf_dre(A, B, D, Q, R, final=final)
    gamma = float(solution.gamma)
    # The worst ratio of cost to disturbance of the loop, as one matrix.
    outputs, forced = [], np.zeros((2, 2 * T))
    for t in range(T):
        K = np.asarray(solution.K[t])
        outputs += [root(Q[t]) @ forced, -K @ forced]
        forced = (A[t] - B[t] @ K) @ forced
        forced[:, 2 * t : 2 * t + 2] += D[t]
    outputs.append(forced)
    assert_close(np.linalg.norm(np.vstack(outputs), 2), gamma, rtol=1e-6)
    # A level above, by the recursion as it is written.
    gamma = 1.3 * gamma
    above = hinf_dre(A, B, D, Q, R, final=final, gamma=gamma)
    M = final
    for t in reversed(range(T)):
        G = B[t] @ B[t].T - D[t] @ D[t].T / gamma**2
        moved = np.linalg.solve(np.eye(2) + G @ M, A[t])
        assert_close(above.K[t], B[t].T @ M @ moved, atol=1e-10)
        assert_close(above.L[t], D[t].T @ M @ moved / gamma**2, atol=1e-10)
        M = Q[t] + A[t].T @ M @ moved
        assert_close(above.X[t], M, atol=1e-10 * np.max(np.abs(M)))
    low = hinf_dre(A, B, D, Q, R, final=final, gamma=0.7 * gamma, throw=False)
    assert low.result == dlx.RESULTS.infeasible and np.all(np.isnan(low.X[0]))


def test_long_horizons_are_stationary():
    long = hinf_dre(A, B, None, Q, R, horizon=T, final=Q)
    stationary = hinf_dare(A, B, None, Q, R)
    assert_close(long.gamma, stationary.gamma, rtol=1e-11)
    assert_close(long.K[0], stationary.K, rtol=1e-9)
    X = hinf_cre(A, B, None, Q, R, gamma=4.0, times=[0.0, 1.0, 50.0]).X
    stationary = hinf_care(A, B, None, Q, R, gamma=4.0)
    assert_close(X[0], stationary.X, rtol=1e-9)
    low = hinf_cre(A, B, None, Q, R, gamma=2.0, times=[0.0, 1.0, 50.0], throw=False)
    assert low.result == dlx.RESULTS.infeasible and np.all(np.isnan(low.X[0]))


def test_continuous_horizon_in_closed_form():
    # dX/ds = 1 - (1 - gamma^-2) X^2 with gamma below 1 is tan(w s) / w, to its pole.
    # A second state has no part in it.
    first = np.diag([1.0, 0.0])
    solve = lambda **options: hinf_cre(
        0 * A, first[:, :1], first, first, R, times=[0.0, 0.5, 1.0], **options
    )
    w = np.sqrt(1 / 0.7**2 - 1)
    expected = np.tan(w * np.array([1.0, 0.5, 0.0])) / w
    assert_close(solve(gamma=0.7).X[:, 0, 0], expected, rtol=1e-11)
    least = 1 / np.hypot(1, np.pi / 2)
    assert_close(solve().gamma, least, rtol=2e-6)
    assert_close(solve(tolerance=1e-10).gamma, least, rtol=1e-8)


GAMES = {
    "dare": lambda *game, **options: hinf_dare(*game, **options),
    "care": lambda *game, **options: hinf_care(*game, **options),
    "dre": lambda *game, **options: hinf_dre(*game, horizon=3, final=Q, **options),
}
SMOOTH = (
    np.array([[0.8, 0.3], [-0.2, 0.9]]),
    B,
    np.array([[0.3], [0.5]]),
    Q,
    R,
)


@pytest.mark.parametrize("name", ["dare", "care", "dre"])
def test_derivatives_at_a_level(name):
    """The second ones over a horizon alone: `test_second_order.py` has those of the
    stationary equations, which go by the same rule, and `test_finite_horizon.py` the
    derivatives of the flow of continuous time."""
    rng, solve = np.random.default_rng(0), GAMES[name]
    twice = name == "dre"
    direction = [rng.normal(size=M.shape) for M in (*SMOOTH, np.zeros(()))]

    def line(e, gamma):
        # All arguments move at once.
        moved = (M + e * D for M, D in zip((*SMOOTH, gamma), direction, strict=True))
        A, B, D, Q, R, gamma = moved
        solution = solve(A, B, D, (Q + Q.T) / 2, R, gamma=gamma, throw=False)
        parts = solution.X, solution.K, solution.L, solution.closed_loop
        good = solution.result == dlx.RESULTS.successful
        value = sum(jnp.sum(jnp.sin(part)) for part in parts)
        return jnp.where(good, value, 0.0), good

    @jax.jit
    @jax.vmap
    def derivatives(e, gamma):
        both = jax.value_and_grad(lambda e: line(e, gamma), has_aux=True)
        if not twice:
            (value, good), first = both(e)
            return good, value, first, first
        ((value, good), first), (_, second) = eqx.filter_jvp(both, (e,), (1.0,))
        return good, value, first, second

    h = 1e-6
    good, value, first, second = derivatives(
        np.array([-h, 0.0, h]), np.array([4.0, 4.0, 4.0])
    )
    assert np.all(good)
    # Concrete matrices are solved by NumPy.
    assert_close(value[1], line(0.0, 4.0)[0], rtol=1e-11)
    assert_close(first[1], (value[2] - value[0]) / (2 * h), rtol=1e-7)
    if twice:
        assert_close(second[1], (first[2] - first[0]) / (2 * h), rtol=1e-6)
    # One bad member harms no other.
    beside = derivatives(np.array([-h, 0.0, h]), np.array([4.0, 0.01, 4.0]))
    np.testing.assert_array_equal(beside[0], [True, False, True])
    for a, b in zip(beside[1:], (value, first, second), strict=True):
        assert_close(a[::2], b[::2], rtol=1e-12)
        assert a[1] == 0


def level_of(solve):
    """The least level and its gradient, compiled."""

    @jax.jit
    @jax.value_and_grad
    def level(A, B, D, Q):
        return solve(A, B, D, Q, R, throw=False).gamma

    def checked(A, B, D, Q, step=1e-5):
        """The level and its gradient, of which all entries are checked."""
        value, gradient = level(A, B, D, Q)
        numeric = np.zeros((2, 2))
        for i in np.ndindex(2, 2):
            move = np.zeros((2, 2))
            move[i] = step
            high, low = (level(A + s * move, B, D, Q)[0] for s in (1, -1))
            numeric[i] = (high - low) / (2 * step)
        assert_close(gradient, numeric, rtol=1e-6, atol=1e-6)
        return value, gradient, numeric

    return checked


def test_derivative_of_the_least_level_over_a_horizon():
    value, *_ = level_of(GAMES["dre"])(*SMOOTH[:4])
    assert_close(value, GAMES["dre"](*SMOOTH).gamma, rtol=1e-11)


def test_derivative_of_the_least_level():
    level = level_of(hinf_dare)
    # A saddle point that goes as the disturbance wins within a step, and one that goes
    # as two eigenvalues meet on the circle. The second state has no part in the latter.
    value, *_ = level(*SMOOTH[:4])
    assert_close(value, hinf_dare(*SMOOTH).gamma, rtol=1e-11)
    first = np.array([[1.0], [0.0]])
    problem = np.diag([0.9, 0.0]), 0.5 * first, 0.02 * first, first @ first.T
    _, gradient, numeric = level(*problem)
    assert_close(gradient[0, 0], numeric[0, 0], rtol=1e-6)
    # A disturbance without effect.
    value, gradient, _ = level(A, B, 0 * B, Q)
    assert value == 0
    assert_close(gradient, np.zeros((2, 2)))


def test_a_disturbance_without_effect():
    solution = hinf_dare(A, B, np.zeros((2, 2)), Q, R)
    assert solution.gamma == 0 and solution.result == dlx.RESULTS.successful
    assert_close(solution.K, dlx.riccati.dare(A, B, Q, R).K, rtol=1e-10)
    assert_close(solution.L, np.zeros((2, 2)))


@pytest.mark.parametrize("solve", [GAMES["dare"], GAMES["dre"]], ids=["dare", "dre"])
def test_the_least_level_has_first_derivatives_only(solve):
    level = lambda A: solve(A, *SMOOTH[1:], throw=False).gamma
    with pytest.raises(NotImplementedError, match="first derivatives only"):
        jax.jit(jax.hessian(level))(SMOOTH[0])


def test_single_precision():
    single = [jnp.asarray(M, jnp.float32) for M in (A, B, Q, Q, R)]
    solution = hinf_dare(*single)
    assert solution.X.dtype == solution.gamma.dtype == jnp.float32
    assert_close(solution.gamma, 2.95625198, rtol=1e-5)
    assert hinf_care(*single, gamma=4.0).residual < 1e-5


@pytest.mark.parametrize(
    "change, match",
    [
        ({"A": np.ones((2, 3))}, r"A must have shape \(2, 2\).*got \(2, 3\)"),
        ({"D": np.ones((3, 1))}, r"D must have shape \(2, 1\).*got \(3, 1\)"),
        ({"D": np.ones(2)}, r"D must be a matrix, got shape \(2,\)"),
        ({"Q": np.array([[1.0, 1.0], [0.0, 1.0]])}, "Q must be symmetric"),
        ({"R": np.eye(2)}, r"R must have shape \(1, 1\).*got \(2, 2\)"),
        ({"gamma": 0.0}, "gamma must be positive"),
        ({"gamma": np.ones(2)}, "gamma must be a number"),
        ({"tolerance": -1.0}, "tolerance must be positive"),
    ],
)
@pytest.mark.parametrize("solve", [hinf_dare, hinf_care], ids=["dare", "care"])
def test_wrong_arguments(solve, change, match):
    with user_error(match=match):
        solve(**({"A": A, "B": B, "D": None, "Q": Q, "R": R} | change))


def test_wrong_arguments_over_a_horizon():
    with user_error(match=r"hinf_dre: D must have shape \(2, 1\)"):
        hinf_dre(A, B, np.ones((3, 1)), Q, R, horizon=3)
    with user_error(match="hinf_dre: horizon must be given"):
        hinf_dre(A, B, None, Q, R)
    with user_error(match="hinf_cre: times must increase"):
        hinf_cre(A, B, None, Q, R, times=[1.0, 0.0])
    with user_error(match="hinf_cre: gamma must be positive"):
        hinf_cre(A, B, None, Q, R, times=[0.0, 1.0], gamma=-1.0)
    game = dict(A=A, B=B, D=None, Q=Q, R=R, times=[0.0, 1.0])
    for final, match in (
        (np.array([[1.0, 1.0], [0.0, 1.0]]), "final must be symmetric"),
        (np.eye(3), r"final must have shape \(2, 2\)"),
        (np.diag([1.0, -0.1]), "final must be positive semidefinite, got"),
    ):
        with user_error(match=f"hinf_cre: {match}"):
            hinf_cre(**game, final=final)
