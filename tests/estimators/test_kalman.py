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

import delucax as dlx


c = dlx.estimators
CLOSE = dict(rtol=tolerance(1e-4, 1e-10), atol=tolerance(1e-4, 1e-11))


def covariance(rng, n):
    root = rng.standard_normal((n, n))
    return root @ root.T / n + 0.1 * np.eye(n)


def problem(n, p, m=1, k=2, steps=None, T=8, seed=0):
    """Random dynamics with all their parts, a filter of them, and a record."""
    rng = np.random.default_rng(seed)
    lead = () if steps is None else (steps,)
    A = rng.standard_normal((*lead, n, n)) / np.sqrt(n)
    B, E = rng.standard_normal((*lead, n, m)), rng.standard_normal((*lead, n, k))
    points = [rng.standard_normal((*lead, size)) for size in (n, m, n)]
    C = rng.standard_normal((p, n))
    dynamics = dlx.LinearDynamics(A, B, C, E, 0.1, *points)
    kalman = c.KalmanFilter(
        dynamics,
        covariance(rng, k),
        covariance(rng, p),
        mean=rng.standard_normal(n),
        covariance=covariance(rng, n),
    )
    return kalman, rng.standard_normal((T, p)), rng.standard_normal((T, m))


def textbook(kalman, ys, us):
    """The filter as in every book, with inverses."""
    asarray = lambda a: np.asarray(a, np.float64)
    V, W, C = (asarray(M) for M in (kalman.V, kalman.W, kalman.dynamics.C))
    x, P = asarray(kalman.mean), asarray(kalman.covariance)
    found = {"predicted": [(x, P)], "updated": [], "densities": []}
    for k, (y, u) in enumerate(zip(ys, us, strict=True)):
        here = kalman.dynamics.at(0.1 * k)
        A, B, E, x_ref, u_ref, x_next = (
            asarray(M)
            for M in (here.A, here.B, here.E, here.x_ref, here.u_ref, here.x_next)
        )
        S = C @ P @ C.T + V
        r = y - C @ x
        L = P @ C.T @ np.linalg.inv(S)
        quadratic = r @ np.linalg.inv(S) @ r
        log_det = np.linalg.slogdet(2 * np.pi * S)[1]
        found["densities"].append(-0.5 * (quadratic + log_det))
        x, P = x + L @ r, P - L @ S @ L.T
        found["updated"].append((x, P))
        x = x_next + A @ (x - x_ref) + B @ (u - u_ref)
        P = A @ P @ A.T + E @ W @ E.T
        found["predicted"].append((x, P))
    return found


@pytest.mark.parametrize(
    "n, p, steps",
    [(7, 6, None), (3, 1, 8)],
)
def test_as_in_the_textbook(n, p, steps):
    kalman, ys, us = problem(n, p, steps=steps)
    filtered = c.run_filter(kalman, ys, us)
    expected = textbook(kalman, ys, us)
    assert_close(filtered.log_likelihoods, expected["densities"], **CLOSE)
    assert_close(filtered.log_likelihood, np.sum(expected["densities"]), **CLOSE)
    for name in ("predicted", "updated"):
        belief = getattr(filtered, name)
        means, covariances = zip(*expected[name], strict=True)
        assert_close(belief.mean, np.stack(means), **CLOSE)
        assert_close(belief.covariance, np.stack(covariances), **CLOSE)
        turned = jnp.swapaxes(belief.covariance, 1, 2)
        assert_close(belief.covariance, turned)
    assert filtered.result == dlx.RESULTS.successful


@needs_x64
def test_step_by_step():
    """By hand, the steps and the log-likelihood are those of a record."""
    kalman, ys, us = problem(3, 2)
    filtered = c.run_filter(kalman, ys, us, t0=0.3)
    belief, total = kalman.init(), 0.0
    update, predict = eqx.filter_jit(kalman.update), eqx.filter_jit(kalman.predict)
    likelihood = eqx.filter_jit(kalman.log_likelihood)
    for k, (y, u) in enumerate(zip(jnp.asarray(ys), jnp.asarray(us), strict=True)):
        t = jnp.asarray(0.3 + 0.1 * k)
        total = total + likelihood(t, y, belief)
        belief = predict(t, u, update(t, y, belief))
    assert_close(belief.mean, filtered.predicted.mean[-1], **CLOSE)
    assert_close(total, filtered.log_likelihood, **CLOSE)


