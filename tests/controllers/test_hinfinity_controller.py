import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import assert_close, needs_x64, user_error

import delucax as dlx


pytestmark = needs_x64


A = jnp.array([[1.0, 1.0], [0.0, 1.0]])
B = jnp.array([[0.0], [1.0]])
Q, R = jnp.eye(2), jnp.eye(1)
HInfinity = dlx.controllers.HInfinity


def test_stationary():
    controller = HInfinity(dlx.LinearDynamics(A, B), Q, R)
    solution = dlx.riccati.hinf_dare(A, B, None, Q, R)
    assert_close(controller.K, solution.K)
    assert_close(controller.P, solution.X)
    assert_close(controller.L, solution.L)
    assert_close(controller.gamma, 2.9563, atol=1e-4)
    u, _ = controller(0.0, jnp.array([1.0, 2.0]), None)
    assert_close(u, -solution.K @ jnp.array([1.0, 2.0]), rtol=1e-6)


@pytest.mark.parametrize("horizon", [None, 30])
def test_keeps_its_level_against_any_disturbance(horizon, key):
    E = jnp.array([[0.5], [1.0]])
    dynamics = dlx.LinearDynamics(A, B, E=E)
    controller = HInfinity(dynamics, Q, R, gamma=5.0, horizon=horizon)
    env = dlx.Environment(dynamics, dlx.costs.Quadratic(Q, R), horizon=30)
    for w in (jax.random.normal(key, (30, 1)), jnp.ones((30, 1))):
        run = dlx.rollout(env, controller, key=key, x0=jnp.zeros(2), w=w)
        assert run.total_cost < 25.0 * jnp.sum(w**2)
    if horizon is not None:
        beyond = dlx.rollout(env, controller, key=key, horizon=31, throw=False)
        assert beyond.result != dlx.RESULTS.successful


def test_holds_an_operating_point(key):
    # A cart against a constant headwind rests only under a constant push.
    def field(t, x, u, w):
        return jnp.stack([x[1], u[0] - 3.0 - x[1]])

    system = dlx.system(field, states=("position", "velocity"), controls=("push",))
    dynamics = dlx.Discretized(system, dt=0.1)
    x, u = jnp.array([2.0, 0.0]), jnp.array([3.0])
    linear = dlx.linearize(dynamics, 0.0, x, u)
    controller = HInfinity(linear, Q, R, gamma=50.0)
    env = dlx.Environment(dynamics, dlx.costs.Quadratic(Q, R))
    run = dlx.rollout(env, controller, key=key, x0=jnp.zeros(2), horizon=200)
    assert_close(run.final_state, x, atol=1e-3)
    assert_close(run.controls[-1], u, atol=1e-2)


def test_time_varying_about_a_path():
    # Double steps every other time, along a path at constant speed.
    As = jnp.stack([A, A @ A] * 3)
    path = jnp.stack([jnp.array([0.0, 1, 3, 4, 6, 7]), jnp.ones(6)], axis=1)
    reached = jnp.concatenate([path[1:], jnp.array([[9.0, 1.0]])])
    u_ref = jnp.zeros((6, 1))
    dynamics = dlx.LinearDynamics(As, B, x_ref=path, u_ref=u_ref, x_next=reached)
    controller = HInfinity(dynamics, Q, R, gamma=50.0, final=Q)
    solution = dlx.riccati.hinf_dre(As, B, None, Q, R, gamma=50.0, final=Q)
    assert_close(controller.K, solution.K)
    assert_close(controller.P, solution.X)
    off = jnp.array([0.1, -0.2])
    for k in range(6):
        u, _ = controller(float(k), path[k] + off, None)
        close = 1e-12
        assert_close(u, -solution.K[k] @ off, rtol=close, atol=close)
    stray = eqx.tree_at(lambda d: d.x_next, dynamics, reached + 1)
    with user_error(match="each operating point to the next"):
        HInfinity(stray, Q, R, gamma=50.0)


def test_angles_wrap():
    env = dlx.make("pendulum")
    upright = dlx.linearize(env.dynamics)
    difference = env.dynamics.difference
    controller = HInfinity(upright, Q, R, gamma=1e3, difference=difference)
    near, far = jnp.array([0.1, 0.0]), jnp.array([0.1 + 4 * np.pi, 0.0])
    u, _ = controller(0.0, near, None)
    assert_close(controller(0.0, far, None)[0], u, rtol=1e-4)


def test_a_disturbance_without_effect():
    law = HInfinity(dlx.LinearDynamics(A, B, E=np.zeros((2, 1))), Q, R)
    assert law.gamma == 0
    assert_close(law.K, dlx.riccati.dare(A, B, Q, R).K, atol=1e-5)


def test_no_controller():
    with pytest.raises(RuntimeError, match="gamma is below the smallest level"):
        HInfinity(dlx.LinearDynamics(A, B), Q, R, gamma=2.9)


def test_wrong_arguments():
    dynamics = dlx.LinearDynamics(A, B)
    with user_error(match="HInfinity: dynamics must be a LinearDynamics"):
        HInfinity(dlx.make("pendulum").dynamics, Q, R)
    with user_error(match="HInfinity: dynamics must rest"):
        HInfinity(dlx.LinearDynamics(A, B, x_next=[1.0, 0.0]), Q, R)
    with user_error(match="HInfinity: dynamics must observe"):
        HInfinity(dlx.LinearDynamics(A, B, C=[[1.0, 0.0]]), Q, R)
    with user_error(match="final must not be given without a horizon"):
        HInfinity(dynamics, Q, R, final=Q)
    with user_error(match="horizon must be a whole number"):
        HInfinity(dynamics, Q, R, horizon=0)
    with user_error(match=r"Q must have shape \(2, 2\)"):
        HInfinity(dynamics, jnp.eye(3), R)
