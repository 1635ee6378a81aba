"""Models from recorded data, and what the data do not tell."""

import jax.numpy as jnp
import jax.random as jr
import numpy as np
import optax
import pytest
from helpers import assert_close, needs_x64, thorough, user_error

import delucax as dlx
from delucax.training import fit, sysid


pytestmark = needs_x64

A = np.array([[0.9, 0.1], [0.0, 0.8]])
B = np.array([[0.0], [1.0]])
TRUE = dict(mass=1.3, length=0.8)


def recorded(seed=0, noise=0.01):
    """20 s of a pendulum under a new torque every 0.25 s, at 40 dB."""
    plant = dlx.Discretized(dlx.systems.Pendulum(**TRUE), dt=0.05)
    controls = 3 * jnp.repeat(jr.normal(jr.key(3), (80, 1)), 5, 0)
    states = dlx.open_loop(plant, jnp.array([3.0, 0.0]), controls)
    std = noise * jnp.std(states, axis=0)
    return states + std * jr.normal(jr.key(10 + seed), states.shape), controls, std


GUESS = dlx.Discretized(dlx.systems.Pendulum(), dt=0.05)


def test_length_and_mass_within_one_percent():
    inside = 0
    for seed in range(10):
        states, controls, std = recorded(seed)
        found = sysid.physical(
            GUESS, states, controls, ("system.length", "system.mass")
        )
        assert found.names == ("system.length", "system.mass")
        truth = np.array([TRUE["length"], TRUE["mass"]])
        assert np.all(np.abs(found.estimate / truth - 1) < 0.01)
        assert_close(found.noise / std, 1, atol=0.15)
        inside += np.sum((found.low < truth) & (truth < found.high))
    # Of 20 intervals of 95%: fewer than 16 has a chance below 0.3%.
    assert inside >= 16


@thorough
def test_direction_that_is_not_identifiable_is_reported():
    states, controls, _ = recorded()
    paths = ("system.gravity", "system.length", "system.mass")
    found = sysid.physical(GUESS, states, controls, paths, throw=False)
    assert found.result == dlx.RESULTS.unexciting
    assert found.identifiable.tolist() == [False, True, True]
    # g and l together, and m against the square of l.
    assert_close(np.abs(found.directions[0] @ np.array([1, 1, -2])), 6**0.5, rtol=1e-4)
    assert np.all(np.isinf(found.std))
    assert "not identifiable" in found.report()
    system = found.model.system
    assert_close(system.gravity / system.length, 10 / TRUE["length"], rtol=0.01)
    inertia = TRUE["mass"] * TRUE["length"] ** 2
    assert_close(system.mass * system.length**2, inertia, rtol=0.02)
    with pytest.raises(Exception, match="is not identifiable"):
        sysid.physical(GUESS, states, controls, paths)


def test_data_that_say_nothing_say_so():
    controls = jnp.zeros((400, 1))  # as many as are recorded: compiled once
    still = jnp.tile(jnp.array([jnp.pi, 0.0]), (401, 1))
    paths = ("system.length", "system.mass")
    found = sysid.physical(GUESS, still, controls, paths, throw=False)
    assert found.result == dlx.RESULTS.unexciting
    assert not np.any(found.identifiable)
    assert np.all(np.isfinite(found.estimate))


@thorough
def test_too_little_data_say_so():
    states, controls, _ = recorded()
    few = dict(states=states[:3], controls=controls[:2], throw=False)
    found = sysid.linear(**few)
    assert found.result == dlx.RESULTS.unexciting
    assert not np.all(found.identifiable) and np.all(np.isfinite(found.estimate))
    with pytest.raises(Exception, match="is not identifiable"):
        sysid.linear(states[:3], controls[:2])


@thorough
def test_two_observations_do_not_tell_two_parameters():
    # They are four numbers, two of which tell where it starts.
    states, controls, _ = recorded()
    both = "system.mass", "system.length"
    found = sysid.physical(GUESS, states[:2], controls[:1], both, throw=False)
    assert found.result == dlx.RESULTS.unexciting


