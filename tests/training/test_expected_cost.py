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
    loss = expected_cost(pendulum(), batch=3, horizon=7)
    keys = jr.split(jr.key(0), 3)
    costs = [
        dlx.rollout(pendulum(), CONTROLLER, key=k, horizon=7).total_cost for k in keys
    ]
    assert_close(loss(CONTROLLER, jr.key(0)), np.mean(costs), rtol=1e-5)
    one = expected_cost(pendulum(), batch=1)
    cost = dlx.rollout(pendulum(), CONTROLLER, key=jr.key(0)).total_cost
    assert_close(one(CONTROLLER, jr.key(0)), cost, rtol=1e-6)


def test_what_the_gradient_stores_does_not_change_it():
    gradients = [
        analytic(
            expected_cost(pendulum(), batch=2, checkpoint=checkpoint),
            CONTROLLER,
            jr.key(0),
        )[1].K
        for checkpoint in ("sqrt", None)
    ]
    assert jnp.linalg.norm(gradients[0]) > 0.1
    for gradient in gradients[1:]:
        assert_close(gradient, gradients[0], rtol=1e-10)


def test_a_decay_damps_the_gradient_and_not_the_cost():
    full = analytic(expected_cost(pendulum(), batch=2), CONTROLLER, jr.key(0))
    none = analytic(
        expected_cost(pendulum(), batch=2, gradient_decay=0.0), CONTROLLER, jr.key(0)
    )
    assert_close(full[0], none[0], rtol=1e-6)
    assert jnp.linalg.norm(none[1].K) < jnp.linalg.norm(full[1].K)


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


def test_a_failed_solve_makes_the_cost_nan():
    import diffrax

    dynamics = dlx.Discretized(
        dlx.systems.Pendulum(),
        dt=1.0,
        solver=diffrax.Tsit5(),
        stepsize_controller=diffrax.PIDController(rtol=1e-4, atol=1e-6),
        max_steps=1,
    )
    cost = dlx.costs.Quadratic(jnp.eye(2), jnp.eye(1))
    env = dlx.Environment(dynamics, cost, initial_state=jnp.ones(2), horizon=2)
    zero = dlx.controllers.Zero(1)
    trajectory = dlx.rollout(env, zero, key=jr.key(0), throw=False)
    assert trajectory.result != dlx.RESULTS.successful
    assert not jnp.isfinite(expected_cost(env, batch=1)(zero, jr.key(0)))


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
    assert loss(CONTROLLER, jr.key(0)) == jax.tree.map(lambda x: x, loss)(
        CONTROLLER, jr.key(0)
    )
