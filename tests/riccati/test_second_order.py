"""Derivatives of the Riccati solvers to second order, in both modes."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import (
    assert_close,
    needs_x64,
)

import delucax as dlx


pytestmark = needs_x64


A, D_A = np.array([[0.6, 0.3], [-0.2, -0.9]]), np.array([[0.4, -1.0], [0.3, 0.7]])
B, D_B = np.array([[1.0], [0.5]]), np.array([[-0.3], [0.8]])
Q, D_Q = np.array([[2.0, 0.3], [0.3, 1.0]]), np.array([[0.5, -0.2], [-0.2, 0.9]])
R, D_R = np.array([[1.0]]), np.array([[1.0]])
S, D_S = np.array([[0.1], [-0.2]]), np.array([[0.6], [0.2]])
E, D_E = np.array([[1.1, 0.1], [0.0, 0.9]]), np.array([[0.2, -0.4], [0.5, 0.1]])
PLAIN = (A, D_A), (B, D_B), (Q, D_Q), (R, D_R), (S, D_S)


def total(solve, pairs, e):
    """A number of the solution, as all arguments move at once."""
    solution = solve(*(M + e * D for M, D in pairs), throw=False)
    value = jnp.sum(jnp.sin(solution.X))
    if hasattr(solution, "K"):
        value = value + jnp.sum(jnp.cos(solution.K))
    return value


def in_both_modes(f):
    """`f`, and its derivatives forwards and backwards, of one linearisation."""

    def derivatives(e):
        values, push = jax.linearize(f, e)
        pull = jax.linear_transpose(push, e)
        (backwards,) = jax.vmap(pull)(jnp.eye(len(values)))
        return values, jnp.concatenate([push(1.0), backwards])

    return derivatives


rng = np.random.default_rng(0)
LEFT, RIGHT = rng.normal(size=(2, 6, 6)) / 6, rng.normal(size=(2, 7, 7)) / 7
SQUARE, TALL = rng.normal(size=(2, 6, 6)), rng.normal(size=(2, 6, 7))
STABLE = LEFT[0] - np.eye(6), LEFT[1]
PROBLEMS = {
    "dare": (*PLAIN, (E, D_E)),
    "care": (*PLAIN, (E, D_E)),
    "lyap": (STABLE, SQUARE),
    "dsylvester": (LEFT, RIGHT, TALL),
}
OTHERS = {"dlyap": (LEFT, SQUARE), "sylvester": (STABLE, RIGHT, TALL)}


@pytest.mark.parametrize(
    "name",
    [
        "dare",
        "care",
        "lyap",
        "dsylvester",
    ],
)
def test_to_second_order(name):
    solve, pairs = getattr(dlx.riccati, name), PROBLEMS[name]

    @jax.jit
    def line(e):
        def value_and_first(e):
            value, first = in_both_modes(lambda e: total(solve, pairs, e)[None])(e)
            return jnp.concatenate([value, first])

        return in_both_modes(value_and_first)(e)

    h = 1e-5
    low, high = np.asarray(line(0.1 - h)[0]), np.asarray(line(0.1 + h)[0])
    numeric = (high - low) / (2 * h)
    values, derivatives = line(0.1)
    assert_close(values[1:], np.full(2, numeric[0]), rtol=1e-6)
    # Forwards and backwards, of the value and of its derivatives.
    assert_close(derivatives, np.tile(numeric, 2), rtol=1e-6)


@pytest.mark.parametrize("name", OTHERS)
def test_forwards_over_backwards(name):
    # By the same rules as those above.
    line = functools.partial(total, getattr(dlx.riccati, name), OTHERS[name])
    both = jax.jit(lambda e: jax.jvp(jax.value_and_grad(line), (e,), (1.0,)))
    h = 1e-5
    (low, first_low), (high, first_high) = both(0.1 - h)[0], both(0.1 + h)[0]
    (_, first), (forwards, second) = both(0.1)
    assert_close([first, forwards], np.full(2, (high - low) / (2 * h)), rtol=1e-6)
    assert_close(second, (first_high - first_low) / (2 * h), rtol=1e-6)


@pytest.mark.parametrize("name", ["filter_dare", "filter_care"])
def test_filter(name):
    solve = getattr(dlx.riccati, name)
    pairs = PLAIN[:1] + ((B.T, D_B.T),) + PLAIN[2:]
    line = jax.jit(jax.value_and_grad(lambda e: total(solve, pairs, e)))
    h = 1e-5
    numeric = (line(0.1 + h)[0] - line(0.1 - h)[0]) / (2 * h)
    assert_close(line(0.1)[1], numeric, rtol=1e-6)
