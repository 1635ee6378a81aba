"""Moving-horizon estimation against the Kalman filter, and against SciPy."""

from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.optimize
from helpers import assert_close, in_both_modes, needs_x64
from jax import Array
from jax.flatten_util import ravel_pytree

import delucax as dlx


c = dlx.estimators
SUCCESS = dlx.RESULTS.successful


class Reactor(dlx.AbstractSystem):
    """2 A -> B in the gas phase, of which the pressure is seen."""

    state_names: ClassVar = ("A", "B")
    control_names: ClassVar = ()
    k: Array = dlx.parameter(0.16)

    def vector_field(self, t, x, u, w):
        rate = self.k * x[0] ** 2
        return jnp.stack([-2 * rate, rate])

    def observe(self, t, x):
        return jnp.sum(x, keepdims=True)


REACTOR = dlx.Discretized(Reactor(), dt=0.1)
NOISE = 1e-6 * np.eye(2), 1e-2 * np.eye(1)
GUESS = dict(mean=[0.1, 4.5], covariance=36 * np.eye(2))


def reacting(steps, seed=0):
    """The states and the observations from (3, 1)."""
    rng = np.random.default_rng(seed)
    x, states, ys = np.array([3.0, 1.0]), [], []
    for _ in range(steps):
        states.append(x)
        ys.append([x.sum() + 0.1 * rng.normal()])
        # The exact step.
        A = x[0] / (1 + 2 * 0.16 * x[0] * 0.1)
        x = np.array([A, x[1] + (x[0] - A) / 2]) + 1e-3 * rng.normal(size=2)
    return np.array(states), np.array(ys)


def linear_case(seed, rank):
    """Random dynamics with covariances of a rank, and a record of them."""
    n, k, p, T = 4, 3, 2, 30
    rng = np.random.default_rng(seed)
    A = rng.normal(size=(n, n))
    A /= 1.05 * np.max(np.abs(np.linalg.eigvals(A)))
    B, C, E = (rng.normal(size=shape) for shape in ((n, 1), (p, n), (n, k)))
    sizes = (k, 2 * rank), (p, rank), (n, 2 * rank)
    roots = [rng.normal(size=(size, min(size, most))) for size, most in sizes]
    draw = lambda root: root @ rng.normal(size=root.shape[1])
    x, us, ys = draw(roots[2]), rng.normal(size=(T, 1)), []
    for u in us:
        ys.append(C @ x + draw(roots[1]))
        x = A @ x + B @ u + E @ draw(roots[0])
    W, V, P = (root @ root.T for root in roots)
    return dlx.LinearDynamics(A, B, C, E), (W, V), P, np.array(ys), us


@needs_x64
@pytest.mark.parametrize("window", [1, 2, 5, 20])
def test_is_the_kalman_filter_of_linear_dynamics(window):
    """With definite and with singular covariances, for which one program serves, and
    between bounds that are far."""
    for rank in (2, 1):
        dynamics, noise, P, ys, us = linear_case(0, rank)
        options = dict(mean=np.zeros(4), covariance=P)
        kalman = c.KalmanFilter(dynamics, *noise, **options)
        expected = c.run_filter(kalman, ys, us, throw=False)
        far = (-1e3, 1e3)
        if window == 5:
            options |= dict(bounds=far, disturbance_bounds=far)
        mhe = c.MHE(dynamics, *noise, window, **options)
        found = c.run_estimator(mhe, ys, us)
        for name in ("updated", "predicted"):
            a, b = getattr(found, name), getattr(expected, name)
            assert_close(a.mean, b.mean, atol=1e-9)
            assert_close(a.covariance, b.covariance, atol=1e-9)


@needs_x64
def test_a_step_without_an_observation():
    dynamics, noise, P, ys, us = linear_case(0, 2)
    seen = np.isin(np.arange(len(ys)), (2, 3, 8), invert=True)

    def run(estimator):
        def step(state, inputs):
            y, u, is_seen = inputs
            after = estimator.update(0.0, y, state)
            after = jax.tree.map(lambda a, b: jnp.where(is_seen, a, b), after, state)
            return estimator.predict(0.0, u, after), estimator.estimate(after)

        return jax.lax.scan(step, estimator.init(), (ys, us, seen))[1]

    mhe = c.MHE(dynamics, *noise, 3, covariance=P)
    ekf = c.ExtendedKalmanFilter(dynamics, *noise, covariance=P)
    found, expected = jax.jit(lambda: (run(mhe), run(ekf)))()
    assert_close(found.mean, expected.mean, atol=1e-12)
    assert_close(found.covariance, expected.covariance, atol=1e-12)


