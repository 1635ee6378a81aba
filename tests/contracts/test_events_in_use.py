"""What stands on a plant works through its events: identification, training, model
predictive control and Gymnasium."""

import jax
import jax.numpy as jnp
import numpy as np
import optax
from helpers import assert_close, needs_compiler, needs_x64, once

import delucax as dlx
from delucax.training import expected_cost, fit, sysid


START = jnp.array([1.0, 0.0])


def ball(**fields):
    return dlx.Discretized(dlx.systems.BouncingBall(**fields), dt=0.1)


def task(**options):
    """A ball falls near the floor, bounces, and is to rise higher than it was, by a
    force that is less than its weight."""
    cost = dlx.costs.Quadratic([1.0, 0.01], [1e-3], state_target=[1.0, 0.0])
    options = dict(initial_state=jnp.array([0.3, -2.0]), horizon=12) | options
    return dlx.Environment(ball(), cost, control_bounds=(-8.0, 8.0), **options)


@needs_x64
def test_restitution_and_gravity_are_identified():
    controls = 2 * jax.random.normal(jax.random.key(0), (16, 1))
    states = dlx.open_loop(ball(restitution=0.7, gravity=9.0), START, controls)
    names = ["system.restitution", "system.gravity"]
    record = sysid.Record(states, controls, dt=ball().dt)
    found = sysid.physical(ball(), record, names, window=8)
    assert_close(found.model.system.restitution, 0.7, rtol=1e-8)
    assert_close(found.model.system.gravity, 9.0, rtol=1e-8)


@once
def test_a_policy_is_trained_through_a_bounce():
    env, key = task(), jax.random.key(0)
    policy = dlx.controllers.mlp_policy(env, width=16, depth=1, key=key)
    loss = expected_cost(env, batch=1)
    options = dict(steps=40, key=key, progress=False)
    fitted = fit(loss, policy, optax.adam(0.03), **options)
    assert fitted.history.loss[-1] < 0.9 * fitted.history.loss[0]


@once
def test_model_predictive_control_through_a_bounce():
    env, key = task(), jax.random.key(0)
    planner = dlx.planning.ILQR(max_iterations=8)
    options = dict(planner=planner, bounds=env.control_bounds)
    mpc = dlx.controllers.MPC(env.dynamics, env.cost, 6, **options)
    run = dlx.rollout(env, mpc, key=key, keep=("states", "events"))
    assert np.sum(run.events.kinds >= 0) >= 1
    zero = dlx.rollout(env, dlx.controllers.Zero(1), key=key)
    assert run.total_cost < 0.9 * zero.total_cost


@once
@needs_compiler
def test_gymnasium_in_both_backends():
    import delucax.interop.gymnasium as interop

    env = task(initial_state=dlx.environments.UniformState([0.5, -1.0], [1.0, 1.0]))
    ours, in_c = (interop.GymnasiumEnv(env, backend=b) for b in ("jax", "c"))
    assert_close(*(e.reset(seed=3)[0] for e in (ours, in_c)), atol=1e-6)
    lowest = np.inf
    for k in range(12):
        action = np.array([np.sin(k)], np.float32)
        (y, reward, *_), (y_c, reward_c, *_) = (e.step(action) for e in (ours, in_c))
        assert_close(y_c, y, atol=1e-5)
        assert_close(reward_c, reward, atol=1e-4)
        lowest = min(lowest, y[0])
    assert -1e-5 < lowest < 0.4
