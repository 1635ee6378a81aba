"""The designs that an environment defines."""

import equinox as eqx
import jax
import jax.numpy as jnp
from helpers import assert_close, needs_x64, user_error

import delucax as dlx
from delucax.controllers import local_lqr, local_model, local_mpc


pytestmark = needs_x64

A, B = jnp.array([[1.0, 0.1], [0.0, 1.0]]), jnp.array([[0.0], [0.1]])
Q, R = jnp.diag(jnp.array([2.0, 1.0])), 0.5 * jnp.eye(1)
S = jnp.array([[0.1], [-0.2]])


def _environment(**options):
    """A linear plant that is to rest off the origin, for a cost with a product."""

    def stage(t, x, u):
        x = x - jnp.array([3.0, 0.0])
        return x @ Q @ x + 2 * x @ S @ u + u @ R @ u

    cost = dlx.costs.Function(stage)
    dynamics = dlx.LinearDynamics(A, B, x_ref=jnp.array([3.0, 0.0]), **options)
    x0 = jnp.array([2.0, 0.5])
    return dlx.Environment(dynamics, cost, initial_state=x0, horizon=40)


def test_the_model_is_that_of_a_quadratic_task():
    model = local_model(_environment())
    assert_close(model.dynamics.x_ref, [3.0, 0.0])
    for name, expected in dict(Q=Q, R=R, S=S).items():
        assert_close(getattr(model, name), expected, atol=1e-12)
    exact = dlx.controllers.LQR(dlx.LinearDynamics(A, B), Q, R, S)
    assert_close(local_lqr(_environment()).K, exact.K, atol=1e-10)


def test_plans_end_with_the_cost_to_go():
    # Of a quadratic task the LQR is optimal, and so is a short plan that ends with it.
    env = _environment()
    lqr = local_lqr(env)
    cost = lambda one: dlx.rollout(env, one, key=jax.random.key(0)).total_cost
    assert_close(cost(local_mpc(env, lqr, horizon=3)), cost(lqr), rtol=1e-9)
    assert cost(local_mpc(env, horizon=3)) > 1.01 * cost(lqr)


def test_a_plan_starts_from_the_lqr_after_a_turn():
    env = dlx.make("pendulum")
    mpc = local_mpc(env, local_lqr(env), planner=dlx.planning.ILQR(1))
    angles = jnp.array([0.1, 0.1 + 2 * jnp.pi])
    act = jax.jit(lambda angle: mpc(0.0, jnp.array([angle, 0.0]), mpc.init())[0])
    assert_close(*map(act, angles), atol=1e-9)


def test_the_point_is_the_target_of_the_cost():
    # This motor is to turn; at the rest of its plant its LQR would hold it.
    env = dlx.make("permanent_magnet_motor")
    (speed,) = [x for x in local_lqr(env).x_ref if jnp.abs(x) > 50.0]
    run = dlx.rollout(env, local_lqr(env), key=jax.random.key(0), keep=("states",))
    assert jnp.min(jnp.abs(run.states[-1] - speed)) < 1e-2 * jnp.abs(speed)


def test_bad_input():
    half = _environment(C=jnp.eye(2)[:1])
    for call, match in (
        (lambda: local_mpc(half), "local_mpc: environment must observe its state"),
        (lambda: local_lqr(half), "LQR: dynamics must observe their state"),
        (lambda: local_mpc(_environment(), 3), "local_mpc: lqr must be a LQR"),
        (lambda: local_mpc(3), "local_mpc: environment must be an Environment"),
        (
            lambda: eqx.filter_jit(local_model)(_environment()),
            "local_model: environment must hold values",
        ),
        (lambda: local_model(3), "local_model: environment must be an Environment"),
        (
            lambda: local_lqr(_environment(), regularisation=0.0),
            "local_lqr: regularisation must be positive",
        ),
    ):
        with user_error(match=match):
            call()
