"""Imitation of an expert, and the controllers that it and `synthesise` build on."""

import dataclasses
import functools
import sys
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from helpers import assert_close, once

import delucax as dlx
from delucax.controllers import local_lqr, Residual
from delucax.training import imitate


pytestmark = once

KEY = jax.random.key(0)


@functools.cache
def env():
    return dlx.make("double_integrator", horizon=30, control_bounds=None)


@functools.cache
def expert():
    return local_lqr(env())


def test_a_linear_policy_learns_the_gains_of_the_expert():
    policy = dlx.controllers.Linear(jnp.zeros((1, 2)))
    options = dict(rounds=2, episodes=4, steps=300, progress=False)
    options["optimiser"] = optax.adam(optax.cosine_decay_schedule(0.1, 300))
    fitted = imitate(env(), expert(), policy, key=KEY, **options)
    assert_close(fitted.model.K, expert().K, atol=1e-3)
    assert len(fitted.history) == 600
    np.testing.assert_array_equal(fitted.history.step, np.arange(600))
    assert np.all(np.diff(fitted.history.seconds) >= 0)


def test_later_rounds_are_on_the_states_of_the_policy():
    # An expert that acts from far away alone is seen by a policy that goes there.
    class Far(dlx.AbstractController):
        def __call__(self, t, y, state):
            return jnp.where(jnp.abs(y[:1]) > 3, -y[:1], 0.0), state

    class Away(dlx.AbstractController):
        push: jax.Array = dlx.weight(3.0)

        def __call__(self, t, y, state):
            return self.push * jnp.sign(y[:1]), state

    far = dict(episodes=4, steps=20, progress=False)
    one = imitate(env(), Far(), Away(), key=KEY, rounds=1, **far)
    two = imitate(env(), Far(), Away(), key=KEY, rounds=2, **far)
    assert two.model.push < one.model.push


def test_steps_without_a_finite_control_do_not_count():
    class Lost(dlx.AbstractController):
        def __call__(self, t, y, state):
            return jnp.where(t > 10 * env().dt, jnp.nan, -y[:1]), state

    policy = dlx.controllers.Linear(jnp.zeros((1, 2)))
    options = dict(rounds=2, episodes=4, steps=100, progress=False)
    fitted = imitate(env(), Lost(), policy, key=KEY, **options)
    assert fitted.model.K[0, 0] > 0.1


def test_a_constant_control_does_not_outweigh_the_others():
    plant = dlx.LinearDynamics(0.9 * jnp.eye(2), jnp.eye(2))
    cost = dlx.costs.Quadratic(jnp.eye(2), jnp.eye(2))
    start = dlx.environments.UniformState([-1.0, -1.0], [1.0, 1.0])
    both = dlx.Environment(plant, cost, initial_state=start, horizon=10)
    one = dlx.controllers.Linear(jnp.array([[1.0, 1.0], [0.0, 0.0]]))
    policy = dlx.controllers.Linear(jnp.array([[0.0, 0.0], [0.01, 0.01]]))
    options = dict(rounds=1, episodes=4, steps=5, progress=False)
    fitted = imitate(both, one, policy, key=KEY, **options)
    # The policy is nearly right about the second control from the beginning.
    assert fitted.history.loss[0] < 10


def test_a_round_that_diverged_is_not_forgotten(monkeypatch):
    module = sys.modules[imitate.__module__]
    results = iter([dlx.RESULTS.diverged, dlx.RESULTS.successful])

    def fit(*args, **kwargs):
        fitted = dlx.training.fit(*args, **kwargs)
        return dataclasses.replace(fitted, result=next(results))

    monkeypatch.setattr(module, "fit", fit)
    policy = dlx.controllers.Linear(jnp.zeros((1, 2)))
    options = dict(rounds=2, episodes=2, steps=2, progress=False)
    fitted = imitate(env(), expert(), policy, key=KEY, **options)
    assert fitted.result == dlx.RESULTS.diverged


