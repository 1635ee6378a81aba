"""Derivatives of the Riccati solvers to second order, and their compiled solutions.

`test_finite_horizon.py` and `test_hinfinity.py` have those of the others.
"""

import functools

import jax.numpy as jnp
import numpy as np
import pytest
from helpers import assert_close, check_first_order, check_second_order, needs_x64

import delucax as dlx


pytestmark = needs_x64


# Each with the direction in which it moves.
A = np.array([[0.6, 0.3], [-0.2, -0.9]]), np.array([[0.4, -1.0], [0.3, 0.7]])
B = np.array([[1.0], [0.5]]), np.array([[-0.3], [0.8]])
Q = np.array([[2.0, 0.3], [0.3, 1.0]]), np.array([[0.5, -0.2], [-0.2, 0.9]])
R = np.array([[1.0]]), np.array([[1.0]])
S = np.array([[0.1], [-0.2]]), np.array([[0.6], [0.2]])
E = np.array([[1.1, 0.1], [0.0, 0.9]]), np.array([[0.2, -0.4], [0.5, 0.1]])
C = B[0].T, B[1].T

rng = np.random.default_rng(0)
LEFT, RIGHT = rng.normal(size=(2, 2, 2)) / 4, rng.normal(size=(2, 1, 1)) / 4
SQUARE, TALL = rng.normal(size=(2, 2, 2)), rng.normal(size=(2, 2, 1))
STABLE = LEFT[0] - np.eye(2), LEFT[1]
PROBLEMS = {
    "dare": (A, B, Q, R, S, E),
    "care": (A, B, Q, R, S, E),
    "filter_dare": (A, C, Q, R, S),
    "filter_care": (A, C, Q, R, S),
    "lyap": (STABLE, SQUARE),
    "dlyap": (LEFT, SQUARE),
    "sylvester": (STABLE, RIGHT, TALL),
    "dsylvester": (LEFT, RIGHT, TALL),
}


def test_every_solver_is_here():
    public = {name for name in dir(dlx.riccati) if name.islower() and name[0] != "_"}
    solvers = {name for name in public if callable(getattr(dlx.riccati, name))}
    elsewhere = {"dre", "cre", "hinf_dare", "hinf_care", "hinf_dre", "hinf_cre"}
    assert solvers == set(PROBLEMS) | elsewhere


def line(name, e):
    """A number of the solution, as all arguments move at once."""
    moved = (M + e * step for M, step in PROBLEMS[name])
    solution = getattr(dlx.riccati, name)(*moved, throw=False)
    value = jnp.sum(jnp.sin(solution.X))
    return value + jnp.sum(jnp.cos(getattr(solution, "K", 0.0)))


@pytest.mark.parametrize("name", ["dare", "dlyap", "sylvester"])
def test_to_second_order(name):
    """Quadratic equations go by one rule, and linear ones by another, each in both
    times. `test_bad_members.py` has the gradient in continuous time."""
    of = functools.partial(line, name)
    compiled = check_second_order(of, backwards=name == "sylvester")
    assert_close(compiled, of(0.1), rtol=1e-11)


def test_filter():
    """Which is a regulator's equation, transposed."""
    of = functools.partial(line, "filter_care")
    assert_close(check_first_order(of), of(0.1), rtol=1e-11)