@needs_x64
def test_the_trajectory_is_that_of_the_smoother():
    """Once the window has the whole record; before, its first stages are not there."""
    T = 12
    dynamics, noise, P, ys, us = linear_case(0, 2)
    mhe = c.MHE(dynamics, *noise, T, covariance=P)
    found = c.run_estimator(mhe, ys[:T], us[:T])
    x, w = jax.jit(jax.vmap(mhe.trajectory))(found.states)
    kalman = c.KalmanFilter(dynamics, *noise, mean=np.zeros(4), covariance=P)
    assert_close(x[-1], c.smooth(kalman, ys[:T], us[:T]).mean, atol=1e-9)
    step = x[-1, :-1] @ dynamics.A.T + us[: T - 1] @ dynamics.B.T + w[-1] @ dynamics.E.T
    assert_close(x[-1, 1:], step, atol=1e-9)
    assert np.isnan(x[4, : T - 5]).all() and np.isnan(w[4, : T - 5]).all()
    assert_close(x[4, T - 5 :], c.smooth(kalman, ys[:5], us[:5]).mean, atol=1e-9)
    assert np.isfinite(w[4, T - 5 :]).all()


@needs_x64
def test_many_sensors():
    """More than are written out, with noise that is correlated."""
    p, rng = 14, np.random.default_rng(0)
    dynamics = dlx.LinearDynamics(
        [[0.9, 0.2], [0.0, 0.8]], [[0.0], [1.0]], rng.normal(size=(p, 2))
    )
    root = rng.normal(size=(p, p))
    noise, ys = (0.1 * np.eye(2), root @ root.T), rng.normal(size=(6, p))
    found = c.run_estimator(c.MHE(dynamics, *noise, 3), ys).updated
    expected = c.run_filter(c.KalmanFilter(dynamics, *noise), ys).updated
    assert_close(found.mean, expected.mean, atol=1e-9)
    assert_close(found.covariance, expected.covariance, atol=1e-9)


@needs_x64
def test_the_extended_filter_fails_and_this_does_not():
    """From a poor guess of the gas-phase reactor (Haseltine and Rawlings, 2005)."""
    states, ys = reacting(100)
    ekf = c.run_filter(c.ExtendedKalmanFilter(REACTOR, *NOISE, **GUESS), ys)
    assert np.min(ekf.updated.mean) < -1
    assert np.max(np.abs(ekf.updated.mean[-1] - states[-1])) > 1
    mhe = c.MHE(REACTOR, *NOISE, 20, bounds=(0.0, jnp.inf), **GUESS)
    found = c.run_estimator(mhe, ys)
    assert np.min(found.updated.mean) >= 0 and np.min(found.predicted.mean) >= 0
    off = np.max(np.abs(found.updated.mean - states), axis=1)
    assert off[0] > 1 and np.max(off[30:]) < 0.1


@needs_x64
def test_a_nonlinear_window_between_bounds():
    """The whole record at once, by SciPy over the states."""
    T, low, high = 8, [0.0, 0.0], [3.05, 1.15]
    _, ys = reacting(T, seed=3)
    guess = dict(mean=np.array([3.0, 1.0]), covariance=np.diag([0.2, 0.5]))
    W = np.diag([1e-3, 2e-3])
    options = dict(bounds=(low, high), iterations=8) | guess
    mhe = c.MHE(REACTOR, W, NOISE[1], T, **options)
    found = c.run_estimator(mhe, ys)
    last = jax.tree.map(lambda a: a[-1], found.states)
    assert np.sum(last.sides != 0) == 5
    scales = np.sqrt(np.diag(W)), np.sqrt(np.diag(guess["covariance"]))
    step = jax.jit(jax.vmap(lambda x: REACTOR(0.0, x, jnp.zeros(0))))

    @jax.jit
    def residuals(flat):
        x = flat.reshape(T, 2)
        parts = (
            (x[0] - guess["mean"]) / scales[1],
            jnp.ravel((x[1:] - step(x[:-1])) / scales[0]),
            (jnp.sum(x, axis=1) - ys[:, 0]) / 0.1,
        )
        return jnp.concatenate(parts)

    ends = np.tile(low, T), np.tile(high, T)
    given = residuals, np.tile([2.0, 1.1], T), jax.jit(jax.jacfwd(residuals)), ends
    tolerances = dict(xtol=1e-15, ftol=1e-15, gtol=1e-13, max_nfev=2000)
    best = scipy.optimize.least_squares(*given, **tolerances)
    assert_close(last.x, best.x.reshape(T, 2), atol=1e-5)
    cost = lambda x: np.sum(np.asarray(residuals(np.ravel(x))) ** 2) / 2
    assert cost(last.x) <= best.cost + 1e-9


