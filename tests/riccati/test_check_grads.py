"""Second derivatives of every solver, in each order of the two modes."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import needs_x64
from jax.test_util import check_grads

import delucax as dlx


pytestmark = needs_x64


rng = np.random.default_rng(0)
# Each with the direction in which it moves.
A = np.array([[0.6, 0.3], [-0.2, -0.9]]), np.array([[0.4, -1.0], [0.3, 0.7]])
B = np.array([[1.0], [0.5]]), np.array([[-0.3], [0.8]])
D = np.array([[0.3], [0.5]]), np.array([[-0.2], [0.1]])
Q = np.array([[2.0, 0.3], [0.3, 1.0]]), np.array([[0.5, -0.2], [-0.2, 0.9]])
R = np.eye(1), np.eye(1)
S = np.array([[0.1], [-0.2]]), np.array([[0.6], [0.2]])
GAMMA = np.asarray(8.0), np.asarray(1.0)
TRANSPOSED = B[0].T, B[1].T
LEFT, RIGHT = rng.normal(size=(2, 3, 3)) / 6, rng.normal(size=(2, 2, 2)) / 4
STABLE = LEFT[0] - np.eye(3), LEFT[1]
SQUARE, TALL = rng.normal(size=(2, 3, 3)), rng.normal(size=(2, 3, 2))

solvers = dlx.riccati
TIMES = [0.0, 1.0]
FINAL = {"final": Q[0]}


def game(solve, **options):
    def call(A, B, D, Q, R, gamma):
        return solve(A, B, D, Q, R, gamma=gamma, throw=False, **options)

    return call, (A, B, D, Q, R, GAMMA)


def horizon(solve, **options):
    return lambda A, B, Q, R: solve(A, B, Q, R, **FINAL, **options), (A, B, Q, R)


CASES = {
    "dare": (solvers.dare, (A, B, Q, R, S)),
    "care": (solvers.care, (A, B, Q, R, S)),
    "filter_dare": (solvers.filter_dare, (A, TRANSPOSED, Q, R, S)),
    "filter_care": (solvers.filter_care, (A, TRANSPOSED, Q, R, S)),
    "lyap": (solvers.lyap, (STABLE, SQUARE)),
    "dlyap": (solvers.dlyap, (LEFT, SQUARE)),
    "sylvester": (solvers.sylvester, (STABLE, RIGHT, TALL)),
    "dsylvester": (solvers.dsylvester, (LEFT, RIGHT, TALL)),
    "dre": horizon(solvers.dre, horizon=4),
    "dre in parallel": horizon(solvers.dre, horizon=4, parallel=True),
    "cre": horizon(solvers.cre, times=TIMES),
    "hinf_dare": game(solvers.hinf_dare),
    "hinf_care": game(solvers.hinf_care),
    "hinf_dre": game(solvers.hinf_dre, horizon=3, **FINAL),
    "hinf_cre": game(solvers.hinf_cre, times=TIMES),
}


def test_every_solver_is_here():
    public = {name for name in dir(solvers) if name.islower() and name[0] != "_"}
    named = {name.split()[0] for name in CASES}
    assert {name for name in public if callable(getattr(solvers, name))} == named


@pytest.mark.parametrize("solve, pairs", CASES.values(), ids=CASES)
def test_check_grads(solve, pairs):
    def line(e):
        solution = solve(*(M + e * step for M, step in pairs))
        parts = (getattr(solution, name, None) for name in ("X", "K", "L"))
        return sum(jnp.sum(jnp.sin(part)) for part in parts if part is not None)

    modes = ("fwd", "rev")
    check_grads(jax.jit(line), (0.1,), 2, modes=modes, rtol=1e-6, eps=1e-5)