def test_linear_models():
    true = dlx.LinearDynamics(A, B, dt=0.1)
    controls = jr.normal(jr.key(0), (400, 1))
    exact = dlx.open_loop(true, jnp.zeros(2), controls)
    found = sysid.linear(exact, controls, dt=0.1)
    assert_close(found.model.A, A, atol=1e-12)
    assert_close(found.model.B, B, atol=1e-12)
    w = 0.1 * jr.normal(jr.key(1), (400, 2))
    noisy = dlx.open_loop(true, jnp.zeros(2), controls, w)
    found = sysid.linear(noisy, controls, dt=0.1)
    truth = np.concatenate([A, B], axis=1)
    # The textbook's covariance, to all digits.
    rows = np.concatenate([noisy[:-1], controls], axis=1)
    cov = np.linalg.inv(rows.T @ rows)
    assert_close(found.std, found.noise[:, None] * np.sqrt(np.diag(cov)), rtol=1e-9)
    assert np.all(np.abs(found.estimate - truth) < 4 * found.std)
    assert_close(found.noise, 0.1, rtol=0.15)
    shifted = sysid.linear(noisy + 3.0, controls, affine=True)
    assert_close(shifted.model.A, found.model.A, atol=0.02)
    feedback = noisy[:-1] @ jnp.array([[0.3], [-0.2]])
    closed = sysid.linear(noisy, feedback, throw=False)
    assert closed.result == dlx.RESULTS.unexciting
    assert closed.identifiable.tolist() == [False, True, True]


@thorough
def test_arx_is_the_dynamics_that_it_came_from():
    true = dlx.LinearDynamics(A, B)
    controls = jr.normal(jr.key(0), (200, 1))
    outputs = dlx.open_loop(true, jnp.zeros(2), controls)[:, :1]
    found = sysid.arx(outputs, controls, outputs_back=2, controls_back=1, delay=2)
    assert_close(found.estimate, [[1.7, -0.72, 0.1]], atol=1e-10)
    model = found.model
    x = jnp.array([outputs[2, 0], outputs[1, 0], controls[1, 0]])
    states = dlx.open_loop(model, x, controls[2:])
    again = states @ model.C.T
    assert_close(again, outputs[2:], atol=1e-9)


@thorough
def test_neural_fits_predict():
    states, controls, _ = recorded(noise=1e-3)
    spread = jnp.std(states, axis=0)
    loss = sysid.PredictionError(scale=spread)
    data = sysid.windows(states, controls, 3, dt=0.05)
    assert data[1].shape == (398, 4, 2)
    options = dict(width=16, depth=1, dt=0.05, key=jr.key(0))
    step = jnp.std(jnp.diff(states, axis=0), axis=0)
    net = sysid.NeuralDynamics(2, 1, x_scale=spread, step_scale=step, **options)
    before = loss(net, data, jr.key(0))
    options = dict(key=jr.key(1), data=data, batch_size=64, progress=False)
    fitted = fit(loss, net, optax.adam(1e-2), 300, **options)
    assert float(loss(fitted.model, data, jr.key(0))) < 0.5 * float(before)
    # The data's own system leaves nothing but noise.
    own = dlx.Discretized(dlx.systems.Pendulum(**TRUE), dt=0.05)
    assert float(loss(own, data, jr.key(0))) < 1e-4


def test_bad_input():
    states, controls = jnp.zeros((11, 2)), jnp.zeros((10, 1))
    with user_error(match="states must have one step more than controls"):
        sysid.linear(states[:-1], controls)
    with user_error(match="must be finite"):
        sysid.linear(states.at[0, 0].set(jnp.nan), controls)
    with user_error(match="steps must be at most the 10 of a run, got 11"):
        sysid.windows(states, controls, 11)
    with user_error(match="more than the 12 steps that are looked back on"):
        sysid.arx(states, controls, outputs_back=12, controls_back=1)
    with user_error(match="observations and controls must have 2 and 1 entries"):
        sysid.physical(GUESS, states[:, :1], controls, "system.mass")
    with user_error(match="trainable"):
        sysid.physical(GUESS, states, controls, "system.colour")