def batch_solution(kalman, ys, us):
    """The states of a whole record given all of it, as one normal distribution."""
    d, T, n = kalman.dynamics, len(ys), kalman.mean.shape[0]
    A, B, C, E, W, V = (
        np.asarray(M, np.float64) for M in (d.A, d.B, d.C, d.E, kalman.W, kalman.V)
    )
    means, x = [], np.asarray(kalman.mean, np.float64)
    for u in us:
        means.append(x)
        x = np.asarray(d.x_next) + A @ (x - d.x_ref) + B @ (u - d.u_ref)
    # The states are linear in the first and in the noises.
    powers = [np.linalg.matrix_power(A, k) for k in range(T)]
    zero = np.zeros_like(A)
    F = np.block(
        [[powers[i - j] if i >= j else zero for j in range(T)] for i in range(T)]
    )
    first = np.asarray(kalman.covariance, np.float64)
    noise = scipy.linalg.block_diag(first, *[E @ W @ E.T] * (T - 1))
    P = F @ noise @ F.T
    H = np.kron(np.eye(T), C)
    S = H @ P @ H.T + np.kron(np.eye(T), V)
    r = np.ravel(ys) - H @ np.concatenate(means)
    L = P @ H.T @ np.linalg.inv(S)
    mean = np.concatenate(means) + L @ r
    after = P - L @ H @ P
    blocks = [after[i * n : (i + 1) * n, i * n : (i + 1) * n] for i in range(T)]
    log_det = np.linalg.slogdet(2 * np.pi * S)[1]
    density = -0.5 * (r @ np.linalg.solve(S, r) + log_det)
    return mean.reshape(T, n), np.stack(blocks), density


@needs_x64
@pytest.mark.parametrize("known_start", [False, True])
def test_smoother_solves_the_whole_record_at_once(known_start):
    kalman, ys, us = problem(3, 2, k=1, T=6)
    if known_start:  # with one noise, the first predictions are singular
        zero = jnp.zeros_like(kalman.covariance)
        kalman = eqx.tree_at(lambda k: k.covariance, kalman, zero)
    smoothed = c.smooth(kalman, ys, us)
    mean, covariance, density = batch_solution(kalman, ys, us)
    assert_close(smoothed.mean, mean, **CLOSE)
    assert_close(smoothed.covariance, covariance, **CLOSE)
    assert_close(smoothed.filtered.log_likelihood, density, **CLOSE)
    assert_close(smoothed.mean[-1], smoothed.filtered.updated.mean[-1])
    assert smoothed.result == dlx.RESULTS.successful


def test_smoother_of_many_states_with_one_noise():
    """The rounding of their singular covariances is not semidefinite."""
    kalman, ys, us = problem(12, 2, k=1)
    zero = jnp.zeros_like(kalman.covariance)
    kalman = eqx.tree_at(lambda k: k.covariance, kalman, zero)
    mean, covariance, _ = batch_solution(kalman, ys, us)
    smoothed = c.smooth(kalman, ys, us)
    assert_close(smoothed.mean, mean, atol=tolerance(1e-4, 1e-11))
    assert_close(smoothed.covariance, covariance, atol=tolerance(1e-2, 1e-9))


@needs_x64
def test_steady_state():
    transient, ys, us = problem(3, 2, k=3, T=60)
    dynamics, W, V = transient.dynamics, transient.W, transient.V
    steady = c.KalmanFilter(dynamics, W, V, mean=transient.mean, steady_state=True)
    A, C, E = (np.asarray(M, np.float64) for M in (dynamics.A, dynamics.C, dynamics.E))
    noise = E @ np.asarray(W, np.float64) @ E.T
    Sigma = scipy.linalg.solve_discrete_are(A.T, C.T, noise, np.float64(V))
    assert_close(steady.covariance, Sigma, **CLOSE)
    L = Sigma @ C.T @ np.linalg.inv(C @ Sigma @ C.T + np.float64(V))
    assert_close(steady.L, L, **CLOSE)
    assert_close(steady.updated_covariance, Sigma - L @ C @ Sigma, **CLOSE)
    constant, settled = (c.run_filter(k, ys, us) for k in (steady, transient))
    assert_close(constant.predicted.covariance[-1], steady.covariance)
    assert_close(constant.updated.covariance[0], steady.updated_covariance)
    for name in ("predicted", "updated"):
        a, b = getattr(constant, name), getattr(settled, name)
        assert_close(a.mean[-1], b.mean[-1], **CLOSE)
        assert_close(a.covariance[-1], b.covariance[-1], **CLOSE)
    last = slice(-1, None)
    densities = constant.log_likelihoods[last], settled.log_likelihoods[last]
    assert_close(*densities, **CLOSE)