@needs_x64
def test_a_search_where_a_full_step_fails():
    """From a guess at which the sensor is nearly flat, a full step goes far."""

    class Flat(dlx.AbstractSystem):
        state_names: ClassVar = ("x",)
        control_names: ClassVar = ()

        def vector_field(self, t, x, u, w):
            return 0 * x

        def observe(self, t, x):
            return jnp.arctan(x)

    still = dlx.Discretized(Flat(), dt=0.1)
    weights = 1e-4 * np.eye(1), 1e-4 * np.eye(1)
    options = dict(mean=[4.0], covariance=100 * np.eye(1))
    ys = np.full((3, 1), np.arctan(-1.0))
    searched = c.MHE(still, *weights, 3, iterations=20, **options)
    found = c.run_estimator(searched, ys, throw=False)
    assert_close(found.updated.mean[-1], [-1.0], atol=0.05)
    assert np.asarray(found.results == SUCCESS)[2]
    single = c.MHE(still, *weights, 3, **options)
    lost = c.run_estimator(single, ys, throw=False)
    assert np.abs(lost.updated.mean[0, 0] + 1) > 10


def swinging(length):
    return dlx.Discretized(dlx.systems.Pendulum(length=length), dt=0.05)


@needs_x64
def test_a_parameter_that_drifts_is_followed():
    rng = np.random.default_rng(0)
    T = 240
    lengths = 1.0 + 0.3 * np.sin(2 * np.pi * np.arange(T) / T)
    us = 4 * np.sin(0.4 * np.arange(T))[:, None]

    @jax.jit
    def swung(lengths, us):
        def step(x, inputs):
            length, u = inputs
            return swinging(length)(0.0, x, u), x

        return jax.lax.scan(step, jnp.array([0.5, 0.0]), (lengths, us))[1]

    states = np.asarray(swung(lengths, us))
    ys = states + 0.01 * rng.normal(size=states.shape)
    walk = {"system.length": c.RandomWalk(0.04, step=1e-4)}
    weights = 1e-8 * np.eye(2), 1e-4 * np.eye(2)
    options = dict(covariance=0.1 * np.eye(2), parameters=walk)
    mhe = c.MHE(swinging(1.2), *weights, 15, **options)
    found = c.run_estimator(mhe, ys, us)
    beliefs = jax.vmap(mhe.estimated_parameters)(found.states)["system.length"]
    off = np.abs(beliefs.mean[:, 0] - lengths)
    assert off[0] > 0.1 and np.max(off[60:]) < 0.1 and np.mean(off[60:]) < 0.03
    assert found.updated.mean.shape == (T, 2)
    assert np.all(beliefs.covariance[60:] < 0.01)
    constant = eqx.tree_at(
        lambda m: m.parameters["system.length"].step, mhe, jnp.zeros(())
    )
    found = c.run_estimator(constant, ys, us)
    fixed = jax.vmap(constant.estimated_parameters)(found.states)["system.length"]
    assert np.mean(np.abs(fixed.mean[60:, 0] - lengths[60:])) > 3 * np.mean(off[60:])


@needs_x64
def test_parameters_keep_their_names_in_any_order():
    """JAX sorts the keys of a dictionary where a module enters a program."""
    names = "system.length", "system.gravity"
    start, ys = np.array([0.1, 0.0]), np.tile([0.1, 0.0], (4, 1))
    walks = {
        name: c.RandomWalk(variance, step=0.0)
        for name, variance in zip(names, (1e-4, 4e-4), strict=True)
    }
    given = swinging(1.2), 1e-8 * np.eye(2), 1e-4 * np.eye(2), 3
    mhe = c.MHE(*given, mean=start, parameters=walks)
    state = mhe.init()
    for k in range(2):
        state = eqx.filter_jit(mhe.update)(jnp.asarray(0.05 * k), ys[k], state)
        state = eqx.filter_jit(mhe.predict)(jnp.asarray(0.05 * k), jnp.zeros(1), state)
    found = c.run_estimator(mhe, ys, np.zeros((4, 1)))
    last = jax.tree.map(lambda a: a[-1], found.states)
    for beliefs in (mhe.estimated_parameters(state), mhe.estimated_parameters(last)):
        assert_close(beliefs["system.length"].mean, [1.2], atol=0.1)
        assert_close(beliefs["system.gravity"].mean, [9.81], rtol=0.1)
        assert_close(beliefs["system.length"].covariance, [[1e-4]], rtol=0.2)
        assert_close(beliefs["system.gravity"].covariance, [[4e-4]], rtol=0.2)


