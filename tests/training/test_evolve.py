"""Training by ranks, without a derivative."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import assert_close, once

import delucax as dlx
from delucax.training import evolve


pytestmark = once

KEY = jax.random.key(0)


def linear(size=3):
    return dlx.controllers.Linear(jnp.zeros((1, size)))


def bowl(model, key):
    return jnp.sum((model.K - jnp.array([1.0, -2.0, 0.5])) ** 2)


@functools.cache
def trained():
    return evolve(bowl, linear(), 120, key=KEY, population=32, progress=False)


def test_the_mean_goes_to_the_minimum():
    assert_close(trained().model.K, [[1.0, -2.0, 0.5]], atol=1e-3)
    assert trained().history.loss[-1] < 1e-5


def test_only_the_order_of_losses_counts():
    def steep(model, key):
        return jnp.exp(3 * jnp.sqrt(bowl(model, key)))

    fitted = evolve(steep, linear(), 120, key=KEY, population=32, progress=False)
    assert_close(fitted.model.K, trained().model.K, atol=1e-4)


def test_a_loss_that_is_flat_and_not_everywhere_finite():
    def stairs(model, key):
        value = jnp.floor(4 * bowl(model, key))
        return jnp.where(model.K[0, 0] > 2, jnp.nan, value)

    fitted = evolve(stairs, linear(), 100, key=KEY, population=32, progress=False)
    assert bowl(fitted.model, None) < 0.25


def test_what_is_not_trained_stays():
    base = dlx.controllers.Linear(jnp.ones((1, 3)))
    policy = dlx.controllers.Residual(base, linear())
    loss = lambda policy, key: bowl(policy.correction, key)
    for part in ("correction", ["correction.K"]):
        options = dict(key=KEY, population=8, progress=False, trainable=part)
        fitted = evolve(loss, policy, 3, **options)
        assert_close(fitted.model.base.K, base.K)
        assert not np.allclose(fitted.model.correction.K, 0)


def test_all_fail():
    never = lambda model, key: jnp.nan * jnp.sum(model.K)
    options = dict(key=KEY, population=8, progress=False)
    with pytest.raises(RuntimeError, match="loss is not finite at step 0"):
        evolve(never, linear(), 3, **options)
    fitted = evolve(never, linear(), 3, throw=False, **options)
    assert fitted.result == dlx.RESULTS.diverged
    assert_close(fitted.model.K, 0)


@pytest.mark.parametrize(
    ("options", "match"),
    [
        (dict(population=7), "population must be even, got 7"),
        (dict(population=2), "population must be .* at least 4"),
        (dict(sigma=0.0), "sigma must be positive"),
        (dict(trainable=len), "trainable must be a path or several"),
    ],
)
def test_bad_arguments(options, match):
    with pytest.raises(ValueError, match=f"evolve: .*{match}"):
        evolve(bowl, linear(), 3, key=KEY, **options)
