"""Adversaries: one that searches, and one that sees the state."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import assert_close, needs_x64, user_error

import delucax as dlx


pytestmark = needs_x64


A, B = np.array([[1.0, 1.0], [0.0, 1.0]]), np.array([[0.0], [1.0]])
Q, R = np.eye(2), np.eye(1)
PLANT = dlx.LinearDynamics(A, B)
COST = dlx.costs.Quadratic(Q, R)
ENV = dlx.Environment(PLANT, COST, horizon=30)
KEY = jax.random.key(0)


@functools.cache
def lqr():
    return dlx.controllers.LQR(PLANT, Q, R)


@jax.jit
@jax.vmap
@jax.value_and_grad
def costs(w):
    run = dlx.rollout(ENV, lqr(), key=KEY, x0=jnp.zeros(2), w=w, keep=())
    return run.total_cost


def test_no_bounded_sequence_is_worse():
    options = dict(key=KEY, bound=0.5, x0=np.zeros(2))
    found = dlx.training.worst_case(ENV, lqr(), **options)
    assert_close(np.linalg.norm(found.w, axis=1), 0.5, rtol=1e-12)
    assert np.all(np.diff(found.costs) > -1e-9)
    rng = np.random.default_rng(0)
    tried = rng.normal(size=(200, 30, 2))
    tried *= 0.5 / np.linalg.norm(tried, axis=2, keepdims=True)
    steady = np.stack([[np.cos(a), np.sin(a)] for a in np.linspace(0, 2 * np.pi, 60)])
    steady = np.broadcast_to(0.5 * steady[:, None], (60, 30, 2))
    values = costs(np.concatenate([[found.w], tried, steady]))
    (own, *others), (g, *_) = map(np.asarray, values)
    assert_close(found.total_cost, own, rtol=1e-12)
    assert found.total_cost > 1.0001 * np.max(others)
    # A local maximum: each step already goes along its own gradient.
    along = np.sum(g * found.w, axis=1)
    assert_close(along, 0.5 * np.linalg.norm(g, axis=1), rtol=1e-3, atol=1e-2)


class Learner(dlx.AbstractController):
    """Its gain follows what it sees, so that the cost of an attack is not convex."""

    def init(self, *, key=None):
        return jnp.array([0.4, 1.2])

    def __call__(self, t, y, state):
        return -(state @ y)[None], state + 0.05 * y[0] * y / (1 + y @ y)


def test_a_learner_under_attack():
    options = dict(key=KEY, bound=0.5, x0=np.zeros(2), iterations=5)
    found = dlx.training.worst_case(ENV, Learner(), **options)
    assert found.total_cost == np.max(found.costs)
    assert found.total_cost > found.costs[0]


def test_a_plant_that_runs_away_is_the_worst_case():
    class Cubic(dlx.AbstractSystem):
        state_names, control_names, disturbance_names = ("x", "y"), (), ("w",)

        def vector_field(self, t, x, u, w):
            return jnp.stack([x[1] - x[0], x[1] ** 3 + w[0]])

    # The cost of an infinite state that has no weight is NaN.
    cost = dlx.costs.Quadratic([1.0, 0.0], [])
    env = dlx.Environment(dlx.Discretized(Cubic(), 0.1), cost, horizon=60)
    zero = dlx.controllers.Zero(0)
    options = dict(key=KEY, bound=0.3, x0=[0.0, 0.5], iterations=3, starts=4)
    found = dlx.training.worst_case(env, zero, **options)
    assert found.total_cost == np.inf
    again = dlx.rollout(env, zero, key=KEY, x0=[0.0, 0.5], w=found.w, throw=False)
    assert again.failed


def test_the_value_of_the_game():
    """With both sides of the H-infinity game at their best, what the control pays less
    what the adversary spends is x0' X x0."""
    robust = dlx.controllers.HInfinity(PLANT, Q, R, gamma=4.0)
    game = dlx.riccati.hinf_dare(A, B, np.eye(2), Q, R, gamma=4.0)
    attacked = dlx.dynamics.WorstCase(PLANT, robust.L)
    env = dlx.Environment(attacked, COST, horizon=400)
    x0 = jnp.array([1.0, -0.5])
    run = dlx.rollout(env, robust, key=KEY, x0=x0)
    spent = jax.vmap(attacked.attack)(run.states[:-1])
    value = run.total_cost - 16 * np.sum(np.asarray(spent) ** 2)
    assert_close(value, x0 @ game.X @ x0, rtol=1e-9)
    bounded = dlx.dynamics.WorstCase(PLANT, robust.L, bound=0.1)
    assert_close(np.linalg.norm(bounded.attack(10 * x0)), 0.1, rtol=1e-12)
    weak = np.asarray(spent[-1])
    assert_close(bounded.attack(run.states[-2]), weak, rtol=1e-12)
    far = jax.grad(lambda x: jnp.sum(bounded.attack(x)))(jnp.zeros(2))
    assert np.all(np.isfinite(far))


@pytest.mark.parametrize(
    "make, match",
    [
        (lambda: dlx.dynamics.WorstCase(3, np.eye(2)), "dynamics must be an Abstract"),
        (lambda: dlx.dynamics.WorstCase(PLANT, np.eye(3)), r"L must have shape \(2, 2"),
        (
            lambda: dlx.dynamics.WorstCase(PLANT, np.eye(2), bound=0.0),
            "bound must be positive",
        ),
        (
            lambda: dlx.training.worst_case(ENV, lqr(), key=KEY, bound=-1.0),
            "worst_case: bound must be positive",
        ),
        (
            lambda: dlx.training.worst_case(ENV, 3, key=KEY, bound=1.0),
            "controller must be an AbstractController",
        ),
        (
            lambda: dlx.training.worst_case(ENV, lqr(), key=KEY, bound=1.0, x0=[1.0]),
            r"x0 must have shape \(2,\)",
        ),
    ],
)
def test_bad_input(make, match):
    with user_error(match=match):
        make()
