"""The environments in Gymnasium's interface."""

import copy
import warnings

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from gymnasium.error import InvalidAction, ResetNeeded
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode
from helpers import assert_close, once, user_error

import delucax as dlx
import delucax.interop.gymnasium as interop
from delucax.interop.gymnasium._vector_env import dones_and_infos


pytestmark = once


IDS = tuple(id for id in gymnasium.registry if id.startswith("delucax/"))
TASKS = {name for name in dlx.environments.registered() if "/" not in name}
ZERO = np.zeros(1, np.float32)


def test_every_task_has_an_id():
    made = {gymnasium.spec(id).kwargs["task"] for id in IDS}
    assert TASKS <= made


# One of each kind: what differs between the others is the plant, and the tests of
# tasks step those.
KINDS = (
    "Pendulum-v1",  # an angle, which is encoded
    "CartPole-v1",  # integers, an end, and Gymnasium's own space
    "MountainCar-v0",  # integers from 0 to 2
    "Reacher-v1",  # two controls, and a target with ends
    "LDS-v1",  # drawn with a key, and no ends
    "DelayLung-v1",  # an observation that is not the state
)


@pytest.mark.parametrize("name", KINDS)
def test_check_env(name):
    id = f"delucax/{name}"
    env = gymnasium.make(id, disable_env_checker=True)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        # A recommendation that Gymnasium's own tasks do not follow either.
        warnings.filterwarnings("ignore", ".*symmetric and normalized space")
        if "CartPole" in id and "Linear" not in id:
            # Its space is Gymnasium's own, which has no ends.
            warnings.filterwarnings("ignore", ".*observation space m.*infinity")
        check_env(env.unwrapped, skip_render_check=True)
        env = gymnasium.make(id)  # with the passive checker
        env.reset(seed=0)
        env.action_space.seed(0)
        for _ in range(3):
            env.step(env.action_space.sample())


@pytest.mark.parametrize("id", IDS)
def test_specs(id):
    """Gymnasium's own where it has the task, and the horizon of the task."""
    spec, bare = gymnasium.spec(id), id.partition("/")[2]
    kwargs = {"key": jax.random.key(0)} if bare in ("LDS-v1", "Neural-v1") else {}
    task = dlx.make(spec.kwargs["task"], **kwargs)
    assert spec.max_episode_steps == task.horizon
    made = gymnasium.make(id, disable_env_checker=True)
    assert made.observation_space.shape == (task.feature_size,)
    if task.actions is None:
        assert made.action_space.shape == (task.control_size,)
    assert made.action_space.contains(made.action_space.sample())
    if bare in gymnasium.registry:
        theirs = gymnasium.spec(bare)
        assert spec.max_episode_steps == theirs.max_episode_steps
        assert spec.reward_threshold == theirs.reward_threshold
    else:
        assert spec.reward_threshold is None


def length(env, most=300):
    """The steps of an episode."""
    env.reset(seed=0)
    for k in range(most):
        _, _, terminated, truncated, _ = env.step(ZERO)
        if terminated or truncated:
            return k + 1
    return None


def test_gymnasiums_time_limit_is_what_ends():
    make = lambda **kwargs: gymnasium.make("delucax/Pendulum-v1", **kwargs)
    noisy = dlx.disturbances.Gaussian(0.1, size=2)
    final = dlx.costs.Quadratic(jnp.eye(2), jnp.eye(1), final=jnp.eye(2))
    plain = dlx.costs.Quadratic(jnp.eye(2), jnp.eye(1))
    assert make().spec.max_episode_steps == 200
    assert length(make()) == 200
    assert length(make(max_episode_steps=250)) == 250
    assert length(make(max_episode_steps=250, cost=plain)) == 250
    assert length(make(max_episode_steps=-1)) is None
    # What is drawn or charged at the end has to know when it is.
    assert length(make(horizon=5)) == 5
    assert length(make(max_episode_steps=250, disturbance=noisy)) == 200
    assert length(make(max_episode_steps=250, cost=final)) == 200
    with user_error(match="truncate must be True if there are disturbances"):
        interop.GymnasiumEnv(dlx.make("pendulum", disturbance=noisy), truncate=False)
    make = lambda **kwargs: gymnasium.make_vec("delucax/Pendulum-v1", 2, **kwargs)
    assert make().environment.horizon == 200
    assert make(max_episode_steps=250).environment.horizon == 250
    assert make(max_episode_steps=250, horizon=5).environment.horizon == 5


