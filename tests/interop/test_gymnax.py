"""gymnax's protocol, both ways; gymnax itself is not needed."""

import dataclasses
import inspect
import re
import sys
import textwrap
import types
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
import pytest
from helpers import (
    assert_close,
    central_difference,
    needs_x64,
    once,
    user_error,
)

import delucax as dlx
import delucax.interop.gymnax as interop
from delucax.interop.gymnax import from_gymnax, GymnaxParams, to_gymnax


KEY = jr.key(0)


def run_example(value):
    """What the example in a docstring leaves behind."""
    [code] = re.findall(r"```python\n(.*?)```", inspect.getdoc(value), re.DOTALL)
    namespace = {"__name__": "example"}
    exec(compile(textwrap.dedent(code), value.__name__, "exec"), namespace)
    return namespace


def at(env, x, time=0):
    """An episode that is at `x`."""
    _, state = env.reset(KEY)
    return dataclasses.replace(state, state=x, time=jnp.asarray(time))


class TestToGymnax:
    pytestmark = once

    def test_shell_has_no_arrays_and_a_hash(self):
        one, same = (to_gymnax(dlx.make("pendulum")) for _ in range(2))
        other = to_gymnax(dlx.make("pendulum", length=1.2))
        assert one == same and hash(one) == hash(same)
        assert one != other and one != to_gymnax(
            dlx.make("pendulum"), discrete=False, separate_ends=True
        )
        assert one.name == "Pendulum" and one.num_actions == 1
        assert one.default_params.max_steps_in_episode == 200
        leaves = jax.tree.leaves(one.default_params)
        assert leaves and all(isinstance(leaf, jax.Array) for leaf in leaves)

    def test_episode_is_the_rollout_of_its_key(self):
        noisy = dlx.disturbances.Gaussian(0.1, size=2)
        task = dlx.make("pendulum", disturbance=noisy, horizon=4)
        env = to_gymnax(task)
        params = env.default_params
        controls = jnp.linspace(-1, 3, 4)[:, None]
        run = dlx.rollout(task, dlx.controllers.OpenLoop(controls), key=KEY)
        seen, state = env.reset(KEY, params)
        for k in range(4):
            assert_close(state.state, run.states[k], atol=1e-6)
            assert_close(seen, task.encode(run.states[k]), atol=1e-6)
            seen, state, reward, done, info = env.step(
                jr.key(k), state, controls[k], params
            )
            assert_close(reward, -run.costs[k], rtol=1e-5)
            assert bool(done) is (k == 3) and not info["failed"]
        assert info["truncated"] and not info["terminated"] and info["discount"] == 1
        last = info["final_observation"]
        assert_close(last, task.encode(run.states[4]), atol=1e-6)
        # The next episode has begun, with the key of the step.
        fresh, begun = env.reset(jr.key(3), params)
        assert_close(seen, fresh)
        assert state.time == 0 and np.any(np.asarray(seen) != np.asarray(last))
        assert_close(state.state, begun.state)

    def test_discrete_actions_and_ends(self):
        task = dlx.make("cartpole")
        env = to_gymnax(task, separate_ends=True)
        assert env.num_actions == 2 and env.action_space().n == 2
        edge = at(env, jnp.array([2.39, 2.0, 0.0, 0.0]), 7)
        _, state, reward, terminated, truncated, info = env.step(KEY, edge, 1)
        assert terminated and not truncated and info["discount"] == 0
        assert reward == 1 and state.time == 0
        pushed = info["final_observation"]
        assert_close(pushed, task.step(0.0, edge.state, task.actions[1]).state)
        assert env.is_terminal(at(env, pushed, 8))
        assert not env.is_terminal(edge)
        assert to_gymnax(task, discrete=False).num_actions == 1

    def test_final_cost_comes_with_the_end(self):
        cost = dlx.costs.Quadratic(0 * jnp.eye(2), jnp.eye(1), final=jnp.eye(2))
        task = dlx.make(
            "double_integrator", cost=cost, horizon=1, initial_state=[1.0, 2.0]
        )
        env = to_gymnax(task)
        _, state = env.reset(KEY)
        _, _, reward, done, info = env.step(KEY, state, jnp.zeros(1))
        assert done
        assert_close(reward, -jnp.sum(info["final_observation"] ** 2), rtol=1e-6)

    def test_many_plants_in_one_call(self):
        task = dlx.make("pendulum")
        env = to_gymnax(task)
        draw = lambda key: GymnaxParams(
            dlx.randomise(task, key, {"dynamics.system.length": (0.5, 2.0)})
        )
        keys = jr.split(KEY, 3)
        params = jax.vmap(draw)(keys)
        start = at(env, jnp.array([0.5, 0.0]))
        one = lambda params: env.step_env(KEY, start, 0.0, params)[1]
        states = jax.jit(jax.vmap(one))(params)
        lengths = params.environment.dynamics.system.length
        expected = 1.5 * 10 / np.asarray(lengths) * np.sin(0.5) * 0.05
        assert_close(states.state[:, 1], expected, rtol=1e-5)

    def test_spaces(self, monkeypatch):
        env = to_gymnax(dlx.make("pendulum"))
        actions, seen = env.action_space(), env.observation_space()
        assert (actions.low, actions.high, actions.shape) == (-2.0, 2.0, (1,))
        assert_close(seen.high, [1.0, 1.0, 8.0])
        drawn = actions.sample(KEY)
        assert drawn.shape == (1,) and actions.contains(drawn)
        assert not actions.contains(jnp.array([2.1]))
        wide = to_gymnax(dlx.make("double_integrator")).observation_space()
        assert wide.contains(wide.sample(KEY)) and np.max(wide.high) > 1e38
        free = to_gymnax(dlx.make("pendulum", control_bounds=None)).action_space()
        assert (free.low, free.high) == (-1000.0, 1000.0)
        buttons = to_gymnax(dlx.make("cartpole")).action_space()
        assert buttons.contains(buttons.sample(KEY)) and not buttons.contains(2)
        assert "Discrete(2)" in repr(buttons) and "Box(-2.0, 2.0" in repr(actions)
        # Clients of gymnax ask for its own classes.
        theirs = types.SimpleNamespace(Box=lambda *args: args, Discrete=lambda n: n)
        monkeypatch.setitem(sys.modules, "gymnax.environments.spaces", theirs)
        assert to_gymnax(dlx.make("cartpole")).action_space() == 2
        assert env.action_space()[:3] == (-2.0, 2.0, (1,))

    def test_actions_that_are_traced_are_clamped(self):
        env = to_gymnax(dlx.make("cartpole"))
        state = at(env, jnp.zeros(4))
        step = jax.jit(lambda u: env.step_env(KEY, state, u)[1].state)
        pushed = [step(u) for u in (jnp.asarray(9), jnp.asarray(1), jnp.asarray(-3))]
        assert_close(pushed[0], pushed[1])
        assert pushed[2][1] < 0 < pushed[0][1]

    def test_nan_is_told(self):
        env = to_gymnax(dlx.make("pendulum"))
        good, bad = jnp.array([0.1, 0.0]), jnp.array([jnp.nan, 0.0])
        for x, u, failed in (
            (good, 0.0, False),
            (bad, 0.0, True),
            (good, np.nan, True),
        ):
            state = at(env, x)
            assert env.step_env(KEY, state, u)[-1]["failed"] == failed

    def test_ends_are_those_of_the_gymnax_that_is_there(self, monkeypatch):
        task, where = dlx.make("pendulum"), "gymnax.environments.environment"
        assert not to_gymnax(task).separate_ends
        one, two = type("Environment", (), {}), type("Environment", (), {})
        two.is_truncated = None
        for theirs, separate in ((one, False), (two, True)):
            there = types.SimpleNamespace(Environment=theirs)
            monkeypatch.setitem(sys.modules, where, there)
            assert to_gymnax(task).separate_ends == separate
        monkeypatch.setitem(sys.modules, "rejax", types.SimpleNamespace())
        assert not to_gymnax(task).separate_ends

    def test_bad_input(self):
        task = dlx.make("pendulum")
        env = to_gymnax(task)
        with user_error(match="env must be an Environment, got"):
            to_gymnax(task.dynamics)
        with user_error(match="environment must be an Environment, got"):
            GymnaxParams(task.dynamics)
        with user_error(match="discrete needs a table"):
            to_gymnax(task, discrete=True)
        with user_error(match="action must have 1 entries"):
            env.step(KEY, env.reset(KEY)[1], jnp.zeros(2))
        cart = to_gymnax(dlx.make("cartpole"))
        state = cart.reset(KEY)[1]
        for bad in (2, -1, 0.5, np.nan):
            for step in (cart.step, cart.step_env):
                with user_error(match="action must be a whole number from 0 to 1, got"):
                    step(KEY, state, bad)
        with user_error(match="action must have 1 entries, got None"):
            cart.step(KEY, state, None)
        with user_error(match="GymnaxEnv.reset: key must be one random key"):
            cart.reset(0)
        for name in ("discrete", "separate_ends"):
            with user_error(match=f"{name} must be True or False, got 'no'"):
                to_gymnax(task, **{name: "no"})
        with user_error(match="params must be a GymnaxParams, such as default_p"):
            env.step(KEY, env.reset(KEY)[1], jnp.zeros(1), task)
        with user_error(match="being traced"):
            jax.vmap(
                lambda l: to_gymnax(dlx.replace(task, {"dynamics.system.length": l}))
            )(jnp.ones(2))