@needs_x64
def test_outliers():
    """Every tenth reading is wrong by 30 standard deviations."""
    dynamics = dlx.LinearDynamics(
        [[1.0, 0.1], [-0.1, 0.98]], [[0.0], [0.1]], [[1.0, 0.0]]
    )
    rng, T = np.random.default_rng(0), 80
    A = np.asarray(dynamics.A)
    x, states = np.array([1.0, 0.0]), []
    for _ in range(T):
        states.append(x)
        x = A @ x + 0.01 * rng.normal(size=2)
    states = np.array(states)
    ys = states[:, :1] + 0.1 * rng.normal(size=(T, 1))
    ys[5::10] += 3.0
    weights = 1e-4 * np.eye(2), 1e-2 * np.eye(1)

    def error(robust):
        mhe = c.MHE(dynamics, *weights, 10, robust=robust)
        mean = c.run_estimator(mhe, ys).updated.mean
        return np.sqrt(np.mean((mean[10:, 0] - states[10:, 0]) ** 2))

    assert error(2.0) < 0.06 < 0.15 < error(None)
    assert_close(error(1e6), error(None), rtol=1e-4)


@needs_x64
def test_the_robust_penalty_is_hubers():
    T, sigma, limit = 6, 0.3, 1.5
    A = np.array([[1.0, 0.1], [0.0, 1.0]])
    dynamics = dlx.LinearDynamics(A, np.zeros((2, 1)), np.eye(2))
    V = sigma**2 * np.array([[1.0, 0.3], [0.3, 2.0]])
    W, rng = 1e-2 * np.eye(2), np.random.default_rng(0)
    ys = rng.normal(size=(T, 2))
    ys[2] += 5.0
    mhe = c.MHE(dynamics, W, V, T, robust=limit, iterations=60)
    found = c.run_estimator(mhe, ys)

    @jax.jit
    def cost(flat):
        x = flat.reshape(T, 2)
        r = ys - x
        r = jnp.sqrt(jnp.einsum("ti,ij,tj->t", r, np.linalg.inv(V), r))
        far = limit * (r - limit / 2)
        penalty = jnp.sum(jnp.where(r > limit, far, r**2 / 2))
        w = x[1:] - x[:-1] @ A.T
        return jnp.sum(x[0] ** 2) / 2 + jnp.sum(w**2) / 2e-2 + penalty

    last = jax.tree.map(lambda a: a[-1], found.states)
    best = scipy.optimize.minimize(
        cost, np.ravel(last.x) + 0.1, jac=jax.jit(jax.grad(cost)), tol=1e-12
    )
    assert_close(last.x, best.x.reshape(T, 2), atol=1e-5)


@needs_x64
def test_derivatives():
    """With respect to the weights, the prior, the rate, the walk and the bounds, in
    both modes, with active bounds and an outlier."""
    ys = reacting(5, seed=1)[1]
    ys[3] += 1.0
    mhe = c.MHE(
        REACTOR,
        np.diag([1e-3, 2e-3]),
        NOISE[1],
        3,
        mean=[2.0, 1.2],
        covariance=np.diag([0.2, 0.5]),
        bounds=([0.0, 0.0], [jnp.inf, 1.5]),
        robust=2.0,
        parameters={"system.k": c.RandomWalk(1e-3, step=1e-5)},
    )
    arrays, rest = eqx.partition(mhe, eqx.is_inexact_array)
    flat, unravel = ravel_pytree(arrays)
    finite = np.flatnonzero(np.isfinite(flat))

    def last(numbers):
        whole = unravel(flat.at[finite].set(numbers))
        found = c.run_estimator(eqx.combine(whole, rest), ys, throw=False)
        held = jnp.sum(found.states.sides[-1] != 0)
        rate = found.states.belief.mean[-1, 2:]
        return jnp.concatenate([found.updated.mean[-1], rate, held[None] * 1.0])

    numbers, h = np.asarray(flat)[finite], 1e-6
    compiled = jax.jit(in_both_modes(last))
    values, forwards, backwards = compiled(numbers)
    assert values[-1] > 0 and abs(values[1] - 1.5) < 1e-9
    assert_close(forwards, backwards, rtol=1e-9, atol=1e-9)
    for i, way in enumerate(np.eye(len(numbers))):
        up, down = (compiled(numbers + s * h * way)[0] for s in (1, -1))
        assert_close(forwards[:, i], (up - down) / (2 * h), rtol=1e-5, atol=1e-5)