def test_episode_is_a_rollout():
    env = dlx.make("pendulum", horizon=5)
    controls = np.linspace(-1, 3, 5, dtype=np.float32)[:, None]
    x0 = np.array([0.5, -0.2], np.float32)
    sequence = dlx.controllers.OpenLoop(controls)
    run = dlx.rollout(env, sequence, key=jax.random.key(0), x0=x0)
    made = interop.GymnasiumEnv(env)
    first, _ = made.reset(options={"state": x0})
    assert_close(first, env.encode(jnp.asarray(x0)), atol=1e-6)
    for k, control in enumerate(controls):
        seen, reward, terminated, truncated, _ = made.step(control)
        assert_close(made.state, run.states[k + 1], atol=1e-6)
        assert_close(seen, env.encode(run.states[k + 1]), atol=1e-6)
        assert_close(reward, -run.costs[k], rtol=1e-6)
        assert terminated is False and truncated is (k == 4)
    with pytest.raises(ResetNeeded, match="has ended"):
        made.step(ZERO)


@pytest.mark.parametrize("rows", [3, 4])
def test_recorded_noise_of_a_horizon(rows):
    """The state after the last step has the last row, if there is none of its own."""
    noise = dlx.disturbances.FromArray(jnp.arange(2.0 * rows).reshape(rows, 2))
    env = dlx.replace(dlx.make("pendulum", horizon=3), {"sensor_noise": noise})
    x0 = np.array([0.5, -0.2], np.float32)
    run = dlx.rollout(env, dlx.controllers.Zero(1), key=jax.random.key(0), x0=x0)
    read = [env.encode(y) for y in run.observations]
    read.append(env.encode(run.final_state + noise.values[-1]))
    # Each program compiles for seconds: one environment where the last row is repeated,
    # two where it is there.
    count = 1 if rows == 3 else 2
    same = lambda value: value if count == 1 else np.stack([value, value])
    made = (
        interop.GymnasiumEnv(env) if count == 1 else interop.GymnasiumVectorEnv(env, 2)
    )
    seen, _ = made.reset(options={"state": same(x0)})
    for k in range(4):
        assert_close(seen, same(read[k]), atol=2e-6)
        if k < 3:
            seen, *_ = made.step(same(ZERO))


def test_final_cost_comes_with_the_end():
    system = dlx.systems.Pendulum()
    cost = dlx.costs.Quadratic(0 * jnp.eye(2), jnp.eye(1), final=jnp.eye(2))
    env = dlx.Environment(
        dlx.Discretized(system, 0.05),
        cost,
        terminated=lambda t, x: x[0] > 1,
        initial_state=[0.9, 3.0],
    )
    made = interop.GymnasiumEnv(env)
    made.reset()
    seen, reward, terminated, truncated, _ = made.step(ZERO)
    assert terminated and not truncated
    assert_close(reward, -np.sum(seen**2), rtol=1e-6)


def test_integers_and_forces():
    env = dlx.make("cartpole")
    index, force = interop.GymnasiumEnv(env), interop.GymnasiumEnv(env, discrete=False)
    x0 = np.array([0.01, 0.0, 0.02, 0.0], np.float32)
    for made in (index, force):
        made.reset(options={"state": x0})
    one, other = index.step(1), force.step(np.asarray(env.actions)[1])
    assert_close(one[0], other[0])
    assert one[1] == other[1] == 1
    for bad in (2, -1, 0.5, [1], None):
        with pytest.raises(InvalidAction, match="whole number from 0 to 1"):
            index.step(bad)
    with user_error(match="discrete needs a table"):
        interop.GymnasiumEnv(dlx.make("pendulum"), discrete=True)


