import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import assert_close, once, user_error

import delucax as dlx


Y = jnp.array([0.5, -2.0])


def test_what_they_do(key):
    assert_close(dlx.controllers.Zero(3)(0.0, Y, None)[0], np.zeros(3))
    assert_close(dlx.controllers.Constant([1.0, 2.0])(0.0, Y, None)[0], [1.0, 2.0])
    K = jnp.array([[2.0, 1.0]])
    assert_close(dlx.controllers.Linear(K)(0.0, Y, None)[0], [1.0])
    given = dlx.controllers.OpenLoop([[1.0], [2.0]])
    state, controls = given.init(), []
    for _ in range(3):
        u, state = given(0.0, Y, state)
        controls.append(float(u[0]))
    assert controls == [1.0, 2.0, 2.0]


def test_random_controls(key):
    explore = dlx.controllers.Random(jnp.array([0.5, 2.0]), mean=[1.0, -1.0])
    draw = lambda k: explore(0.0, Y, explore.init(key=k))[0]
    u = jax.vmap(draw)(jax.random.split(key, 4000))
    assert_close(u.mean(0), [1.0, -1.0], atol=0.1)
    assert_close(u.std(0), [0.5, 2.0], rtol=0.05)


@once
@pytest.mark.parametrize(
    "make, match",
    [
        (lambda c: c.Zero(-1), "control_size must be a whole number of at least 0"),
        (lambda c: c.Constant(1.0), "value must be a vector"),
        (lambda c: c.Constant([np.nan]), "value must be finite"),
        (lambda c: c.Random(1.0), "std must be a vector"),
        (lambda c: c.Random(jnp.ones(1)).init(), "key must be one random key"),
        (lambda c: c.Linear(jnp.ones(2)), r"K must be a matrix, got shape \(2,\)"),
        (lambda c: c.Linear([[np.inf]]), "K must be finite"),
        (lambda c: c.OpenLoop(jnp.ones((0, 1))), "values must have at least one row"),
    ],
)
def test_wrong_arguments(make, match):
    with user_error(match=match):
        make(dlx.controllers)