@pytest.mark.parametrize(
    "disturbance, sensor", [("walk", "gaussian"), ("recorded", "recorded")]
)
def test_noise_is_that_of_the_rollout(disturbance, sensor):
    d, horizon = dlx.disturbances, 5
    noises = {
        "gaussian": d.Gaussian(0.1, size=2),
        "walk": d.RandomWalk(size=2),
        "recorded": d.FromArray(jnp.arange(2.0 * horizon).reshape(-1, 2)),
    }
    task = dlx.make("pendulum", horizon=horizon)
    task = dlx.replace(
        task, {"disturbance": noises[disturbance], "sensor_noise": noises[sensor]}
    )
    env = to_gymnax(task)
    controls = jnp.linspace(-1, 3, horizon)[:, None]
    run = dlx.rollout(task, dlx.controllers.OpenLoop(controls), key=KEY)
    step = jax.jit(env.step_env)
    observation, state = env.reset(KEY)
    for k in range(horizon):
        assert_close(observation, task.encode(run.observations[k]), rtol=2e-6)
        observation, state, *_ = step(KEY, state, controls[k])
    assert_close(state.state, run.final_state, rtol=2e-6)
    assert np.all(np.isfinite(observation))


class Space(NamedTuple):
    low: Any
    high: Any
    shape: tuple


