"""The harder tasks: no control breaks them, and a plan or MPC solves them."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import assert_close, needs_x64, once

import delucax as dlx
from delucax.environments._registry import TASKS


NAMES = TASKS["_hard"].split()


@once
@pytest.mark.parametrize("name", NAMES)
def test_no_control_breaks_it(name, key):
    """None at all, constants, noise, and switching between the bounds: the costs of
    whole episodes and their gradients are finite, in the precision that overflows
    first."""
    env, rng = dlx.make(name), np.random.default_rng(0)
    m = env.control_size
    low, high = (np.broadcast_to(bound, m) for bound in env.control_bounds)
    shape = (3, env.horizon, m)
    none = np.clip(0.0, low, high)
    held = [np.broadcast_to(value, shape) for value in (none, low, high)]
    ends = np.where(rng.uniform(size=shape) < 0.5, low, high)
    controls = np.concatenate([*held, rng.uniform(low, high, shape), ends])

    def cost(controls, key):
        held = dlx.controllers.OpenLoop(controls)
        run = dlx.rollout(env, held, key=key, keep=(), throw=False)
        return run.total_cost, (run.failed, run.length)

    given = jnp.asarray(controls), jax.random.split(key, len(controls))
    episode = jax.jit(jax.vmap(jax.value_and_grad(cost, has_aux=True)))
    (costs, (failed, length)), gradients = episode(*given)
    assert not np.any(failed)
    assert np.all(np.isfinite(costs)) and np.all(np.isfinite(gradients))
    assert np.all(np.any(gradients != 0, axis=(1, 2)))
    # The carts leave their tracks, and the reactor runs away: that costs more.
    over = np.asarray(length) < env.horizon
    assert np.any(over) == (env.terminated is not None)
    if env.terminated:
        assert np.min(costs[over]) > np.max(costs[:3])


@once
def test_angles_go_all_the_way_around():
    """A turn more costs the same and looks the same; half a turn costs the most."""
    env = dlx.make("double_pendulum_cart")
    u, turn = jnp.zeros(1), jnp.zeros(6).at[1:3].set(2 * np.pi)
    x = jnp.array([0.1, 0.2, -0.3, 0.4, 0.5, 0.6])
    assert_close(env.cost(0.0, x + turn, u), env.cost(0.0, x, u), rtol=1e-5)
    assert_close(env.encode(x + turn), env.encode(x), atol=1e-5)
    hanging = jnp.zeros(6).at[1].set(np.pi)
    assert_close(env.cost(0.0, hanging, u), 4.0, rtol=1e-6)
    # The cable of an arm that turns is wound up.
    assert dlx.make("furuta").cost(0.0, jnp.array([7.0, 0, 0, 0]), u) > 4


@needs_x64
@pytest.mark.parametrize("name", [name for name in NAMES if name != "drift"])
def test_mpc_solves_it_and_the_regulator_does_not(name, key):
    """The plant is at its target at the end of the episode."""
    env = dlx.make(name)
    lqr = dlx.controllers.local_lqr(env)
    # The pushes of the Furuta pendulum take longer than the others.
    steps = 50 if name == "furuta" else 30
    mpc = dlx.controllers.local_mpc(env, lqr, horizon=steps, throw=False)
    run = dlx.rollout(env, mpc, key=key)
    off = lambda run: env.dynamics.difference(run.final_state, lqr.x_ref)
    assert run.length == env.horizon
    assert_close(off(run), np.zeros(env.state_size), atol=0.1)
    alone = dlx.rollout(env, lqr, key=key, x0=run.states[0], throw=False)
    assert not np.all(np.abs(off(alone)) < 1)


@needs_x64
def test_a_plan_enters_the_drift_and_the_regulator_does_not(key):
    env = dlx.make("drift")
    x0 = jnp.array([9.0, 0.0, 0.0])
    lqr = dlx.controllers.local_lqr(env)
    alone = dlx.rollout(env, lqr, key=key, x0=x0)
    guess, bounds = alone.controls, env.control_bounds
    options = dict(bounds=bounds, max_iterations=200, throw=False)
    plan = dlx.planning.ilqr(env.dynamics, env.cost, x0, guess, **options)
    target, _ = env.cost.targets
    assert plan.cost < 300 < 1000 < alone.total_cost
    assert_close(plan.states[-30:], np.tile(target, (30, 1)), atol=0.05)
    # The regulator holds it once it is there.
    near = target + jnp.array([0.2, 0.1, -0.05])
    held = dlx.rollout(env, lqr, key=key, x0=near)
    assert_close(held.final_state, target, atol=0.05)