@needs_x64
def test_steady_smoother_is_that_of_the_stationary_start():
    transient, ys, us = problem(3, 2, k=1, T=6)
    dynamics, W, V = transient.dynamics, transient.W, transient.V
    steady = c.KalmanFilter(dynamics, W, V, steady_state=True)
    same = c.KalmanFilter(dynamics, W, V, covariance=steady.covariance)
    a, b = c.smooth(steady, ys, us), c.smooth(same, ys, us)
    assert_close(a.mean, b.mean, **CLOSE)
    assert_close(a.covariance, b.covariance, **CLOSE)


A = jnp.array([[1.0, 0.1], [-0.2, 0.95]])
B = jnp.array([[0.0], [0.1]])
C = jnp.array([[1.0, 0.0]])
W, V = 0.01 * jnp.eye(2), 0.1 * jnp.eye(1)
YS = jnp.sin(jnp.arange(8.0))[:, None]


@needs_x64
def test_operating_point():
    """About another point, and with another reading there, only the origin moves."""
    x_ref, u_ref, y_ref = jnp.array([2.0, -1.0]), jnp.array([0.7]), jnp.array([5.0])
    plain = c.KalmanFilter(dlx.LinearDynamics(A, B, C), W, V)
    moved = dlx.LinearDynamics(A, B, C, x_ref=x_ref, u_ref=u_ref)
    us = jnp.cos(jnp.arange(8.0))[:, None]
    a = c.smooth(plain, YS, us)
    for options, offset in (({"y_ref": y_ref}, y_ref), ({}, C @ x_ref)):
        about = c.KalmanFilter(moved, W, V, **options)
        b = c.smooth(about, YS + offset, us + u_ref)
        assert_close(b.mean, a.mean + x_ref, **CLOSE)
        assert_close(b.covariance, a.covariance, **CLOSE)


@needs_x64
def test_linearised_sensor():
    """What a sensor reads at the operating point is given, where it is not C x_ref."""
    system = dlx.system(
        lambda t, x, u, w: jnp.stack([x[1], u[0]]),
        states=("angle", "velocity"),
        controls=("torque",),
    )
    dynamics = dlx.linearize(dlx.Discretized(system, 0.1), 0.0, jnp.ones(2), [0.0])
    dynamics = eqx.tree_at(lambda d: d.C, dynamics, -jnp.sin(1.0) * C)
    kalman = c.KalmanFilter(dynamics, W, V, y_ref=[np.cos(1.0)])
    update = eqx.filter_jit(kalman.update)
    belief = update(0.0, jnp.array([np.cos(1.0)]), kalman.init())
    assert_close(belief.mean, np.ones(2), atol=1e-14)


@needs_x64
def test_angles_wrap():
    turn = jnp.array([2 * np.pi, 0.0])
    difference = dlx.systems.Pendulum().difference
    dynamics = dlx.LinearDynamics(A, B)
    wrapped = c.KalmanFilter(
        dynamics, W, 0.1 * jnp.eye(2), observation_difference=difference
    )
    y = jnp.array([0.3, 0.1])
    update = eqx.filter_jit(wrapped.update)
    here, turned = (update(0.0, y, wrapped.init()) for y in (y, y + turn))
    assert_close(turned.mean, here.mean, atol=1e-13)
    assert here.mean[0] > 0.2


def noisy(log_levels, stiffness):
    """A filter of an oscillator whose constants are all unknown."""
    dynamics = dlx.LinearDynamics(A.at[1, 0].set(-0.2 * stiffness), B, C, dt=0.2)
    q, r = jnp.exp(log_levels)
    return c.KalmanFilter(dynamics, q * jnp.eye(2), r * jnp.eye(1))


@needs_x64
def test_gradient_of_the_likelihood():
    def slopes(z):
        likelihood = lambda z: c.run_filter(noisy(z[:2], z[2]), YS).log_likelihood
        both = jax.value_and_grad(likelihood)(z)
        return both, both

    both = jax.jit(jax.jacfwd(slopes, has_aux=True))
    z = jnp.array([-2.0, -1.0, 1.5])
    (forward, hessian), (_, reverse) = both(z)
    numeric = central_difference(lambda z: both(z)[1][0], z)
    rows = [central_difference(lambda z, i=i: both(z)[1][1][i], z) for i in range(3)]
    assert_close(reverse, numeric, rtol=1e-6)
    assert_close(forward, reverse, rtol=1e-10)
    assert_close(hessian, rows, rtol=1e-6, atol=1e-7)