def test_seeds():
    noisy = dlx.disturbances.Gaussian(0.1, size=2)
    made = [interop.make("pendulum", disturbance=noisy) for _ in range(2)]
    runs = []
    for env, seed in zip(made, (3, 3), strict=True):
        env.reset(seed=seed)
        runs.append([env.step(ZERO)[0] for _ in range(3)] + [env.reset()[0]])
    np.testing.assert_array_equal(*runs)
    assert np.any(runs[0][-1] != made[0].reset()[0])


def test_copies_go_their_own_way():
    noisy = dlx.disturbances.Gaussian(0.1, size=2)
    made = interop.make("pendulum", disturbance=noisy)
    made.reset(seed=0)
    made.step(ZERO)
    one, other = copy.deepcopy(made), copy.deepcopy(made)
    pushed = one.step(ZERO + 2)[0]
    np.testing.assert_array_equal(other.step(ZERO + 2)[0], pushed)
    np.testing.assert_array_equal(made.step(ZERO + 2)[0], pushed)
    assert np.any(one.step(ZERO)[0] != pushed)
    np.testing.assert_array_equal(made.state, other.state)


def test_what_is_returned_is_the_users_own():
    made = interop.make("pendulum")
    first, _ = made.reset(seed=0)
    second = made.step(ZERO)[0]
    kept, state = second.copy(), made.state
    second[:] = made.state[:] = 0
    np.testing.assert_array_equal(made.state, state)
    assert made.step(ZERO)[0] is not second and np.any(kept) and not np.any(second)


def test_bad_input():
    made = interop.make("pendulum")
    with pytest.raises(ResetNeeded, match=r"reset\(\) before step"):
        made.step(ZERO)
    with pytest.raises(ResetNeeded, match="no state"):
        _ = made.state
    made.reset(seed=0)
    for bad in (0.0, np.zeros(2), "up", [None], [[0.0]], [[0.0], [1.0, 2.0]]):
        with pytest.raises(InvalidAction, match=r"numbers of shape \(1,\)"):
            made.step(bad)
    with pytest.raises(InvalidAction, match="finite"):
        made.step([np.nan])
    made.step([100])  # clipped, and the episode goes on
    with user_error(match="state .*2"):
        made.reset(options={"state": np.zeros(3)})
    with user_error(match="'start'"):
        made.reset(options={"start": np.zeros(2)})
    for bad in ("up", np.array([1j, 0])):
        with user_error(match="GymnasiumEnv: state must "):
            made.reset(options={"state": bad})
    with user_error(match=r"options must be a dictionary, got \[1, 2\]"):
        made.reset(options=[1, 2])
    with user_error(match="discrete must be True or False, got 'no'"):
        interop.make("cartpole", discrete="no")
    with user_error(match="truncate must be True or False, got 'no'"):
        interop.GymnasiumEnv(dlx.make("pendulum"), truncate="no")
    with user_error(match="render_mode must be"):
        interop.make("pendulum", render_mode="ascii")
    with user_error(match="env must be an Environment, got"):
        interop.GymnasiumEnv(gymnasium.make("Pendulum-v1"))


def test_a_simulation_that_fails_says_so():
    growing = dlx.LinearDynamics(1e30 * jnp.eye(1), jnp.eye(1))
    cost = dlx.costs.Quadratic(jnp.eye(1), jnp.eye(1))
    env = dlx.Environment(growing, cost, initial_state=[1.0])
    made = interop.GymnasiumEnv(env)
    made.reset()
    with pytest.raises(RuntimeError, match="failed at step"):
        for _ in range(3):
            made.step(ZERO)
    many = interop.GymnasiumVectorEnv(env, 2)
    many.reset()
    with pytest.raises(RuntimeError, match=r"\[0, 1\] failed"):
        for _ in range(3):
            many.step(np.zeros((2, 1)))


