import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg
from helpers import assert_close, assert_gradient, needs_x64, user_error

import delucax as dlx


pytestmark = needs_x64


c = dlx.controllers
A = jnp.array([[1.0, 0.2], [0.1, 0.9]])
B = jnp.array([[0.0], [0.2]])
C = jnp.array([[1.0, 0.0]])
E = jnp.array([[0.5], [1.0]])
Q, R, S = jnp.eye(2), 0.5 * jnp.eye(1), jnp.array([[0.1], [0.2]])
W, V = 0.09 * jnp.eye(1), 0.04 * jnp.eye(1)
DYNAMICS = dlx.LinearDynamics(A, B, C, E, dt=0.2)


class Cross(dlx.AbstractCost):
    """`x'Qx + 2 x'Su + u'Ru`."""

    def __call__(self, t, x, u):
        return x @ Q @ x + 2 * x @ S @ u + u @ R @ u


def environment(**options):
    return dlx.Environment(
        DYNAMICS,
        Cross(),
        disturbance=dlx.disturbances.Gaussian(0.3, size=1),
        sensor_noise=dlx.disturbances.Gaussian(0.2, size=1),
        **options,
    )


def average_cost(K, L, predictor=False):
    """Of any gains: from the stationary covariance of the state and of the error of
    what is acted on, which is the estimate with the observation in it, or without."""
    a, b, cc, e, q, r, s, w, v, K, L = (
        np.asarray(M, np.float64) for M in (A, B, C, E, Q, R, S, W, V, K, L)
    )
    if predictor:
        error, pushed, sensed = a - a @ L @ cc, e, -a @ L
    else:
        seen = np.eye(2) - L @ cc
        error, pushed, sensed = seen @ a, seen @ e, -L
    loop = np.block([[a - b @ K, b @ K], [np.zeros((2, 2)), error]])
    inputs = np.block([[e, np.zeros((2, 1))], [pushed, sensed]])
    noise = inputs @ scipy.linalg.block_diag(w, v) @ inputs.T
    X = scipy.linalg.solve_discrete_lyapunov(loop, noise)
    state, control = np.eye(2, 4), np.hstack([-K, K])
    cross = state.T @ s @ control
    weight = state.T @ q @ state + control.T @ r @ control + cross + cross.T
    return np.trace(weight @ X)


def test_average_cost():
    """The formula is what the stationary covariance of the whole loop gives, and what
    is met on average over many runs."""
    lqg = c.LQG(DYNAMICS, Q, R, W, V, S)
    expected = average_cost(lqg.regulator.K, lqg.estimator.L)
    assert_close(lqg.average_cost, expected, rtol=1e-11)
    env = environment(horizon=400)
    run = lambda key: jnp.mean(dlx.rollout(env, lqg, key=key).costs[100:])
    costs = np.asarray(jax.vmap(run)(jax.random.split(jax.random.key(1), 512)))
    error = np.std(costs) / np.sqrt(len(costs))
    assert error < 0.02 * expected
    assert abs(np.mean(costs) - expected) < 3 * error
    # Far enough from what the predictor form would cost.
    worse = average_cost(lqg.regulator.K, lqg.estimator.L, predictor=True)
    assert worse > expected + 10 * error


def test_nothing_near_is_better():
    lqg = c.LQG(DYNAMICS, Q, R, W, V, S)
    K, L = np.asarray(lqg.regulator.K), np.asarray(lqg.estimator.L)
    best = average_cost(K, L)
    for i in range(2):
        for step in (-0.03, 0.03):
            way = step * np.eye(2)[i]
            assert average_cost(K + way, L) > best
            assert average_cost(K, L + way[:, None]) > best


def test_told_what_was_applied(key):
    """Where the control saturates, the estimate follows the plant and not the wish."""
    env = environment(horizon=12, control_bounds=(-0.3, 0.3))
    x0 = jnp.array([2.0, 1.0])
    lqg = c.LQG(DYNAMICS, Q, R, W, V, mean=x0)
    run = dlx.rollout(env, lqg, key=key, x0=x0)
    assert_close(np.abs(run.controls[:4]), 0.3, rtol=1e-6)
    filtered = dlx.estimators.run_filter(lqg.estimator, run.observations, run.controls)
    K = lqg.regulator.K
    expected = jnp.clip(-filtered.updated.mean @ K.T, -0.3, 0.3)
    close = dict(rtol=1e-11, atol=1e-12)
    assert_close(run.controls, expected, **close)
    # With no noise at all, from a known start, the estimate is exact.
    quiet = dlx.Environment(DYNAMICS, Cross(), control_bounds=(-0.3, 0.3), horizon=12)
    run = dlx.rollout(quiet, lqg, key=key, x0=x0)
    expected = jnp.clip(-run.states[:-1] @ K.T, -0.3, 0.3)
    assert_close(run.controls, expected, **close)


def test_exact_sensor_is_state_feedback(key):
    dynamics = dlx.LinearDynamics(A, B)
    noise = dlx.disturbances.Gaussian(0.3, size=2)
    env = dlx.Environment(dynamics, Cross(), noise, horizon=10)
    exact = 0.09 * jnp.eye(2), jnp.zeros((2, 2))
    regulator = c.LQR(dynamics, Q, R, S)
    expected = dlx.rollout(env, regulator, key=key, x0=jnp.ones(2))
    close = dict(rtol=1e-10, atol=1e-11)
    for steady_state in (True, False):
        lqg = c.LQG(dynamics, Q, R, *exact, S, steady_state=steady_state)
        run = dlx.rollout(env, lqg, key=key, x0=jnp.ones(2))
        assert_close(run.controls, expected.controls, **close)
        assert (lqg.average_cost is None) == (not steady_state)