class Buttons(NamedTuple):
    n: int
    shape: tuple = ()


class Params(NamedTuple):
    push: Any = 0.5
    max_steps_in_episode: int = 5


class Cart(NamedTuple):
    place: Any
    time: Any
    seed: Any


class Slope:
    """A cart in two dimensions, in the style of gymnax; `noise` needs the key."""

    default_params = Params()

    def __init__(self, noise=0.0, space=None, goal=1e3):
        self.noise, self.goal = noise, goal
        self.space = Space(-2.0, 2.0, (2,)) if space is None else space

    def action_space(self, params):
        return self.space

    def reset_env(self, key, params):
        state = Cart(jr.uniform(key, (2,)), 0, jnp.array([7, 2**32 - 1], jnp.uint32))
        return self.get_obs(state), state

    def step_env(self, key, state, action, params):
        place = state.place + params.push * jnp.asarray(action, float)
        if self.noise:
            place = place + self.noise * jr.normal(key, (2,))
        reward = -jnp.sum(place**2)  # of the next state
        state = Cart(place, state.time + 1, state.seed)
        done = (state.time >= params.max_steps_in_episode) | (place[0] > self.goal)
        return self.get_obs(state), state, reward, done, {}

    def get_obs(self, state):
        return {"angle": jnp.sin(state.place), "time": state.time}