@needs_x64
def test_batch_and_its_bad_member():
    """A member that fails says so, and harms neither the others nor the gradient, which
    is a central difference."""
    ys = jnp.stack([YS, 2 * YS, YS])
    dynamics = dlx.LinearDynamics(A, B, C)

    def run(noise, y):
        kalman = c.KalmanFilter(dynamics, W, noise * jnp.eye(1))
        return c.smooth(kalman, y, throw=False)

    def total(noises, scale):
        found = jax.vmap(run)(noises, scale * ys)
        good = found.result == dlx.RESULTS.successful
        good &= jnp.array([True, True, False])
        likelihoods = jnp.where(good, found.filtered.log_likelihood, 0)
        energy = jnp.where(good[:, None, None], found.mean, 0) ** 2
        spread = jnp.where(good[:, None, None, None], found.covariance, 0) ** 2
        return jnp.sum(likelihoods) + jnp.sum(energy) + jnp.sum(spread), found

    noises = jnp.array([0.1, 0.3, -5.0])
    value = jax.jit(jax.value_and_grad(total, argnums=(0, 1), has_aux=True))
    (amount, found), gradients = value(noises, 1.0)
    assert (found.result == dlx.RESULTS.ill_posed)[2]
    assert np.all(np.isnan(found.mean[2]))
    (same, alone), expected = value(jnp.abs(noises), 1.0)
    assert_close(amount, same, **CLOSE)
    assert jnp.all(alone.result == dlx.RESULTS.successful)
    assert_close(found.mean[:2], alone.mean[:2], **CLOSE)
    assert_close(gradients[0], expected[0], **CLOSE)
    assert_close(gradients[1], expected[1], **CLOSE)
    fine = np.abs(noises)
    slopes = [
        central_difference(lambda z: value(z, 1.0)[0][0], fine),
        central_difference(lambda z: value(fine, z)[0][0], 1.0),
    ]
    for found, slope in zip(expected, slopes, strict=True):
        assert_close(found, slope, rtol=1e-6, atol=1e-7)


@needs_x64
def test_covariance_stays_semidefinite():
    """A precise sensor of a large uncertainty cancels nearly all of it."""
    dynamics = dlx.LinearDynamics(A, B, C)
    tiny = 1e-14
    kalman = c.KalmanFilter(
        dynamics, 0 * W, tiny * jnp.eye(1), covariance=1e3 * jnp.eye(2)
    )
    run = c.smooth(kalman, jnp.zeros((100, 1)))
    for covariances in (run.covariance, run.filtered.updated.covariance):
        eigenvalues = np.linalg.eigvalsh(np.asarray(covariances, np.float64))
        scale = np.max(eigenvalues, axis=1)
        eps = jnp.finfo(covariances.dtype).eps
        assert np.all(eigenvalues[:, 0] >= -4 * eps * scale)


@needs_x64
def test_precision_and_file(tmp_path):
    dtype = jnp.float32
    dynamics = dlx.LinearDynamics(A.astype(dtype), B.astype(dtype), C.astype(dtype))
    noise = W.astype(dtype), V.astype(dtype)
    kalman = c.KalmanFilter(dynamics, *noise, steady_state=True)
    found = c.smooth(kalman, YS.astype(dtype))
    assert found.mean.dtype == found.filtered.log_likelihoods.dtype == dtype
    dlx.save(tmp_path / "kalman.dlx", kalman)
    loaded = dlx.load(tmp_path / "kalman.dlx")
    assert jax.tree.structure(loaded) == jax.tree.structure(kalman)
    again = c.smooth(loaded, YS.astype(dtype))
    np.testing.assert_array_equal(again.mean, found.mean)


