"""Our pendulum against Gymnasium's."""

import diffrax
import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import assert_close, needs_x64, once

import delucax as dlx


@pytest.fixture
def gym():
    return gymnasium.make("Pendulum-v1").unwrapped


@needs_x64
def test_one_step_agrees_on_many_states(gym):
    n = 10_000
    env = dlx.make("pendulum")
    rng = np.random.default_rng(0)
    states = np.stack([rng.uniform(-10, 10, n), rng.uniform(-8, 8, n)], axis=1)
    actions = rng.uniform(-3, 3, (n, 1))
    step = jax.jit(jax.vmap(lambda x, u: env.step(0.0, x, u)))(states, actions)
    features = jax.jit(jax.vmap(env.encode))(step.state)
    found = np.empty((n, 2))
    rewards = np.empty(n)
    seen = np.empty((n, 3), np.float32)
    gym.reset(seed=0)
    for i in range(n):
        gym.state = states[i]
        seen[i], rewards[i], terminated, truncated, _ = gym.step(actions[i])
        assert not terminated and not truncated
        found[i] = gym.state
    assert np.max(np.abs(found - step.state)) <= 1e-12
    assert np.max(np.abs(rewards + step.cost)) <= 1e-12
    np.testing.assert_array_equal(seen, np.asarray(features).astype(np.float32))


@needs_x64
def test_whole_episodes_agree(gym):
    count = 20
    env = dlx.make("pendulum")
    actions = np.random.default_rng(1).uniform(-2, 2, (count, 200, 1))
    states, totals = np.empty((count, 201, 2)), np.zeros(count)
    for seed in range(count):
        gym.reset(seed=seed)
        states[seed, 0] = gym.state
        for k, u in enumerate(actions[seed]):
            _, reward, *_ = gym.step(u)
            states[seed, k + 1] = gym.state
            totals[seed] -= reward

    @jax.vmap
    def replay(x0, actions):
        sequence = dlx.controllers.OpenLoop(actions)
        return dlx.rollout(env, sequence, key=jax.random.key(0), x0=x0)

    runs = jax.jit(replay)(states[:, 0], actions)
    assert np.max(np.abs(states - runs.states)) <= 1e-6
    assert_close(runs.total_cost, totals, rtol=1e-6)


@once
def test_start_is_gyms(key):
    env = dlx.make("classic/pendulum")
    x0 = jax.vmap(env.reset)(jax.random.split(key, 2000))
    assert np.all(np.abs(x0) <= np.array([np.pi + 1e-6, 1.0]))
    assert_close(x0.std(axis=0), np.array([np.pi, 1.0]) / np.sqrt(3), rtol=0.05)


def test_observation_bounds_are_gyms(gym):
    low, high = dlx.make("pendulum").observation_bounds
    np.testing.assert_array_equal(np.asarray(high), gym.observation_space.high)
    np.testing.assert_array_equal(np.asarray(low), gym.observation_space.low)
    free = dlx.make("pendulum", solver=diffrax.Heun()).observation_bounds
    np.testing.assert_array_equal(np.asarray(free[1]), [1.0, 1.0, np.inf])
    # What moves what is seen takes the task's bounds away.
    noisy = dlx.disturbances.Gaussian(0.1, size=2)
    plain = dlx.make("pendulum", encode=lambda y: y)
    for env in (plain, dlx.make("pendulum", sensor_noise=noisy)):
        assert env.observation_bounds is None
    own = dlx.make("pendulum", encode=lambda y: y, observation_bounds=(-9.0, 9.0))
    assert own.observation_bounds[1] == 9


@once
def test_bounds_and_cost(key):
    env = dlx.make("pendulum")
    push = dlx.controllers.Constant(jnp.array([5.0]))
    run = dlx.rollout(env, push, key=key, horizon=3, x0=jnp.array([0.5, 0.0]))
    assert np.all(run.controls == 2.0)
    assert_close(run.costs[0], 0.25 + 0.001 * 4, rtol=1e-6)


@once
def test_arguments_reach_the_physics():
    env = dlx.environments.pendulum(
        dlx.systems.Pendulum(2.0, 1.5, 9.81, 0.1),
        dt=0.02,
        horizon=7,
        max_torque=3.0,
        max_speed=4.0,
    )
    system = env.dynamics.system
    found = [system.mass, system.length, system.gravity, system.damping]
    assert_close(found, [2.0, 1.5, 9.81, 0.1], rtol=1e-6)
    assert env.horizon == 7
    assert_close(env.dt, 0.02, rtol=1e-6)
    assert_close(env.control_bounds[1], 3.0)
    fast = env.step(0.0, jnp.array([np.pi / 2, 3.99]), jnp.array([3.0]))
    assert fast.state[1] == 4.0


@needs_x64
def test_a_solver_swaps_the_arithmetic():
    env = dlx.make("pendulum", solver=dlx.dynamics.RK4(), substeps=8)
    system = env.dynamics.system
    x0 = jnp.array([1.0, 0.5])
    zero = dlx.controllers.Zero(1)
    run = dlx.rollout(env, zero, key=jax.random.key(0), x0=x0, horizon=100)
    energy = 0.5 * run.states[:, 1] ** 2 / 3 + 5.0 * jnp.cos(run.states[:, 0])
    assert_close(energy, energy[0] * jnp.ones(101), rtol=1e-7)
    assert isinstance(system, dlx.systems.Pendulum)
    with pytest.raises(ValueError, match="substeps"):
        dlx.make("pendulum", substeps=2)


@once
@pytest.mark.parametrize(
    "arguments, match",
    [
        ({"length": 0.0}, "length must be positive"),
        ({"mass": -1.0}, "mass must be positive"),
        ({"gravity": float("nan")}, "gravity must be finite"),
        ({"dt": 0.0}, "dt must be positive"),
        ({"max_speed": -1.0}, "max_speed must be positive"),
        ({"max_torque": -1.0}, "max_torque must be at least 0"),
        ({"horizon": 0}, "horizon must be a whole number of at least 1"),
    ],
)
def test_bad_arguments(arguments, match):
    with pytest.raises(ValueError, match=match):
        dlx.make("pendulum", **arguments)


def test_it_runs_in_the_precision_of_the_session():
    env = dlx.make("pendulum")
    run = dlx.rollout(env, dlx.controllers.Zero(1), key=jax.random.key(0), horizon=2)
    assert run.states.dtype == jnp.zeros(()).dtype
