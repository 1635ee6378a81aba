"""The tasks of plants with events: no control makes them fail, and what they say."""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import assert_close, needs_x64, once

import delucax as dlx


NAMES = "bouncing_ball compass_gait rimless_wheel stick_slip thermostat".split()
NAMES += ["valve_with_stops"]


@once
@pytest.mark.parametrize("name", NAMES)
def test_no_control_makes_it_fail(name, key):
    """None at all, constants, noise, and switching between the bounds, fast or slow."""
    env, rng = dlx.make(name), np.random.default_rng(0)
    low, high = (float(bound) for bound in env.control_bounds)
    shape = (3, env.horizon, 1)
    ends = rng.choice([low, high], (2, *shape))
    ends[1] = np.repeat(ends[1][:, ::10], 10, axis=1)
    held = [np.full(shape, value) for value in (0.0, low, high)]
    controls = np.concatenate([*held, rng.uniform(low, high, shape), *ends])

    def cost(controls, key):
        held = dlx.controllers.OpenLoop(controls)
        keep = "terminated" if env.terminated else ()
        run = dlx.rollout(env, held, key=key, keep=keep, throw=False)
        return run.total_cost, (run.failed, run.length)

    # One has gradients, too: that with the most events.
    both = name == "valve_with_stops"
    episode = jax.value_and_grad(cost, has_aux=True) if both else cost
    given = jnp.asarray(controls), jax.random.split(key, len(controls))
    found = jax.jit(jax.vmap(episode))(*given)
    (costs, (failed, length)), gradients = found if both else (found, 1.0)
    assert not np.any(failed)
    assert np.all(np.isfinite(costs)) and np.all(np.isfinite(gradients))
    assert np.all(np.any(np.atleast_3d(gradients) != 0, axis=(1, 2)))
    # Without control a ball comes to rest; the wheel and the walker go on.
    over = np.asarray(length) < env.horizon
    assert np.all(over[:3] == (name == "bouncing_ball"))
    assert np.any(over[3:]) == (env.terminated is not None)


@needs_x64
@pytest.mark.parametrize("name", ["compass_gait", "rimless_wheel"])
def test_gradient(name, key):
    """Of the cost of an episode with several events, with respect to the controls and
    the start, along a direction."""
    env, rng = dlx.make(name), np.random.default_rng(1)
    z = jnp.asarray(0.2 * rng.normal(size=(80 + env.state_size)))
    z = z.at[80:].set(env.reset(key))
    way = jnp.asarray(rng.normal(size=z.size))

    def cost(z):
        held = dlx.controllers.OpenLoop(z[:80, None])
        options = dict(x0=z[80:], horizon=80, keep="events")
        run = dlx.rollout(env, held, key=key, **options)
        return run.total_cost, jnp.sum(run.events.kinds >= 0)

    both, h = jax.jit(jax.value_and_grad(cost, has_aux=True)), 1e-6
    (_, count), gradient = both(z)
    up, down = (both(z + step * way)[0][0] for step in (h, -h))
    assert count >= 2
    assert_close(gradient @ way, (up - down) / (2 * h), rtol=1e-6)


@once
def test_a_force_in_the_direction_of_motion_lifts_the_ball(key):
    env = dlx.make("bouncing_ball")
    pump = dlx.controllers.Linear(jnp.array([[0.0, -100.0]]))
    x = dlx.rollout(env, pump, key=key).final_state
    assert x[0] + x[1] ** 2 / (2 * 9.81) > 2.0


@functools.cache
def passive(slope):
    """Times of steps and the end of the walker without a motor."""
    env = dlx.make("compass_gait", slope=slope, max_torque=0.0)
    zero, keep = dlx.controllers.Zero(1), ("states", "terminated", "events")
    run = dlx.rollout(env, zero, key=jax.random.key(3), keep=keep)
    return [time for time, _ in run.event_list()], bool(run.terminated[-1])


@once
def test_a_walker_without_a_motor_walks_downhill_alone():
    times, ends = passive(np.deg2rad(3.0))
    assert len(times) == 13 and not ends
    # The period of the passive gait, which it comes to.
    assert_close(np.mean(np.diff(times[-4:])), 0.7347, atol=1e-3)
    assert passive(-0.02)[1]


@once
def test_targets_are_where_it_is_said():
    env = dlx.make("stick_slip", kinetic=1.2)
    x, u = env.dynamics.equilibrium()
    assert env.cost(0.0, x, u) == 0
    assert_close(env.dynamics(0.0, x, u), x, atol=1e-6)
    step = eqx.filter_jit(dlx.make("valve_with_stops").step)
    on_stop = jnp.array([1.0, 0.0, 2.0])
    for force, mode in ((19.6, 2), (19.4, 0)):
        assert step(0.0, on_stop, jnp.array([force])).state[2] == mode
    env = dlx.make("compass_gait", slope=0.1)
    upright = jnp.array([0.0, -0.1, 0.0, -0.73])
    assert_close(env.cost(0.0, upright, jnp.zeros(1)), 0.0, atol=1e-10)
