"""Slips in controllers, costs and environments, and the words for them."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import once, user_error

import delucax as dlx


pytestmark = once


c = dlx.controllers
EYE = jnp.eye(2)
DYNAMICS = dlx.LinearDynamics(0.5 * EYE, EYE[:, :1])


@pytest.mark.parametrize(
    "call, match",
    [
        (lambda: c.Random([-1.0]), "Random: std must be at least 0"),
        (lambda: c.Random([1.0]).init(key=0), "Random.init: key must be"),
        (lambda: c.Gaussian(c.Zero(1), 0.0).init(key=0), "Gaussian.init: key must be"),
        (lambda: c.PID(1.0, dt=-1.0), "PID: dt must be positive"),
        (lambda: c.PID(1.0, dt=None), "PID: dt must be positive"),
        (
            lambda: c.MLP(2, 1, activation="relu", key=jax.random.key(0)),
            "MLP: activation must be a function",
        ),
        (
            lambda: c.MLP(2, 1, features=3, key=jax.random.key(0)),
            "MLP: features must be a function",
        ),
        (lambda: dlx.costs.Function(3), "Function: stage must be a function"),
        (lambda: dlx.costs.Rate(3, 0.1), "Rate: cost must be an AbstractCost"),
        (
            lambda: dlx.costs.Quadratic(EYE, EYE[:1, :1], difference=3),
            "Quadratic: difference must be a function",
        ),
        (
            lambda: dlx.make("pendulum", terminated=3),
            "Environment: terminated must be a function",
        ),
        (
            lambda: dlx.make("pendulum", encode=4),
            "Environment: encode must be a function",
        ),
        (
            lambda: dlx.make("pendulum", actions=[[np.nan]]),
            "Environment: actions must be finite",
        ),
        (
            lambda: dlx.make("cartpole").step(0.0, jnp.zeros(4), 7),
            "an action from 0 to 1, got 7",
        ),
        (lambda: batch()[9], "from -4 to 3"),
        (
            lambda: dlx.costs.Function(lambda x, u: 0.0),
            r"stage must be a function of \(t, x, u\), got <lambda>, a function of "
            r"\(x, u\)",
        ),
        (
            lambda: dlx.make("pendulum", terminated=lambda x: x[0] > 1),
            r"terminated must be a function of \(t, x\), got <lambda>",
        ),
        (
            lambda: dlx.make("pendulum", encode=jnp.hypot),
            r"encode must be a function of \(y\), got hypot, a function of \(x1, x2\)",
        ),
    ],
)
def test_words(call, match):
    with user_error((ValueError, IndexError), match=match):
        call()


def batch():
    env = dlx.make("pendulum", horizon=2)
    keys = jax.random.split(jax.random.key(0), 4)
    run = lambda key: dlx.rollout(env, c.Zero(1), key=key)
    return jax.vmap(run)(keys)


def test_a_state_of_numpy():
    class Counter(dlx.AbstractController):
        def init(self, *, key=None):
            return np.zeros(1)

        def __call__(self, t, y, state):
            return jnp.zeros(1, y.dtype), state + 1

    env = dlx.make("pendulum", horizon=3)
    run = dlx.rollout(env, Counter(), key=jax.random.key(0))
    assert run.result == dlx.RESULTS.successful


def test_an_observation_that_is_none():
    class Listing(dlx.AbstractSystem):
        state_names = ("x", "v")
        control_names = ("u",)

        def vector_field(self, t, x, u, w):
            return -x

        def observe(self, t, x):
            return [x[0]]

    dynamics = dlx.Discretized(Listing(), 0.1)
    env = dlx.Environment(dynamics, dlx.costs.Quadratic(EYE, EYE[:1, :1]))
    with user_error(match="observe must return a vector, got list"):
        dlx.rollout(env, c.Zero(1), key=jax.random.key(0))


def test_arrays_as_defaults():
    class Field(dlx.AbstractSystem):
        state_names = ("x",)
        control_names = ("u",)
        gains: jax.Array = dlx.parameter(np.ones(2))
        more: jax.Array = dlx.parameter([1.0, 2.0])

        def vector_field(self, t, x, u, w):
            return jnp.stack([self.gains @ self.more + u[0]])

    assert Field().vector_field(0.0, jnp.zeros(1), jnp.zeros(1), None)[0] == 3
