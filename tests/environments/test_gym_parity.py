"""Our tasks against Gymnasium's own, stepped from the same states."""

import copy
import math
from collections.abc import Callable
from typing import Any, NamedTuple

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from gymnasium.envs.classic_control.cartpole import CartPoleVectorEnv
from helpers import needs_x64

import delucax as dlx


pytestmark = needs_x64


def box(*high):
    high = np.array(high)
    return lambda rng, n: rng.uniform(-high, high, (n, len(high)))


def valley(rng, n):
    """The valley, and more than a few states against its walls and limits."""
    states = rng.uniform([-1.2, -0.07], [0.6, 0.07], (n, 2))
    states[: n // 50, 0] = -1.2
    states[n // 50 : n // 25, 1] = 0.07
    states[n // 25 : n // 20, 1] = -0.07
    return states


def as_stored(rng, n):
    return valley(rng, n).astype(np.float32)


def swung(rng, n):
    """States of episodes in which the acrobot is swung up to its top speed.

    In the corners of the box of all speeds one step magnifies a rounding of the state
    to 1e-10, Gymnasium's own step too.
    """
    gym = gym_of(CASES["acrobot"])
    states = np.empty((n, 4))
    for i in range(n):
        if i % 300 == 0:
            gym.reset(seed=int(rng.integers(1000)))
        states[i] = gym.state
        chance = rng.uniform() < 0.3
        gym.step(rng.integers(3) if chance else 2 * int(gym.state[3] > 0))
    return states


def integers(count):
    return lambda rng, n: rng.integers(0, count, n)


def pushes(rng, n):
    return rng.uniform(-1, 1, (n, 1))


class Case(NamedTuple):
    gym: str
    task: str
    states: Callable[..., Any]
    actions: Callable[..., Any]
    one_step: float
    episode: float
    # What keeps an episode going, or brings it to its goal, where chance would not; and
    # how often it is asked. (Always, it would hold the pole for 10 s, in which a
    # rounding grows by e^38 when only the forces are replayed.)
    policy: Callable[..., Any]
    share: float


def lean(x):
    return int(x[2] + 0.3 * x[3] + 0.05 * x[0] + 0.1 * x[1] > 0)


CASES = {
    "acrobot": Case(
        "Acrobot-v1",
        "acrobot",
        swung,
        integers(3),
        1e-12,
        1e-6,
        lambda x: 2 * (x[3] > 0),
        0.8,
    ),
    "cartpole": Case(
        "CartPole-v1",
        "cartpole",
        box(3.0, 5.0, 0.3, 5.0),
        integers(2),
        1e-12,
        1e-6,
        lean,
        0.4,
    ),
    "mountain_car": Case(
        "MountainCarContinuous-v0",
        "mountain_car",
        as_stored,
        pushes,
        1e-7,
        1e-5,
        lambda x: np.array([1.0 if x[1] >= 0 else -1.0]),
        0.8,
    ),
    "mountain_car_discrete": Case(
        "MountainCar-v0",
        "mountain_car_discrete",
        valley,
        integers(3),
        1e-12,
        1e-6,
        lambda x: 2 * (x[1] >= 0),
        0.8,
    ),
}


def gym_of(case):
    gym = gymnasium.make(case.gym).unwrapped
    gym.reset(seed=0)
    return gym


def gym_step(gym, state, action):
    """One step from a state, and the state after it."""
    gym.state = state
    gym.steps_beyond_terminated = None
    seen, reward, terminated, truncated, _ = gym.step(action)
    assert not truncated
    return gym.state, seen, reward, terminated


def our_steps(env, states, actions):
    """The next states, features, rewards and ends of a batch."""

    @jax.jit
    @jax.vmap
    def step(x, u):
        step = env.step(0.0, x, u)
        final = jnp.where(step.terminated, env.cost.final(env.dt, step.state), 0)
        return step.state, env.encode(step.state), -step.cost - final, step.terminated

    return [np.asarray(out) for out in step(states.astype(np.float64), actions)]


def compare(case, n, **gym_settings):
    env = dlx.make(case.task, **gym_settings.pop("ours", {}))
    gym = gym_of(case)
    for name, value in gym_settings.items():
        assert hasattr(gym, name)
        setattr(gym, name, value)
    rng = np.random.default_rng(0)
    states, actions = case.states(rng, n), case.actions(rng, n)
    steps = [gym_step(gym, x, u) for x, u in zip(states, actions, strict=True)]
    found, seen, rewards, ends = (np.array(part) for part in zip(*steps, strict=True))
    ours = our_steps(env, states, actions)
    assert np.max(np.abs(found - ours[0])) <= case.one_step
    # Python's power rounds one square in a thousand otherwise.
    np.testing.assert_allclose(rewards, ours[2], rtol=1e-15)
    np.testing.assert_array_equal(ends, ours[3])
    assert 0 < np.sum(ends) < n
    # States that agree to rounding may fall to either side of a float32.
    np.testing.assert_allclose(seen, ours[1].astype(np.float32), rtol=1.2e-7, atol=1e-7)
    encoded = np.asarray(jax.vmap(env.encode)(found))
    np.testing.assert_array_equal(seen, encoded.astype(np.float32))


@pytest.mark.parametrize("task", CASES)
def test_one_step_agrees_on_many_states(task):
    compare(CASES[task], 4_000)


def test_other_forms_agree():
    compare(CASES["acrobot"], 1_000, book_or_nips="nips", ours={"form": "nips"})
    semi_implicit = {"kinematics_integrator": "semi-implicit"}
    compare(CASES["cartpole"], 1_000, **semi_implicit, ours={"semi_implicit": True})
    goal = {"goal_velocity": 0.03}
    compare(CASES["mountain_car"], 1_000, **goal, ours=goal)


@pytest.mark.parametrize("form", ["book", "nips"])
def test_acrobots_vector_field_agrees_on_all_states(form):
    gym, rng = gym_of(CASES["acrobot"]), np.random.default_rng(1)
    states = box(np.pi, np.pi, 4 * np.pi, 9 * np.pi)(rng, 100_000)
    torques = rng.uniform(-1, 1, (100_000, 1))
    gym.book_or_nips = form
    *found, _ = gym._dsdt(np.concatenate([states, torques], axis=1).T)
    system = dlx.systems.Acrobot(form=form)
    field = jax.jit(jax.vmap(lambda x, u: system.vector_field(0.0, x, u, None)))
    found, ours = np.stack(found, axis=1), np.asarray(field(states, torques))
    assert np.max(np.abs(found - ours)) <= 1e-12


def test_a_batch_of_gymnasiums_cartpoles_agrees():
    n, steps = 1_000, 100
    gym = CartPoleVectorEnv(n)
    gym.reset(seed=0)
    env, case = dlx.make("cartpole"), CASES["cartpole"]
    rng = np.random.default_rng(0)
    seen = []
    for _ in range(steps):
        x, u, fresh = gym.state.T.copy(), case.actions(rng, n), ~gym.prev_done
        _, reward, ended, *_ = gym.step(u)
        seen.append((x, u, gym.state.T.copy(), reward, ended, fresh))
    x, u, found, reward, ended, fresh = (
        np.concatenate(part) for part in zip(*seen, strict=True)
    )
    ours = our_steps(env, x, u)
    assert np.max(np.abs(found - ours[0])[fresh]) <= 1e-12
    np.testing.assert_array_equal(reward[fresh], ours[2][fresh])
    np.testing.assert_array_equal(ended[fresh], ours[3][fresh])
    assert 0 < np.sum(ended)


def episode(case, seed):
    """States, actions, reward and end of one of Gymnasium's episodes."""
    gym = gymnasium.make(case.gym)
    plain = gym.unwrapped
    gym.reset(seed=seed)
    rng = np.random.default_rng(seed)
    states, actions, total = [np.array(plain.state, np.float64)], [], 0.0
    over = False
    while not over:
        u = case.actions(rng, 1)[0]
        if seed % 2 and rng.uniform() < case.share:
            u = case.policy(plain.state)
        _, reward, terminated, truncated, _ = gym.step(u)
        actions.append(u)
        states.append(np.array(plain.state, np.float64))
        total += reward
        over = terminated or truncated
    return np.array(states), np.array(actions), total, terminated


def from_next_door(case, states, actions):
    """How far Gymnasium itself ends from an episode when it starts at the next number
    that there is."""
    gym = gym_of(case)
    gym.state, gap = np.nextafter(states[0], 1), 0.0
    for x, u in zip(states[1:], actions, strict=True):
        gym.step(u)
        gap = max(gap, np.max(np.abs(gym.state - x)))
    return gap


def compare_episodes(case, seeds):
    env = dlx.make(case.task)
    runs = [episode(case, seed) for seed in seeds]
    controls = np.zeros((len(runs), env.horizon, env.control_size))
    for row, (_, used, *_) in zip(controls, runs, strict=True):
        row[: len(used)] = (
            used if env.actions is None else np.asarray(env.actions)[used]
        )

    @jax.vmap
    def replay(x0, controls):
        controller = dlx.controllers.OpenLoop(controls)
        return dlx.rollout(env, controller, key=jax.random.key(0), x0=x0)

    ours = jax.jit(replay)(np.stack([states[0] for states, *_ in runs]), controls)
    chaotic = 0
    for i, (states, used, total, terminated) in enumerate(runs):
        assert ours.length[i] == len(used)
        assert bool(ours.terminated[i, -1]) == terminated
        error = np.max(np.abs(states - np.asarray(ours.states[i, : len(used) + 1])))
        if error > case.episode:
            # A few of the acrobot's episodes magnify a rounding by 1e10 and more.
            chaotic += 1
            assert error <= 1e3 * from_next_door(case, states, used)
        assert math.isclose(-float(ours.total_cost[i]), total, rel_tol=1e-12)
    ends = [terminated for *_, terminated in runs]
    assert any(ends) and chaotic <= len(runs) // 20


@pytest.mark.parametrize("task", CASES)
def test_whole_episodes_agree(task):
    compare_episodes(CASES[task], range(20))


@pytest.mark.parametrize("task", CASES)
def test_start_horizon_and_bounds_are_gyms(task, key):
    case, env = CASES[task], dlx.make(CASES[task].task)
    spec = gymnasium.make(case.gym).spec
    assert env.horizon == spec.max_episode_steps
    gym = gym_of(case)
    theirs = []
    for seed in range(300):
        gym.reset(seed=seed)
        theirs.append(np.array(gym.state, np.float64))
    theirs = np.array(theirs)
    ours = np.asarray(jax.jit(jax.vmap(env.reset))(jax.random.split(key, 2000)))
    width = np.max(theirs, axis=0) - np.min(theirs, axis=0)
    for end in (np.min, np.max):
        gap = np.abs(end(ours, axis=0) - end(theirs, axis=0))
        assert np.all(gap <= 0.03 * width)
    low, high = env.control_bounds
    if isinstance(gym.action_space, gymnasium.spaces.Box):
        assert gym.action_space.low == low and gym.action_space.high == high
    else:
        assert env.actions.shape == (gym.action_space.n, 1)
        assert np.min(env.actions) == low and np.max(env.actions) == high
    for ours, theirs in zip(
        env.observation_bounds,
        (gym.observation_space.low, gym.observation_space.high),
        strict=True,
    ):
        np.testing.assert_array_equal(np.asarray(ours, np.float32), theirs)


def test_torque_noise_is_gyms():
    gym, env = gym_of(CASES["acrobot"]), dlx.make("acrobot", torque_noise=0.3)
    gym.torque_noise_max = 0.3
    rng, n = np.random.default_rng(0), 300
    states, actions, noise, found = swung(rng, n), rng.integers(0, 3, n), [], []
    for x, u in zip(states, actions, strict=True):
        noise.append([copy.deepcopy(gym.np_random).uniform(-0.3, 0.3)])
        found.append(gym_step(gym, x, u)[0])
    noise = np.array(noise)
    step = jax.jit(jax.vmap(lambda x, u, w: env.step(0.0, x, u, w).state))
    assert np.max(np.abs(np.array(found) - step(states, actions, noise))) <= 1e-12
    calm = step(states, actions, 0 * noise)
    assert np.min(np.abs(np.array(found) - calm)[:, 3]) > 1e-6
    drawn = env.disturbance.sequence(jax.random.key(0), jnp.arange(1000.0))
    assert np.max(np.abs(drawn)) <= 0.3 and np.std(drawn) > 0.15
