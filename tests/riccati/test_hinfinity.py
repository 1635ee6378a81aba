import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg
from helpers import (
    assert_close,
    central_difference,
    needs_x64,
    tolerance,
    user_error,
)
from jax.test_util import check_grads

import delucax as dlx


pytestmark = needs_x64


A = jnp.array([[1.0, 1.0], [0.0, 1.0]])
B = jnp.array([[0.0], [1.0]])
Q, R = jnp.eye(2), jnp.eye(1)
hinf_dare, hinf_care = dlx.riccati.hinf_dare, dlx.riccati.hinf_care
hinf_dre, hinf_cre = dlx.riccati.hinf_dre, dlx.riccati.hinf_cre


def random_game(seed, n=3, m=1, k=2):
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
    solution = hinf_dare(A, B, jnp.eye(2), Q, R)
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


@needs_x64
def test_value_iteration():
    game = random_game(1)
    A, B, D, Q, R = game
    gamma = 1.2 * float(hinf_dare(*game).gamma)
    solution = hinf_dare(*game, gamma=gamma)
    G = B @ B.T - D @ D.T / gamma**2
    M = np.zeros((3, 3))
    for _ in range(500):
        moved = np.linalg.solve(np.eye(3) + G @ M, A)
        M = Q + A.T @ M @ moved
    moved = np.linalg.solve(np.eye(3) + G @ M, A)
    assert_close(solution.X, M, rtol=1e-9, atol=1e-9)
    assert_close(solution.K, B.T @ M @ moved, atol=1e-9)
    assert_close(solution.L, D.T @ M @ moved / gamma**2, atol=1e-9)
    assert_close(solution.closed_loop, A - B @ np.asarray(solution.K), atol=1e-12)
    radius = np.max(np.abs(np.linalg.eigvals(solution.closed_loop)))
    assert_close(solution.spectral_radius, radius, rtol=1e-7)
    assert solution.residual < 1e-13


@needs_x64
def test_least_level_is_the_norm_of_the_loop():
    for seed in range(6):
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


@needs_x64
def test_continuous_game():
    for seed in range(4):
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
        with pytest.raises(eqx.EquinoxRuntimeError):
            eqx.filter_jit(solve)(A, B, None, Q, R, gamma=jnp.asarray(0.5))
        stuck = jnp.diag(jnp.array([unstable, -0.5]))
        lost = solve(stuck, B, None, Q, R, throw=False)
        assert lost.result == dlx.RESULTS.not_stabilising


def test_a_disturbance_without_effect():
    solution = hinf_dare(A, B, jnp.zeros((2, 1)), Q, R)
    assert solution.gamma == 0 and solution.result == dlx.RESULTS.successful
    close = tolerance(1e-4, 1e-10)
    assert_close(solution.K, dlx.riccati.dare(A, B, Q, R).K, rtol=close)
    assert_close(solution.L, np.zeros((1, 2)))
    gradient = jax.grad(lambda A: hinf_dare(A, B, jnp.zeros((2, 1)), Q, R).gamma)(A)
    assert_close(gradient, np.zeros((2, 2)))


def finite_game(seed, T=6):
    games = [random_game(seed + i) for i in range(T)]
    return [np.stack(parts) for parts in zip(*games, strict=True)]


@needs_x64
def test_finite_horizon_game():
    A, B, D, Q, R = finite_game(2)
    final = np.eye(3)
    solution = hinf_dre(A, B, D, Q, R, final=final)
    gamma = float(solution.gamma)
    # The worst ratio of cost to disturbance of the loop, as one matrix.
    outputs, forced = [], np.zeros((3, 12))
    for t in range(6):
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
    for t in reversed(range(6)):
        G = B[t] @ B[t].T - D[t] @ D[t].T / gamma**2
        moved = np.linalg.solve(np.eye(3) + G @ M, A[t])
        assert_close(above.K[t], B[t].T @ M @ moved, atol=1e-10)
        assert_close(above.L[t], D[t].T @ M @ moved / gamma**2, atol=1e-10)
        M = Q[t] + A[t].T @ M @ moved
        assert_close(above.X[t], M, atol=1e-10 * np.max(np.abs(M)))
    low = hinf_dre(A, B, D, Q, R, final=final, gamma=0.7 * gamma, throw=False)
    assert low.result == dlx.RESULTS.infeasible and np.all(np.isnan(low.X[0]))


def test_long_horizons_are_stationary():
    long = hinf_dre(A, B, None, Q, R, horizon=60, final=Q)
    stationary = hinf_dare(A, B, None, Q, R)
    assert_close(long.gamma, stationary.gamma, rtol=tolerance(1e-4, 1e-11))
    assert_close(long.K[0], stationary.K, rtol=tolerance(1e-2, 1e-9))
    X = hinf_cre(A, B, None, Q, R, gamma=4.0, times=[0.0, 1.0, 50.0]).X
    stationary = hinf_care(A, B, None, Q, R, gamma=4.0)
    assert_close(X[0], stationary.X, rtol=tolerance(1e-3, 1e-9))
    low = hinf_cre(A, B, None, Q, R, gamma=2.0, times=[0.0, 50.0], throw=False)
    assert low.result == dlx.RESULTS.infeasible and np.all(np.isnan(low.X[0]))


