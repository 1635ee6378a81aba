"""The LQG that an environment defines, in both precisions."""

import dataclasses

import jax
import jax.numpy as jnp
import pytest
from helpers import assert_close, once, user_error

import delucax as dlx
from delucax.controllers import local_lqg


KEY = jax.random.key(0)


class Position(dlx.systems.DoubleIntegrator):
    """Without a sensor of the velocity."""

    def observe(self, t, x):
        return x[:1]


def hidden(**changes):
    env = dlx.make("double_integrator", horizon=80, max_force=100.0)
    dynamics = dlx.Discretized(Position(), dt=0.1)
    return dataclasses.replace(env, dynamics=dynamics, **changes)


def test_it_brings_a_hidden_state_to_rest():
    noise = dlx.disturbances.Gaussian(0.01, size=1)
    task, key = hidden(sensor_noise=noise), jax.random.key(1)
    lqg = local_lqg(task, key=key)
    run = dlx.rollout(task, lqg, key=key)
    zero = dlx.rollout(task, dlx.controllers.Zero(1), key=key)
    assert run.total_cost < 0.2 * zero.total_cost
    assert jnp.all(jnp.abs(run.states[-1]) < 0.2)
    # Its gain is that of the covariances that the noise has, to the sampling error.
    assert lqg.estimator.V[0, 0] == pytest.approx(1e-4, rel=0.2)


@once
@pytest.mark.parametrize("changes", [{}, dict(initial_state=[1.0, 0.0])])
def test_without_noise_there_is_a_filter_too(changes):
    """Even from one initial state, which has no covariance."""
    task = hidden(**changes)
    lqg = local_lqg(task, key=KEY)
    run = dlx.rollout(task, lqg, key=KEY)
    assert jnp.all(jnp.abs(run.states[-1]) < 0.2)


@once
def test_it_is_the_lqg_of_a_linear_task():
    A, B = jnp.array([[1.0, 1.0], [0.0, 1.0]]), jnp.array([[0.0], [1.0]])
    C, W, V = jnp.eye(2)[:1], 0.01 * jnp.eye(2), 0.25 * jnp.eye(1)
    w, v = (dlx.disturbances.Gaussian(s, size=n) for s, n in ((0.1, 2), (0.5, 1)))
    task = dlx.make("lds", A=A, B=B, C=C, disturbance=w, sensor_noise=v)
    lqg, (_, Q, R, _) = local_lqg(task, key=KEY), dlx.controllers.local_model(task)
    exact = dlx.controllers.LQG(task.dynamics, Q, R, W, V)
    assert_close(lqg.regulator.K, exact.regulator.K, rtol=1e-4)
    # To the sampling error of the covariances.
    assert_close(lqg.estimator.L, exact.estimator.L, atol=0.05)


@once
def test_where_the_state_is_observed_its_readings_wrap():
    noise = dlx.disturbances.Gaussian(0.1, size=2)
    task = dataclasses.replace(dlx.make("pendulum"), sensor_noise=noise)
    lqg = local_lqg(task, key=KEY)
    assert_close(lqg.regulator.K, dlx.controllers.local_lqr(task).K)
    act = lambda angle: lqg(0.0, jnp.array([angle, 0.0]), lqg.init())[0]
    assert_close(act(0.1 + 2 * jnp.pi), act(0.1), atol=1e-4)


@once
def test_a_state_that_no_sensor_shows_has_no_filter():
    class Velocity(Position):
        def observe(self, t, x):
            return x[1:]

    dynamics = dlx.Discretized(Velocity(), dt=0.1)
    task = dataclasses.replace(hidden(), dynamics=dynamics)
    with pytest.raises(RuntimeError, match="KalmanFilter: there is no steady state"):
        local_lqg(task, key=KEY)


@once
def test_bad_input():
    task = hidden()
    for call, match in (
        (lambda: local_lqg(3, key=KEY), "environment must be an Environment"),
        (lambda: local_lqg(task, key=3), "key must be"),
        (lambda: local_lqg(task, key=KEY, regularisation=0.0), "regularisation must"),
        (
            lambda: jax.jit(lambda key: local_lqg(task, key=key).estimator.L)(KEY),
            "key must hold a value",
        ),
    ):
        with user_error(match=f"local_lqg: {match}"):
            call()