@pytest.mark.parametrize("mode", list(AutoresetMode))
def test_vector_modes(mode):
    many = interop.make_vector("pendulum", 3, autoreset_mode=mode, horizon=2)
    start, _ = many.reset(seed=0)
    assert many.observation_space.contains(start)
    actions = np.zeros((3, 1), np.float32)
    many.step(actions)
    before = many.states
    ended, rewards, terminated, truncated, info = many.step(actions)
    assert truncated.all() and not terminated.any() and (rewards < 0).all()
    after, rewards, _, truncated, _ = many.step(actions)
    single = interop.make("pendulum", horizon=2)
    single.reset(options={"state": before[1]})
    last = single.step(ZERO)[0]
    if mode is AutoresetMode.SAME_STEP:
        assert_close(info["final_obs"][1], last, atol=1e-6)
        assert info["_final_obs"].all() and np.any(ended != start)
        assert info["final_info"] == {} and info["_final_info"].all()
        assert not truncated.any() and (rewards < 0).all()
    else:
        assert info == {}
        assert_close(ended[1], last, atol=1e-6)
        assert (rewards == 0).all()
    if mode is AutoresetMode.NEXT_STEP:
        assert not truncated.any() and np.any(after != ended)
    if mode is AutoresetMode.DISABLED:
        np.testing.assert_array_equal(after, ended)
        mask = np.array([True, False, False])
        again, _ = many.reset(options={"reset_mask": mask})
        np.testing.assert_array_equal(again[1:], ended[1:])
        assert np.any(again[0] != ended[0])


def test_vector_is_each_alone():
    noisy = dlx.disturbances.Gaussian(0.1, size=2)
    many = interop.make_vector("pendulum", 4, disturbance=noisy)
    many.reset(seed=1, options={"state": np.array([0.3, 0.1])})
    first = many.step(np.zeros((4, 1)))[0]
    assert len(np.unique(first[:, 2])) == 4
    quiet = interop.make_vector("cartpole", 4)
    quiet.reset(seed=1)
    states = quiet.states
    seen, rewards, *_ = quiet.step(np.array([0, 1, 1, 0]))
    assert (rewards == 1).all()
    single = interop.make("cartpole")
    for i, action in enumerate([0, 1, 1, 0]):
        single.reset(options={"state": states[i]})
        assert_close(single.step(action)[0], seen[i], atol=1e-6)
    for bad in (np.zeros(3, int), np.zeros(4), np.full(4, 2)):
        with pytest.raises(InvalidAction, match="actions must be"):
            quiet.step(bad)


def test_vector_starts_with_a_seed_or_a_state_each():
    many, single = interop.make_vector("pendulum", 3), interop.make("pendulum")
    first, _ = many.reset(seed=[5, None, 7])
    for i, seed in ((0, 5), (2, 7)):
        assert_close(first[i], single.reset(seed=seed)[0], atol=1e-6)
    once_more, _ = many.reset(seed=[5, None, 7])
    np.testing.assert_array_equal(first, once_more)
    states = np.array([[0.1, 0.0], [0.2, 0.1], [0.3, 0.2]])
    many.reset(options={"state": states})
    assert_close(many.states, states, rtol=1e-6)


@pytest.mark.parametrize(
    "call, match",
    [
        (
            lambda e: e.reset(seed=[1, 2, 3]),
            "seed must be one whole number from 0, or 2",
        ),
        (lambda e: e.reset(seed=[1, -2]), "seed must be one whole number from 0, or 2"),
        (lambda e: e.reset(options=[1, 2]), "options must be a dictionary"),
        (lambda e: e.reset(options={"state": "up"}), r"state must have.*got 'up'"),
        (
            lambda e: e.reset(options={"state": np.zeros((3, 2))}),
            r"state must have shape \(2,\), or \(2, 2\) for one each, got .*\(3, 2\)",
        ),
        (
            lambda e: e.reset(options={"state": np.array([1j, 0])}),
            "state must be real",
        ),
        (
            lambda e: interop.make_vector("pendulum", 2, render_mode="rgb_array"),
            "make_vector: render_mode must be left out",
        ),
        (
            lambda e: interop.make_vector("pendulum", 2, max_episode_steps=0),
            "max_episode_steps must be a whole number of at least 1",
        ),
        (
            lambda e: interop.make_vector("pendulum", 2, max_episode_steps=-1),
            "max_episode_steps must be positive, got -1",
        ),
    ],
)
def test_bad_input_of_many(call, match):
    many = interop.make_vector("pendulum", 2)
    with user_error(match=match):
        call(many)