@needs_x64
def test_continuous_horizon_in_closed_form():
    # dX/ds = 1 - (1 - gamma^-2) X^2 with gamma below 1 is tan(w s) / w, to its pole.
    one = jnp.ones((1, 1))
    solve = lambda **options: hinf_cre(
        0 * one, one, one, one, one, times=jnp.array([0.0, 0.5, 1.0]), **options
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
    "cre": lambda *game, **options: hinf_cre(*game, times=[0.0, 1.0], **options),
}
SMOOTH = (
    jnp.array([[0.8, 0.3], [-0.2, 0.9]]),
    B,
    jnp.array([[0.3], [0.5]]),
    Q,
    R,
    jnp.asarray(4.0),
)


@needs_x64
@pytest.mark.parametrize("solve", GAMES.values(), ids=GAMES)
def test_derivatives_at_a_level(solve):
    rng = np.random.default_rng(0)
    direction = [jnp.asarray(rng.normal(size=M.shape)) for M in SMOOTH]

    def line(e):
        moved = (M + e * D for M, D in zip(SMOOTH, direction, strict=True))
        A, B, D, Q, R, gamma = moved
        solution = solve(A, B, D, (Q + Q.T) / 2, R, gamma=gamma, throw=False)
        parts = solution.X, solution.K, solution.L, solution.closed_loop
        return sum(jnp.sum(jnp.sin(part)) for part in parts)

    value, first, h = jax.jit(line), jax.jit(jax.grad(line)), 1e-6
    assert_close(first(0.0), (value(h) - value(-h)) / (2 * h), rtol=1e-7)
    second = (first(h) - first(-h)) / (2 * h)
    assert_close(jax.jit(jax.jacfwd(jax.jacrev(line)))(0.0), second, rtol=1e-6)


@needs_x64
def test_gradients_of_every_argument():
    def facts(A, B, D, Q, R, gamma):
        options = dict(gamma=gamma, throw=False)
        solution = hinf_dare(A, B, D, (Q + Q.T) / 2, R, **options)
        return jnp.sum(jnp.sin(solution.K)) + jnp.sum(jnp.sin(solution.L))

    check_grads(jax.jit(facts), SMOOTH, 1, modes=("rev",), rtol=1e-7, eps=1e-5)


# A saddle point that goes as two eigenvalues meet on the circle, and one that goes as
# the disturbance wins within a step.
MEETING = (jnp.array([[0.9]]), jnp.array([[0.5]]), jnp.array([[0.02]]), R, R)


@needs_x64
@pytest.mark.parametrize("solve", [GAMES["dare"], GAMES["dre"]], ids=["dare", "dre"])
def test_derivative_of_the_least_level(solve):
    level = jax.jit(lambda A: solve(A, *SMOOTH[1:5], throw=False).gamma)
    exact = jax.grad(level)(SMOOTH[0])
    numeric = central_difference(level, SMOOTH[0], 1e-5)
    assert_close(exact, numeric, rtol=1e-6, atol=1e-6)
    tangent = jax.jvp(level, (SMOOTH[0],), (jnp.ones((2, 2)),))[1]
    assert_close(tangent, jnp.sum(exact), rtol=1e-9)
    with pytest.raises(NotImplementedError, match="first derivatives only"):
        jax.hessian(level)(SMOOTH[0])


@needs_x64
def test_derivative_where_eigenvalues_meet():
    level = jax.jit(lambda A: hinf_dare(A, *MEETING[1:], throw=False).gamma)
    numeric = central_difference(level, MEETING[0], 1e-5)
    assert_close(jax.grad(level)(MEETING[0]), numeric, rtol=1e-6)


@needs_x64
@pytest.mark.parametrize("solve", GAMES.values(), ids=GAMES)
def test_one_bad_member_harms_no_other(solve):
    def total(gamma, A):
        solution = solve(A, *SMOOTH[1:5], gamma=gamma, throw=False)
        good = solution.result == dlx.RESULTS.successful
        return jnp.where(good, jnp.sum(solution.X) + jnp.sum(solution.K), 0.0), good

    both = jax.value_and_grad(total, argnums=(0, 1), has_aux=True)
    levels = jnp.array([4.0, 0.01, 5.0])
    (_, good), gradients = jax.jit(jax.vmap(both, (0, None)))(levels, SMOOTH[0])
    np.testing.assert_array_equal(good, [True, False, True])
    _, alone = both(levels[2], SMOOTH[0])
    for gradient, expected in zip(gradients, alone, strict=True):
        assert_close(gradient[2], expected, rtol=1e-9)
        assert_close(gradient[1], np.zeros(expected.shape))


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