@needs_x64
def test_failures():
    dynamics = dlx.LinearDynamics(A, B, C)
    blind = c.KalmanFilter(dynamics, W, 0 * V, covariance=jnp.zeros((2, 2)))
    with pytest.raises(RuntimeError, match="run_filter.*well posed.*observation 0"):
        c.run_filter(blind, YS)
    found = c.run_filter(blind, YS, throw=False)
    assert found.result == dlx.RESULTS.ill_posed
    # Where nothing varies there is nothing to correct, and no NaN.
    assert_close(found.updated.mean[0], np.zeros(2))
    short = dlx.LinearDynamics(jnp.stack([A] * 4), B, C)
    short = c.KalmanFilter(short, W, V)
    with pytest.raises(RuntimeError, match="smooth: The states.*At observation 4"):
        c.smooth(short, YS)
    found = c.smooth(short, YS, throw=False).filtered
    assert found.result == dlx.RESULTS.diverged
    np.testing.assert_array_equal(np.isnan(found.updated.mean[:, 0]), [0] * 4 + [1] * 4)
    with pytest.raises(eqx.EquinoxRuntimeError, match="not finite"):
        eqx.filter_jit(c.run_filter)(blind, YS)
    unseen = dlx.LinearDynamics(2 * jnp.eye(2), B, C)
    with pytest.raises(RuntimeError, match="KalmanFilter: there is no steady state"):
        c.KalmanFilter(unseen, W, V, steady_state=True)


BAD = [
    (
        {"dynamics": dlx.systems.Pendulum()},
        "dynamics must be a Linear.*Pendulum",
    ),
    ({"W": jnp.eye(3)}, r"W must have shape \(2, 2\), .*disturbance, got \(3, 3\)"),
    ({"W": jnp.ones(2)}, r"W must be a matrix, got shape \(2,\)"),
    ({"W": jnp.diag(jnp.array([1.0, -1.0]))}, "W must be positive semidefinite"),
    ({"W": jnp.array([[1.0, 0.5], [0.0, 1.0]])}, "W must be symmetric"),
    ({"W": jnp.full((2, 2), jnp.nan)}, "W must be finite"),
    ({"V": jnp.eye(2)}, r"V must have shape \(1, 1\), .*observation, got \(2, 2\)"),
    ({"V": -jnp.eye(1)}, "V must be positive semidefinite"),
    ({"V": jnp.full((1, 1), jnp.inf)}, "V must be finite"),
    ({"mean": jnp.zeros(3)}, r"mean must have shape \(2,\), got shape \(3,\)"),
    ({"mean": jnp.full(2, jnp.nan)}, "mean must be finite"),
    ({"covariance": jnp.eye(1)}, r"covariance must have shape \(2, 2\)"),
    ({"covariance": -jnp.eye(2)}, "covariance must be positive semidefinite"),
    ({"steady_state": "yes"}, "steady_state must be True or False"),
    (
        {"covariance": jnp.eye(2), "steady_state": True},
        "covariance must not be given with steady_state",
    ),
    (
        {"dynamics": dlx.LinearDynamics(jnp.stack([A, A]), B, C), "steady_state": True},
        "dynamics with steady_state must be time-invariant, got matrices at 2 times",
    ),
    ({"y_ref": jnp.zeros(2)}, r"y_ref must have shape \(1,\)"),
    ({"y_ref": jnp.full(1, jnp.nan)}, "y_ref must be finite"),
]


@needs_x64
@pytest.mark.parametrize("arguments, message", BAD)
def test_wrong_arguments(arguments, message):
    given = {"dynamics": dlx.LinearDynamics(A, B, C), "W": W, "V": V} | arguments
    with user_error(match="KalmanFilter: " + message):
        c.KalmanFilter(**given)


@needs_x64
def test_wrong_records():
    kalman = c.KalmanFilter(dlx.LinearDynamics(A, B, C), W, V)
    for run in (c.run_filter, c.smooth):
        name = run.__name__
        with user_error(match=f"{name}: estimator.*: a KalmanFilter.*got LinearD"):
            run(kalman.dynamics, YS)
        with user_error(
            match=rf"{name}: observations must have shape \(steps, 1\).*\(8,\)"
        ):
            run(kalman, YS[:, 0])
        with user_error(match=r"observations must have at least one step"):
            run(kalman, YS[:0])
        with user_error(match="observations must be finite"):
            run(kalman, YS.at[3].set(jnp.nan))
        with user_error(
            match=r"controls must have shape \(8, 1\), .*got shape \(8, 2\)"
        ):
            run(kalman, YS, jnp.zeros((8, 2)))
        with user_error(match="controls must be finite"):
            run(kalman, YS, jnp.full((8, 1), jnp.inf))
        with user_error(match=r"t0 must be a number, got shape \(2,\)"):
            run(kalman, YS, t0=jnp.zeros(2))
    with user_error(match="KalmanFilter: the observation must have size 1, got size 2"):
        kalman.update(0.0, jnp.zeros(2), kalman.init())
    with user_error(match=r"KalmanFilter: u must have shape \(1,\).*got \(3,\)"):
        kalman.predict(0.0, jnp.zeros(3), kalman.init())