def test_ragged_actions_are_refused():
    many = interop.make_vector("pendulum", 2)
    many.reset(seed=0)
    with pytest.raises(InvalidAction, match=r"actions must have the shape \(2, 1\)"):
        many.step([[0.0], [0.0, 1.0]])


def test_a_window_needs_a_display():
    made = interop.make("pendulum", render_mode="human")
    with pytest.raises(RuntimeError, match="human' needs a display.*'rgb_array'"):
        made.reset(seed=0)


def test_by_gymnasiums_own_doors():
    many = gymnasium.make_vec(
        "delucax/Pendulum-v1",
        num_envs=2,
        vectorization_mode="vector_entry_point",
        length=1.2,
    )
    assert many.num_envs == 2
    assert_close(many.environment.dynamics.system.length, 1.2, rtol=1e-6)
    each = gymnasium.make_vec("delucax/CartPole-v1", num_envs=2)
    each.reset(seed=0)
    each.step(np.array([0, 1]))


def test_pictures():
    made = gymnasium.make("delucax/Pendulum-v1", render_mode="rgb_array")
    made.reset(seed=0)
    first = made.render()
    for _ in range(3):
        made.step(np.array([2.0], np.float32))
    second = made.render()
    assert first.shape == second.shape and first.shape[2] == 3
    assert first.dtype == np.uint8 and np.any(first != second)
    made.close()


def test_a_step_as_stable_baselines3_tells_of_it():
    """Where an episode ends by its limit the last observation is kept and said to be
    cut off; where it ends by itself it is not."""
    envs = interop.GymnasiumVectorEnv(
        dlx.make("cartpole", horizon=15), 2, autoreset_mode=AutoresetMode.SAME_STEP
    )
    # The second falls, the first stays up for the whole episode.
    start = np.array([[0.0, 0.0, 0.0, 0.0], [0.0, 0.0, 0.2, 2.0]])
    observations, _ = envs.reset(seed=0, options={"state": start})
    ends = {}
    for k in range(15):
        before = observations
        observations, rewards, dones, infos = dones_and_infos(
            envs.step(np.array([k % 2, 1]))
        )
        assert rewards.dtype == np.float32 and dones.dtype == bool
        for i in range(2):
            assert bool(infos[i]) == dones[i]
            if dones[i] and i not in ends:
                ends[i] = infos[i]
                last = infos[i]["terminal_observation"]
                assert np.all(np.abs(last - before[i]) < 1)
                assert np.all(np.abs(observations[i]) <= 0.05)
    assert ends[0]["TimeLimit.truncated"] is True
    assert ends[1]["TimeLimit.truncated"] is False
    assert np.abs(ends[1]["terminal_observation"][2]) > 0.2


@once
def test_a_plant_that_moves_on_moves_in_its_pictures():
    made = interop.make("drift", render_mode="rgb_array")
    made.reset(seed=0)
    frames = [made.render()]
    for _ in range(5):
        made.step(np.zeros(2))
    frames.append(made.render())
    assert_close(made._picture.times, [0.0, 5 * made.environment.dt], rtol=1e-6)
    assert np.any(frames[0] != frames[1])
    made.reset(seed=0)
    made.render()
    assert made._picture.times == [0.0]


class Layered(dlx.AbstractSystem):
    """With a list of layers, which has no hash."""

    state_names, control_names = ("x",), ("u",)
    layers: list

    def vector_field(self, t, x, u, w):
        for layer in self.layers:
            x = layer * x
        return u - x


@once
def test_a_plant_with_a_list_is_adapted():
    plant = dlx.Discretized(Layered([jnp.ones(1), 2 * jnp.ones(1)]), dt=0.1)
    made = interop.GymnasiumEnv(
        dlx.Environment(
            plant,
            dlx.costs.Quadratic(jnp.eye(1), jnp.eye(1)),
            initial_state=jnp.ones(1),
        )
    )
    made.reset(seed=0)
    observation, *_ = made.step(np.zeros(1))
    assert 0.8 < observation[0] < 0.9