LINEAR = dlx.controllers.Linear(jnp.zeros((1, 2)))


@pytest.mark.parametrize(
    ("policy", "options", "match"),
    [
        (dlx.controllers.GRU(2, 1, 4, key=KEY), {}, "policy must have no memory"),
        (None, {}, "policy must be an AbstractController"),
        (LINEAR, dict(rounds=0), "rounds must be"),
        (LINEAR, dict(horizon=0), "horizon must be"),
        (
            LINEAR,
            dict(trainable="gain"),
            "trainable",
        ),
    ],
)
def test_bad_arguments(monkeypatch, policy, options, match):
    # Before the expert runs.
    monkeypatch.setattr(sys.modules[imitate.__module__], "_watched", None)
    with pytest.raises(ValueError, match=f"imitate: .*{match}"):
        imitate(env(), expert(), policy, key=KEY, **options)


def test_the_local_lqr_is_that_of_the_cost():
    # The cost is |x|^2 + 0.1 u^2.
    point = dlx.linearize(env().dynamics)
    by_hand = dlx.controllers.LQR(point, jnp.eye(2), 0.1 * jnp.eye(1))
    assert_close(expert().K, by_hand.K, rtol=1e-4)


def test_the_local_lqr_is_at_the_target():
    motor = dlx.make("permanent_magnet_motor")
    lqr = local_lqr(motor)
    assert_close(lqr.x_ref, motor.trim().x)
    start = lqr.x_ref
    held = dlx.rollout(motor, lqr, key=KEY, x0=start, horizon=50).final_state
    assert_close(held, start, atol=1e-3 * np.max(np.abs(start)))


class Given(dlx.AbstractSystem):
    # A function that is not declared static.
    state_names, control_names = ("x",), ("u",)
    rate: Any

    def vector_field(self, t, x, u, w):
        return self.rate(x) + u


def test_the_local_lqr_of_a_plant_that_holds_a_function():
    dynamics = dlx.Discretized(Given(jnp.sin), dt=0.1)
    cost = dlx.costs.Quadratic([1.0], [1.0])
    law = local_lqr(dlx.Environment(dynamics, cost, horizon=5))
    A, B = np.exp(0.1), np.exp(0.1) - 1  # of the linear model
    assert abs(A - B * law.K[0, 0]) < 1


def test_the_local_lqr_of_a_cost_of_integers():
    count = dlx.costs.Function(lambda t, x, u: jnp.where(x[0] > 0, 1, 0))
    law = local_lqr(dataclasses.replace(env(), cost=count))
    assert np.all(law.K > 0)


def test_no_local_lqr():
    with pytest.raises(ValueError, match="trim needs a cost with targets"):
        local_lqr(dlx.make("balloon_lung"))


def test_a_residual_of_zero_is_its_base():
    network = dlx.controllers.Linear(jnp.zeros((1, 2)))
    both = Residual(expert(), network)
    costs = [
        dlx.rollout(env(), c, key=KEY, keep=()).total_cost for c in (both, expert())
    ]
    assert_close(*costs)


def test_a_residual_clips_its_base_alone():
    base, correction = (dlx.controllers.Constant([value]) for value in (5.0, 0.5))
    policy = Residual(base, correction, bounds=(-1.0, 1.0))
    u, _ = policy(0.0, jnp.zeros(2), policy.init())
    assert_close(u, 1.5)


def test_both_parts_of_a_residual_remember():
    base = dlx.controllers.PID(1.0, 0.1, 0.0, dt=0.1)
    policy = Residual(base, base)
    state = policy.init()
    y = jnp.ones(1)
    for _ in range(3):
        u, state = policy(0.0, y, state)
        state = policy.applied(u, jnp.zeros(()), state)
    alone, own = base.init(), None
    for _ in range(3):
        own, alone = base(0.0, y, alone)
        alone = base.applied(2 * own, jnp.zeros(()), alone)
    assert_close(u, 2 * own)
