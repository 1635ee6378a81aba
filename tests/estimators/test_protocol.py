"""Estimators whose state is not a belief."""

import jax
import jax.numpy as jnp
import numpy as np
from helpers import assert_close, once

import delucax as dlx


pytestmark = once


class Window(dlx.estimators.AbstractEstimator):
    """The average of the last observations."""

    def init(self, *, key=None):
        return jnp.zeros((3, 2)), jnp.zeros((), int)

    def update(self, t, y, state):
        window, count = state
        return jnp.roll(window, 1, axis=0).at[0].set(y), count

    def predict(self, t, u, state):
        window, count = state
        return window, count + 1

    def estimate(self, state):
        window, _ = state
        return dlx.estimators.Belief(jnp.mean(window, axis=0), jnp.eye(2))


def test_a_window_in_a_closed_loop(key):
    env, window = dlx.make("pendulum"), Window()
    K = jnp.array([[20.0, 5.0]])
    controller = dlx.controllers.OutputFeedback(dlx.controllers.Linear(K), window)
    run = dlx.rollout(env, controller, key=key, x0=[0.01, 0.0], horizon=4)
    y = jnp.concatenate([jnp.zeros((2, 2)), run.observations])
    for k in range(4):
        assert_close(run.controls[k], -K @ jnp.mean(y[k : k + 3], axis=0), rtol=1e-5)


def test_a_moving_horizon_in_a_closed_loop(key):
    """A batch, with noise and bounds."""
    env = dlx.make("pendulum")
    env = dlx.replace(env, {"sensor_noise": dlx.disturbances.Gaussian(0.1, size=2)})
    regulator = dlx.controllers.LQR(dlx.linearize(env.dynamics), np.eye(2), np.eye(1))
    weights = 1e-6 * np.eye(2), 1e-2 * np.eye(2)
    mhe = dlx.estimators.MHE(
        env.dynamics,
        *weights,
        5,
        covariance=0.1 * np.eye(2),
        bounds=([-0.3, -1.0], [0.3, 1.0]),
        observation_difference=env.dynamics.difference,
    )
    controller = dlx.controllers.OutputFeedback(regulator, mhe)

    @jax.jit
    @jax.vmap
    def run(key):
        found = dlx.rollout(env, controller, key=key, x0=[0.2, 0.0], horizon=60)
        failed = found.incidents["failed_estimate"].sum()
        return found.states[-1], failed

    states, failed = run(jax.random.split(key, 3))
    assert np.max(np.abs(states)) < 0.1 and np.sum(failed) == 0


class Doubtful(Window):
    def status(self, state):
        _, count = state
        return dlx.RESULTS.where(
            count == 2, dlx.RESULTS.diverged, dlx.RESULTS.successful
        )


def test_an_estimate_that_fails_is_an_incident(key):
    controller = dlx.controllers.OutputFeedback(dlx.controllers.Zero(1), Doubtful())
    run = dlx.rollout(dlx.make("pendulum"), controller, key=key, horizon=4)
    # The prediction of step 1, and the update of step 2.
    assert run.incidents["failed_estimate"].tolist() == [False, True, True, False]
    assert run.result == dlx.RESULTS.estimate_failed and not run.failed


def test_the_default_status(key):
    window = Window()
    state = window.update(0.0, jnp.ones(2), window.init())
    assert window.status(state) == dlx.RESULTS.successful
    state = jax.jit(window.update)(0.0, jnp.full(2, jnp.nan), state)
    assert window.status(state) == dlx.RESULTS.diverged
