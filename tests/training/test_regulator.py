"""The linear regulator that `synthesise` starts from, in both precisions."""

import dataclasses

import jax
import jax.numpy as jnp
import pytest

import delucax as dlx
from delucax.training._regulator import regulator


KEY = jax.random.key(0)


class Position(dlx.systems.DoubleIntegrator):
    """Without a sensor of the velocity."""

    def observe(self, t, x):
        return x[:1]


def hidden(**changes):
    env = dlx.make("double_integrator", horizon=80, max_force=100.0)
    dynamics = dlx.Discretized(Position(), dt=0.1)
    return dataclasses.replace(env, dynamics=dynamics, **changes)


def test_where_the_state_is_hidden_the_regulator_is_an_lqg():
    noise = dlx.disturbances.Gaussian(0.01, size=1)
    task, key = hidden(sensor_noise=noise), jax.random.key(1)
    lqg = regulator(task, key)
    assert isinstance(lqg, dlx.controllers.LQG)
    run = dlx.rollout(task, lqg, key=key)
    zero = dlx.rollout(task, dlx.controllers.Zero(1), key=key)
    assert run.total_cost < 0.2 * zero.total_cost
    assert jnp.all(jnp.abs(run.states[-1]) < 0.2)
    # Its gain is that of the covariances that the noise has, to the sampling error.
    assert lqg.estimator.V[0, 0] == pytest.approx(1e-4, rel=0.2)


def test_without_noise_there_is_a_filter_too():
    task = hidden()
    lqg = regulator(task, KEY)
    run = dlx.rollout(task, lqg, key=KEY)
    assert jnp.all(jnp.abs(run.states[-1]) < 0.2)


def test_where_the_state_is_observed_the_regulator_is_the_lqr():
    env = dlx.make("pendulum")
    expected = dlx.controllers.local_lqr(env).K
    assert jnp.array_equal(regulator(env, KEY).K, expected)


def test_a_state_that_no_sensor_shows_has_no_regulator():
    class Velocity(Position):
        def observe(self, t, x):
            return x[1:]

    dynamics = dlx.Discretized(Velocity(), dt=0.1)
    task = dataclasses.replace(hidden(), dynamics=dynamics)
    with pytest.raises((ValueError, RuntimeError)):
        regulator(task, KEY)