class TestFromGymnax:
    @once
    def test_protocol_becomes_an_environment(self):
        env = from_gymnax(Slope(goal=0.9), dt=0.1)
        assert env.horizon == 5 and env.control_size == 2
        assert env.dynamics.control_names == ("action[0]", "action[1]")
        assert env.dynamics.state_names[:3] == ("place[0]", "place[1]", "time")
        assert env.dynamics.state_names[-1] == "done" and env.state_size == 8
        x0 = env.dynamics.ravel(
            Cart(jnp.array([0.5, -1.0]), 0, jnp.array([7, 2**32 - 1], jnp.uint32))
        )
        state = env.dynamics.unravel(x0)
        assert state.seed.dtype == jnp.uint32
        np.testing.assert_array_equal(state.seed, [7, 2**32 - 1])
        K = jnp.zeros((2, 8)).at[:, :2].set(0.4 * jnp.eye(2))
        run = dlx.rollout(env, dlx.controllers.Linear(K), key=KEY, x0=x0)
        expected = 0.8 ** np.arange(6)[:, None] * np.array([0.5, -1.0])
        assert_close(run.states[:, :2], expected, rtol=1e-5)
        assert_close(run.costs, np.sum(expected[1:] ** 2, axis=1), rtol=1e-5)
        assert_close(run.states[:, 2], np.arange(6))
        ended = dlx.rollout(env, dlx.controllers.Linear(-10 * K), key=KEY, x0=x0)
        assert ended.length == 1 and ended.terminated[1:].all()
        assert_close(env.encode(run.states[3]), [*np.sin(expected[3]), 3], rtol=1e-5)

    @once
    def test_keys_follow_the_rollout(self):
        still = dlx.controllers.Zero(2)
        env = from_gymnax(Slope(noise=1.0), Params(push=0.0, max_steps_in_episode=500))
        assert env.state_size == 12  # a key in four parts
        run, other = (dlx.rollout(env, still, key=key) for key in jr.split(KEY))
        steps = np.diff(np.asarray(run.states[:, :2]), axis=0).ravel()
        assert len(np.unique(steps)) > 990
        assert abs(steps.mean()) < 0.1 and abs(steps.std() - 1) < 0.1
        assert np.all(np.diff(np.asarray(other.states[:, 0])) != steps[::2])
        # The reward is that of the same draw.
        assert_close(run.costs, jnp.sum(run.states[1:, :2] ** 2, axis=1), rtol=1e-4)

    @once
    def test_buttons(self):
        env = from_gymnax(Slope(space=Buttons(3)))
        assert env.actions.shape == (3, 1)
        x = env.reset(KEY)
        for u, pressed in ((2, 2), (jnp.array([1.3]), 1), (jnp.array([9.0]), 2)):
            moved = env.step(0.0, x, u).state[:2]
            assert_close(moved, x[:2] + 0.5 * pressed, rtol=1e-6)

    @needs_x64
    def test_gradients(self):
        theirs = Slope()

        def total(numbers):
            env = from_gymnax(theirs, Params(push=numbers[0]))
            K = jnp.zeros((2, 8)).at[:, :2].set(numbers[1] * jnp.eye(2))
            return dlx.rollout(env, dlx.controllers.Linear(K), key=KEY).total_cost

        at = jnp.array([0.5, 0.3])
        assert_close(jax.grad(total)(at), central_difference(total, at), rtol=1e-6)

    @once
    def test_there_and_back(self):
        example = run_example(from_gymnax)
        env, key = example["env"], KEY
        run = dlx.rollout(env, example["controller"], key=key)
        start = env.dynamics.unravel(run.states[0])
        assert start.time == 0 and run.length == 200
        task = dlx.make("pendulum")
        own = dlx.rollout(task, example["controller"], key=key, x0=start.state)
        assert_close(run.states[:20, :2], own.states[:20], atol=1e-5)
        assert_close(run.costs[:20], own.costs[:20], rtol=1e-4, atol=1e-5)
        assert_close(env.encode(run.states[0]), task.encode(own.states[0]))

    @once
    def test_gymnax_1_lets_gradients_pass_when_asked(self):
        class Shut(Slope):
            supports_transition_gradients = True

            def with_transition_gradients(self):
                return Slope()

            def step_env(self, *args):
                return jax.lax.stop_gradient(super().step_env(*args))

        env = from_gymnax(Shut())
        x = env.reset(KEY)
        moved = lambda u: env.step(0.0, x, u).state[0]
        slope = jax.jit(jax.grad(moved))(jnp.zeros(2))
        assert_close(slope, [0.5, 0.0])

    @once
    def test_bad_input(self):
        class Growing(Slope):
            def step_env(self, *args):
                seen, state, *rest = super().step_env(*args)
                return seen, state._replace(place=jnp.zeros(3)), *rest

        class Blind(Slope):
            get_obs = None

            def reset_env(self, key, params):
                return None, Cart(jnp.zeros(2), 0, jr.PRNGKey(0))

        class Typed(Slope):
            def reset_env(self, key, params):
                return None, Cart(jnp.zeros(2), 0, key)

        with user_error(match="Params has no reset_env"):
            from_gymnax(Params())
        with user_error(match="Box or Discrete"):
            from_gymnax(Slope(space={"a": 1}))
        with user_error(match="typed key, .seed"):
            from_gymnax(Typed())
        with user_error(match="horizon must be given"):
            from_gymnax(Slope(), Params(max_steps_in_episode=None))
        with user_error(match="no argument is called 'horizont'"):
            from_gymnax(Slope(), horizont=3)
        with user_error(match="encode must be given"):
            from_gymnax(Blind())
        with user_error(match="dt must be positive"):
            from_gymnax(Slope(), dt=0.0)
        with user_error(match="a state must be"):
            from_gymnax(Growing(), horizon=3)


EXAMPLES = ("GymnaxDynamics", "GymnaxEnv", "GymnaxParams", "to_gymnax")


@once
@pytest.mark.parametrize("name", EXAMPLES)
def test_example_runs(name):
    run_example(getattr(interop, name))