def test_holds_an_operating_point(key):
    """A pendulum leant against a constant torque, its bob seen from the side."""

    class Seen(dlx.AbstractSystem):
        pendulum: dlx.systems.Pendulum
        state_names = ("angle", "velocity")
        control_names = ("torque",)

        def vector_field(self, t, x, u, w):
            return self.pendulum.vector_field(t, x, u, w)

        def observe(self, t, x):
            return jnp.sin(x[:1])

    dynamics = dlx.Discretized(Seen(dlx.systems.Pendulum()), dt=0.05)
    x_ref = jnp.array([0.3, 0.0])
    u_ref = jnp.array([-5.0 * np.sin(0.3)])
    leant = dlx.linearize(dynamics, 0.0, x_ref, u_ref)
    noise = 1e-4 * jnp.eye(2), 1e-4 * jnp.eye(1)
    lqg = c.LQG(leant, Q, R, *noise, y_ref=dynamics.observe(0.0, x_ref))
    env = dlx.Environment(dynamics, dlx.costs.Quadratic(Q, R), horizon=200)
    run = dlx.rollout(env, lqg, key=key, x0=x_ref + jnp.array([0.05, 0.0]))
    assert_close(run.final_state, x_ref, atol=1e-4)
    # Without it the reading there is taken for that of another place.
    lqg = c.LQG(leant, Q, R, *noise)
    run = dlx.rollout(env, lqg, key=key, x0=x_ref, throw=False)
    assert abs(run.final_state[0] - 0.3) > 0.01


def test_output_feedback_of_anything(key):
    """With the parts of an LQG it is that LQG; each part may be another one."""
    env = environment(horizon=10)
    lqg = c.LQG(DYNAMICS, Q, R, W, V, S)
    same = c.OutputFeedback(lqg.regulator, lqg.estimator)
    a, b = (dlx.rollout(env, law, key=key) for law in (lqg, same))
    np.testing.assert_array_equal(a.controls, b.controls)

    class Luenberger(dlx.estimators.AbstractEstimator):
        L: jax.Array = dlx.weight()

        def init(self, *, key=None):
            return dlx.estimators.Belief(jnp.zeros(2), jnp.eye(2))

        def update(self, t, y, belief):
            error = y - DYNAMICS.observe(t, belief.mean)
            return belief._replace(mean=belief.mean + self.L @ error)

        def predict(self, t, u, belief):
            mean, _ = DYNAMICS.advance(t, belief.mean, u, None)
            return belief._replace(mean=mean)

    observer = Luenberger(lqg.estimator.L)
    run = dlx.rollout(env, c.OutputFeedback(lqg.regulator, observer), key=key)
    close = dict(rtol=1e-11, atol=1e-12)
    assert_close(run.controls, a.controls, **close)
    drawn = c.OutputFeedback(c.Gaussian(lqg.regulator, -20.0), observer)
    run = dlx.rollout(env, drawn, key=key)
    assert_close(run.controls, a.controls, atol=1e-4)


@needs_x64
def test_gradient_of_the_design():
    """Of the least average cost, with respect to the noise and to the physics."""

    def cost(z):
        dynamics = eqx.tree_at(lambda d: d.A, DYNAMICS, A.at[1, 0].set(z[0]))
        return c.LQG(dynamics, Q, R, z[1] * W, z[2] * V).average_cost

    gradient = assert_gradient(cost, jnp.array([0.15, 1.2, 0.8]), rtol=1e-6)
    assert np.all(gradient > 0)


def test_wrong_arguments():
    with user_error(match="LQR: dynamics must be a LinearDynamics.*got Pendulum"):
        c.LQG(dlx.systems.Pendulum(), Q, R, W, V)
    with user_error(match=r"Q must have shape \(2, 2\)"):
        c.LQG(DYNAMICS, jnp.eye(3), R, W, V)
    with user_error(match=r"KalmanFilter: W must have shape \(1, 1\)"):
        c.LQG(DYNAMICS, Q, R, jnp.eye(2), V)
    with user_error(match="KalmanFilter: V must be positive semidefinite"):
        c.LQG(DYNAMICS, Q, R, W, -V)
    with user_error(match="covariance must not be given with steady_state"):
        c.LQG(DYNAMICS, Q, R, W, V, covariance=jnp.eye(2))
    with pytest.raises(RuntimeError, match="KalmanFilter: there is no steady state"):
        unseen = dlx.LinearDynamics(1.1 * jnp.eye(2), jnp.eye(2), C)
        c.LQG(unseen, Q, jnp.eye(2), jnp.eye(2), V)
    lqg = c.LQG(DYNAMICS, Q, R, W, V)
    with user_error(match="controller must be an AbstractController, got KalmanFilter"):
        c.OutputFeedback(lqg.estimator, lqg.estimator)
    with user_error(match="estimator must be an AbstractEstimator, got LQR"):
        c.OutputFeedback(lqg.regulator, lqg.regulator)
    with user_error(match="the observation must have size 1, got size 2"):
        lqg(0.0, jnp.zeros(2), lqg.init())
