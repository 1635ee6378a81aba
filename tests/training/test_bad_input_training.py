import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from helpers import once, user_error

import delucax as dlx
from delucax import training


pytestmark = once


ENV = dlx.make("pendulum")
FEEDBACK = dlx.controllers.Linear(jnp.array([[20.0, 5.0]]))
LOSS = training.expected_cost(ENV, batch=2, horizon=3)


@pytest.mark.parametrize(
    "name, call",
    [
        ("expected_cost", LOSS),
        ("scored_cost", training.scored_cost(ENV)),
        ("analytic", lambda c, key: training.analytic(LOSS, c, key)),
        (
            "ClippedSamples",
            lambda c, key: training.ClippedSamples(4)(LOSS, c, key),
        ),
        (
            "EvolutionStrategies",
            lambda c, key: training.EvolutionStrategies(0.1, 4)(LOSS, c, key),
        ),
        (
            "LikelihoodRatio",
            lambda c, key: training.LikelihoodRatio(4)(LOSS, c, key),
        ),
    ],
)
def test_a_seed_for_a_key(name, call):
    with user_error(match=f"^{name}: key must be one random key.*got 0"):
        call(FEEDBACK, 0)


@pytest.mark.parametrize("value", [np.nan, "x", jnp.ones(2)])
def test_a_decay_that_is_no_number(value):
    with user_error(match="expected_cost: gradient_decay must be"):
        training.expected_cost(ENV, batch=1, gradient_decay=value)


@pytest.mark.parametrize(
    "arguments, match",
    [
        ({"checkpoint": 3}, "fit: checkpoint must be the path of a file, got 3"),
        ({"gradient": training.EvolutionStrategies}, "gradient must be an estimator"),
    ],
)
def test_wrong_kinds_for_fit(arguments, match):
    options = dict(steps=1, key=jax.random.key(0), progress=False) | arguments
    with user_error(match=match):
        training.fit(LOSS, FEEDBACK, optax.sgd(0.1), **options)
