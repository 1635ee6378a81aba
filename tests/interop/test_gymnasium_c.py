"""Gymnasium's single environments with their step in C."""

import copy
import pickle
import warnings

import gymnasium
import jax.numpy as jnp
import numpy as np
import pytest
from gymnasium.error import InvalidAction, ResetNeeded
from gymnasium.utils.env_checker import check_env
from helpers import assert_close, needs_compiler, once, user_error

import delucax as dlx
import delucax.interop.gymnasium as interop


pytestmark = [needs_compiler, once]
KINDS = (
    "Pendulum-v1",  # an angle, which is encoded
    "CartPole-v1",  # integers, and an end
    "MountainCarContinuous-v0",
    "Acrobot-v1",  # a Runge-Kutta step
    "Reacher-v1",  # two controls, and a target with ends
    "DelayLung-v1",  # an observation that is not the state
)


def both(**options):
    """The environment by each backend."""
    env = dlx.make("pendulum", horizon=8, **options)
    return [interop.GymnasiumEnv(env, backend=backend) for backend in ("jax", "c")]


def assert_same_episode(theirs, ours, steps=20):
    """The same seed and actions give the same numbers."""
    theirs.action_space.seed(0)
    first = [env.reset(seed=3)[0] for env in (theirs, ours)]
    assert_close(*first, atol=1e-6)
    for _ in range(steps):
        action = theirs.action_space.sample()
        (y, reward, *ends, _), (y_c, reward_c, *ends_c, _) = (
            env.step(action) for env in (theirs, ours)
        )
        scale = 1e-6 * max(1.0, abs(reward), np.max(np.abs(y)))
        assert_close(y_c, y, atol=scale)
        assert_close(reward_c, reward, atol=scale)
        assert ends_c == ends and all(type(end) is bool for end in ends_c)
        assert y_c.dtype == np.float32 and type(reward_c) is float
        if any(ends):
            break


@pytest.mark.parametrize("name", KINDS)
def test_the_same_numbers(name):
    made = [
        gymnasium.make(f"delucax/{name}", backend=b, disable_env_checker=True)
        for b in ("jax", "c")
    ]
    assert made[1].unwrapped.backend == "c"
    assert_same_episode(*made)


def test_what_is_drawn_is_the_same():
    """Disturbances and noise are drawn when an episode begins, as without C."""
    noise = dlx.disturbances.Gaussian(0.1, size=2)
    final = dlx.costs.Quadratic(jnp.eye(2), jnp.eye(1), final=jnp.eye(2))
    theirs, ours = both(disturbance=noise, sensor_noise=noise, cost=final)
    assert_same_episode(theirs, ours)  # to the end, where the final cost comes
    assert_same_episode(theirs, ours)


def test_check_env():
    env = interop.make("pendulum", backend="c")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warnings.filterwarnings("ignore", ".*symmetric and normalized space")
        check_env(env, skip_render_check=True)


def test_copies_go_their_own_way():
    env = interop.make("pendulum", backend="c")
    env.reset(seed=0)
    env.step([0.5])
    for other in (copy.deepcopy(env), pickle.loads(pickle.dumps(env))):
        before = env.state
        other.step([1.0])
        assert np.array_equal(env.state, before)
        assert not np.array_equal(other.state, before)


def test_what_is_returned_is_the_users_own():
    env = interop.make("pendulum", backend="c")
    env.reset(seed=0)
    first, *_ = env.step([0.5])
    kept = first.copy()
    env.step([0.5])
    assert np.array_equal(first, kept)


def test_bad_input():
    env = interop.make("pendulum", backend="c")
    with pytest.raises(ResetNeeded, match="not begun"):
        env.step([0.5])
    env.reset(options={"state": np.array([0.5, 0.0])})
    for action in ([np.nan], [0.5, 0.5], "left"):
        with pytest.raises(InvalidAction):
            env.step(action)
    assert_close(env.state, [0.5, 0.0], atol=1e-7)  # as it was
    env.step([0.5])
    with user_error(match="backend must be 'jax' or 'c', got 'numpy'"):
        interop.GymnasiumEnv(dlx.make("pendulum"), backend="numpy")


def test_a_simulation_that_fails_says_so():
    class Blowup(dlx.AbstractSystem):
        state_names, control_names = ("x",), ("u",)

        def vector_field(self, t, x, u, w):
            return 1e30 * x**3 + u

    plant = dlx.Discretized(Blowup(), dt=0.1, solver=dlx.dynamics.RK4())
    cost = dlx.costs.Quadratic(jnp.eye(1), jnp.eye(1))
    task = dlx.Environment(plant, cost, initial_state=[1.0])
    env = interop.GymnasiumEnv(task, backend="c")
    env.reset(seed=0)
    with pytest.raises(RuntimeError, match="failed at step 0"):
        env.step([0.0])
    with pytest.raises(ResetNeeded):
        env.step([0.0])


def test_an_environment_that_cannot_be_exported_says_why():
    class Drawn(dlx.AbstractSystem):
        state_names, control_names = ("x",), ("u",)

        def vector_field(self, t, x, u, w):
            return jnp.linalg.eigvalsh(jnp.outer(x, x) + 1.0) + u

    plant = dlx.Discretized(Drawn(), dt=0.1, solver=dlx.dynamics.RK4())
    cost = dlx.costs.Quadratic(jnp.eye(1), jnp.eye(1))
    task = dlx.Environment(plant, cost, initial_state=[1.0])
    with user_error(match="eigh"):
        interop.GymnasiumEnv(task, backend="c")
