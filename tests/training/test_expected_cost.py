import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
import optax
import pytest
from helpers import assert_close, CountCalls, needs_x64, user_error
from jaxtyping import Array

import delucax as dlx
from delucax.training import analytic, expected_cost, fit, scored_cost


pytestmark = needs_x64


def pendulum(**kwargs):
    return dlx.make("pendulum", horizon=10, **kwargs)


CONTROLLER = dlx.controllers.Linear(jnp.array([[0.5, 0.2]]))


def test_it_is_the_mean_of_rollouts():
    env, keys = pendulum(), jr.split(jr.key(0), 3)

    @eqx.filter_jit
    def costs(controller):
        alone = lambda key: dlx.rollout(env, controller, key=key).total_cost
        found = [expected_cost(env, batch=n)(controller, jr.key(0)) for n in (3, 1)]
        return found, jax.vmap(alone)(keys), alone(jr.key(0))

    (mean, one), each, cost = costs(CONTROLLER)
    assert_close(mean, np.mean(each), rtol=1e-5)
    assert_close(one, cost, rtol=1e-6)


@functools.cache
def costs_and_gradients():
    """As it is, with less stored, and damped entirely."""
    options = {}, dict(checkpoint=None), dict(checkpoint="sqrt"), dict(gradient_decay=0)

    @eqx.filter_jit
    def all_of_them(controller):
        return [
            analytic(expected_cost(pendulum(), batch=2, **o), controller, jr.key(0))
            for o in options
        ]

    found = all_of_them(CONTROLLER)
    return [(value, np.asarray(slope.K)) for value, slope in found]


def test_what_the_gradient_stores_does_not_change_it():
    (_, found), *others, _ = costs_and_gradients()
    assert np.linalg.norm(found) > 0.1
    for _, gradient in others:
        assert_close(gradient, found, rtol=1e-10)


def test_a_decay_damps_the_gradient_and_not_the_cost():
    (cost, full), *_, (same, none) = costs_and_gradients()
    assert_close(same, cost, rtol=1e-6)
    assert np.linalg.norm(none) < np.linalg.norm(full)


def test_another_plant_does_not_compile_again():
    calls = CountCalls()

    class Counted(dlx.AbstractController):
        gain: Array = dlx.weight(1.0)

        def __call__(self, t, y, state):
            calls()
            return -self.gain * y[:1], state

    optimiser = optax.sgd(1e-3)

    def train(length, decay):
        loss = expected_cost(pendulum(length=length), batch=2, gradient_decay=decay)
        return fit(loss, Counted(), optimiser, 2, key=jr.key(0), progress=False)

    first = train(1.0, 0.9)
    traced = calls.count
    second = train(1.3, 0.8)
    assert calls.count == traced > 0
    assert first.history.loss[0] != second.history.loss[0]


def test_divergence_is_reported_with_its_step():
    unstable = dlx.environments.lds(
        jnp.array([[1e30]]), jnp.array([[1.0]]), initial_state=jnp.ones(1), horizon=30
    )
    for loss in (expected_cost(unstable, batch=2), expected_cost(unstable, batch=1)):
        assert not jnp.isfinite(loss(dlx.controllers.Linear([[1.0]]), jr.key(0)))
    with pytest.raises(RuntimeError, match="the loss is not finite at step 0 "):
        fit(
            loss,
            dlx.controllers.Linear([[1.0]]),
            optax.sgd(0.1),
            5,
            key=jr.key(0),
            progress=False,
        )


class Unsolved(dlx.dynamics.AbstractWrapper):
    """Dynamics of which no step is solved, though numbers come out."""

    dynamics: dlx.AbstractDynamics

    def advance(self, t, x, u, w):
        return x, dlx.RESULTS.stage_not_solved


def test_a_failed_solve_makes_the_cost_nan():
    dynamics = Unsolved(dlx.LinearDynamics(jnp.eye(1), jnp.eye(1)))
    cost = dlx.costs.Quadratic(jnp.eye(1), jnp.eye(1))
    env = dlx.Environment(dynamics, cost, initial_state=jnp.ones(1), horizon=2)
    zero = dlx.controllers.Zero(1)
    trajectory = dlx.rollout(env, zero, key=jr.key(0), throw=False)
    assert trajectory.result != dlx.RESULTS.successful
    assert not np.isfinite(expected_cost(env, batch=1)(zero, jr.key(0)))


def test_wrong_arguments_are_named():
    for match, make in (
        ("batch must be a whole number", lambda: expected_cost(pendulum(), batch=0)),
        (
            "horizon must be a whole number",
            lambda: expected_cost(pendulum(), batch=1, horizon=0),
        ),
        (
            "checkpoint must be one of 'step', 'sqrt', None, got 'all'",
            lambda: expected_cost(pendulum(), batch=1, checkpoint="all"),
        ),
        ("environment must be an Environment", lambda: expected_cost(3, batch=1)),
        ("environment must be an Environment", lambda: scored_cost(None)),
        ("horizon must be a whole number", lambda: scored_cost(pendulum(), horizon=0)),
    ):
        with user_error(match=match):
            make()


def test_losses_are_pytrees():
    loss = expected_cost(pendulum(), batch=2)
    again = jax.tree.map(lambda x: x, loss)
    value = eqx.filter_jit(lambda loss: loss(CONTROLLER, jr.key(0)))
    assert value(loss) == value(again)


def test_a_loss_is_compiled_by_filter_jit():
    loss, key = expected_cost(pendulum(), batch=2), jr.key(0)
    expected = jax.jit(lambda controller: loss(controller, key))(CONTROLLER)
    assert_close(eqx.filter_jit(loss)(CONTROLLER, key), expected, rtol=1e-12)
    with user_error(TypeError, match="unhashable type"):  # as the docstring says
        jax.jit(loss)(CONTROLLER, key)
