"""Models from recorded data, and what the data do not tell."""

import re

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
import optax
import pytest
from helpers import assert_close, counted_programs, needs_x64, user_error
from hypothesis import given, settings, strategies as st
from jaxtyping import Array

import delucax as dlx
from delucax.training import fit, sysid


pytestmark = needs_x64

A = np.array([[0.9, 0.1], [0.0, 0.8]])
B = np.array([[0.0], [1.0]])
TRUE = dict(mass=1.3, length=0.8)


SOLVER = diffrax.Midpoint()  # of two stages: its programs are small


def pendulum(**constants):
    return dlx.Discretized(dlx.systems.Pendulum(**constants), 0.05, SOLVER)


GUESS = pendulum()
BOTH = "system.length", "system.mass"
open_loop = eqx.filter_jit(dlx.open_loop)


def record(outputs, controls, dt=0.05):
    return sysid.Record(outputs, controls, dt=dt)


def recorded(seed=0, noise=0.01, damping=0.0):
    """20 s of a pendulum under a new torque every 0.25 s, at 40 dB."""
    controls = 3 * np.repeat(np.random.default_rng(3).normal(size=(80, 1)), 5, 0)
    plant = pendulum(**TRUE, damping=damping)
    states = np.asarray(open_loop(plant, jnp.array([3.0, 0.0]), controls))
    std = noise * np.std(states, axis=0)
    drawn = np.random.default_rng(10 + seed).normal(size=states.shape)
    return states + std * drawn, controls, std


def of_linear(controls, w):
    """The states of `A`, `B` from 0."""
    states = [np.zeros(2)]
    for u, d in zip(controls, w, strict=True):
        states.append(A @ states[-1] + B @ u + d)
    return np.stack(states)


def test_length_and_mass_within_one_percent():
    inside = 0
    for seed in range(10):
        states, controls, std = recorded(seed)
        found = sysid.physical(GUESS, record(states, controls), BOTH)
        assert found.names == BOTH
        truth = np.array([TRUE["length"], TRUE["mass"]])
        assert np.all(np.abs(found.estimate / truth - 1) < 0.01)
        assert_close(found.noise / std, 1, atol=0.15)
        inside += np.sum((found.low < truth) & (truth < found.high))
        assert_close(found.x0, [3.0, 0.0], atol=3 * float(std.max()))
    assert "identifiable" in repr(found)
    # Of 20 intervals of 95%: fewer than 16 has a chance below 0.3%.
    assert inside >= 16


def test_residuals_of_a_wrong_model_are_said_to_be_correlated():
    """Of a pendulum whose friction the model leaves out."""
    paths, friction = BOTH, 0.3
    for seed in range(2):
        states, controls, _ = recorded(seed, damping=friction)
        missing = sysid.physical(GUESS, record(states, controls), paths)
        assert missing.correlation > 8
        assert "correlated from step to step" in repr(missing)
        guess = dlx.replace(GUESS, {"system.damping": friction})
        found = sysid.physical(guess, record(states, controls), paths)
        assert found.correlation < 4
        assert "correlated" not in repr(found)
    # Where the noise is said to be larger than all that remains nothing is known.
    loud = sysid.physical(GUESS, record(states, controls), paths, noise=10.0)
    assert loud.correlation == 0


def test_direction_that_is_not_identifiable_is_reported():
    states, controls, _ = recorded()
    paths = ("system.gravity", "system.length", "system.mass")
    found = sysid.physical(GUESS, record(states, controls), paths, throw=False)
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
    with user_error(RuntimeError, match="not identifiable: .* system.gravity"):
        sysid.physical(GUESS, record(states, controls), paths)


def _hanging(outputs):
    return jnp.broadcast_to(jnp.array([np.pi, 0.0], outputs.dtype), outputs.shape)


def test_data_that_say_nothing_say_so():
    controls = np.zeros((400, 1))  # as many as are recorded: compiled once
    # A record refuses such outputs; a simulated one may have them.
    still = record(np.arange(802.0).reshape(401, 2), controls)
    still = eqx.tree_at(lambda r: r.outputs, still, replace_fn=_hanging)
    found = sysid.physical(GUESS, still, BOTH, throw=False)
    assert found.result == dlx.RESULTS.unexciting
    assert not np.any(found.identifiable)
    assert np.all(np.isfinite(found.estimate))
    # Both are positive, and may be anything.
    assert_close(found.low, 0.0)
    assert np.all(found.high == np.inf)
    for line in found.report().splitlines()[1:3]:
        assert line.split()[2:] == ["0", "inf"]


def test_too_little_data_say_so():
    states, controls, _ = recorded()
    few = record(states[:3], controls[:2])
    found = sysid.linear(few, throw=False)
    assert found.result == dlx.RESULTS.unexciting
    assert not np.all(found.identifiable) and np.all(np.isfinite(found.estimate))
    assert found.x0 is None
    with user_error(RuntimeError, match="(?s)^sysid.linear: .*not identifiable: "):
        sysid.linear(few)
    with user_error(RuntimeError, match="(?s)^sysid.arx: .*not identifiable: "):
        sysid.arx(few, outputs_back=1, controls_back=1)
    with user_error(match="more measurements than unknowns, got 6 for 2 parameters"):
        sysid.physical(GUESS, record(states[:3], controls[:2]), BOTH, window=1)


def test_linear_models():
    rng = np.random.default_rng(0)
    controls, w = rng.normal(size=(400, 1)), 0.1 * rng.normal(size=(400, 2))
    found = sysid.linear(record(of_linear(controls, 0 * w), controls))
    assert_close(found.model.A, A, atol=1e-12)
    assert_close(found.model.B, B, atol=1e-12)
    noisy = of_linear(controls, w)
    found = sysid.linear(record(noisy, controls))
    truth = np.concatenate([A, B], axis=1)
    # The textbook's covariance, to all digits.
    rows = np.concatenate([noisy[:-1], controls], axis=1)
    cov = np.linalg.inv(rows.T @ rows)
    assert_close(found.std, found.noise[:, None] * np.sqrt(np.diag(cov)), rtol=1e-9)
    assert np.all(np.abs(found.estimate - truth) < 4 * found.std)
    assert_close(found.noise, 0.1, rtol=0.15)
    shifted = sysid.linear(record(noisy + 3.0, controls), affine=True)
    assert_close(shifted.model.A, found.model.A, atol=0.02)
    feedback = noisy[:-1] @ np.array([[0.3], [-0.2]])
    closed = sysid.linear(record(noisy, feedback), throw=False)
    assert closed.result == dlx.RESULTS.unexciting
    assert closed.identifiable.tolist() == [False, True, True]


def test_level_of_the_intervals():
    rng = np.random.default_rng(0)
    controls = rng.normal(size=(60, 1))
    states = of_linear(controls, 0.1 * rng.normal(size=(60, 2)))
    back = dict(outputs_back=1, controls_back=1)
    swung = record(*recorded()[:2])
    small = record(states, controls)
    fits = (
        lambda level: sysid.linear(small, level=level),
        lambda level: sysid.arx(small, **back, level=level),
        lambda level: sysid.physical(GUESS, swung, BOTH, level=level),
    )
    for fitted in fits:
        half, most = fitted(0.5), fitted(0.95)
        widths = [np.asarray(f.high) - np.asarray(f.low) for f in (half, most)]
        ratio = widths[0] / widths[1]
        # The quantiles of a normal distribution; positive values have skewed ends.
        assert_close(ratio, np.full(ratio.shape, 0.67449 / 1.95996), rtol=1e-3)
        with user_error(match="level must be between 0 and 1, got 1.5"):
            fitted(1.5)


def test_arx_is_the_dynamics_that_it_came_from():
    controls = np.random.default_rng(0).normal(size=(200, 1))
    outputs = of_linear(controls, np.zeros((200, 2)))[:, :1]
    past = dict(outputs_back=2, controls_back=1, delay=2)
    found = sysid.arx(record(outputs, controls), **past)
    assert_close(found.estimate, [[1.7, -0.72, 0.1]], atol=1e-10)
    A_, B_, C_ = (np.asarray(M) for M in (found.model.A, found.model.B, found.model.C))
    x, again = np.array([outputs[2, 0], outputs[1, 0], controls[1, 0]]), []
    for u in controls[2:]:
        again.append(C_ @ x)
        x = A_ @ x + B_ @ u
    assert_close(np.stack([*again, C_ @ x]), outputs[2:], atol=1e-9)


def test_neural_fits_predict():
    states, controls, _ = recorded(noise=1e-3)
    spread = np.std(states, axis=0)
    loss = sysid.PredictionError(scale=spread)
    data = sysid.windows(record(states, controls), 3)
    assert data[1].shape == (398, 4, 2)
    options = dict(width=8, depth=1, dt=0.05, key=jr.key(0))
    step = np.std(np.diff(states, axis=0), axis=0)
    net = sysid.NeuralDynamics(2, 1, x_scale=spread, step_scale=step, **options)
    fitted = fit(loss, net, optax.adam(1e-2), 300, key=jr.key(1), data=data)
    losses = fitted.history.loss
    assert losses[-1] < 0.5 * losses[0]
    # The data's own system leaves nothing but noise.
    assert eqx.filter_jit(loss)(pendulum(**TRUE), data, jr.key(0)) < 1e-4


def test_neural_options():
    states, controls = np.arange(22.0).reshape(11, 2), np.zeros((10, 1))
    run = record(states, controls, 0.5)
    times, some, inputs = sysid.windows(run, 3, stride=4)
    assert_close(times, [0.0, 2.0])
    assert_close(some, np.stack([states[:4], states[4:8]]))
    assert inputs.shape == (2, 3, 1)
    with user_error(match="stride must be a whole number of at least 1"):
        sysid.windows(run, 3, stride=0)
    net = sysid.NeuralDynamics(2, 1, 8, 1, activation=jax.nn.relu, key=jr.key(0))
    first, last = net.network.layers
    z = np.array([1.0, -2.0, 0.5])
    hidden = np.maximum(first.weight @ z + first.bias, 0)
    after = z[:2] + last.weight @ hidden + last.bias
    assert_close(net(0.0, z[:2], z[2:]), after, rtol=1e-12)


class Reactor(dlx.AbstractSystem):
    """A stirred tank with a cooling jacket, its rate constant in any unit."""

    state_names = ("c", "T")
    control_names = ("Tc",)
    k0: Array = dlx.parameter(7.2e10)
    UA: Array = dlx.parameter(2.092)
    E: Array = dlx.parameter(8750.0)
    unit: Array = dlx.parameter(1.0)

    def vector_field(self, t, x, u, w):
        c, T = x
        rate = self.unit * self.k0 * jnp.exp(-self.E / T) * c
        heat = 350 - T + 209.2 * rate + self.UA * (u[0] - T)
        return jnp.stack([1 - c - rate, heat])


RATES = ("system.k0", "system.UA")


def reactor(k0=1.0, UA=1.0, E=1.0, unit=1.0):
    """With parameters that are off by these factors."""
    system = Reactor(7.2e10 * k0 / unit, 2.092 * UA, 8750.0 * E, unit)
    return dlx.Discretized(system, dt=0.05, substeps=4)


def reacted(seed=0):
    """200 steps under a new jacket temperature every other step."""
    levels = jr.uniform(jr.key(1002), (100, 1), minval=280.0, maxval=320.0)
    controls = np.repeat(levels, 2, 0)
    states = np.asarray(open_loop(reactor(), jnp.array([0.5, 350.0]), controls))
    drawn = np.random.default_rng(seed).normal(size=states.shape)
    return states + np.array([0.01, 0.5]) * drawn, controls


@given(st.floats(-10, 20), st.sampled_from([(0.6, 1.5), (1.4, 1.3), (0.7, 0.6)]))
@settings(max_examples=4, deadline=None)
def test_units_of_a_parameter_do_not_matter(power, off):
    run = record(*reacted())
    found = sysid.physical(reactor(*off, unit=10.0**power), run, RATES)
    assert found.result == dlx.RESULTS.successful
    estimate = np.asarray(found.estimate) * np.array([1, 10.0**power])
    plain = sysid.physical(reactor(), run, RATES)
    assert_close(estimate, plain.estimate, rtol=1e-4)
    relative = [np.asarray(f.std) / np.asarray(f.estimate) for f in (found, plain)]
    assert_close(*relative, rtol=1e-3)
    assert_close(found.x0, [0.5, 350.0], atol=2.0)
    assert_close(plain.x0, [0.5, 350.0], rtol=0.02)


def test_a_fit_that_did_not_converge_gives_no_intervals():
    run = record(*reacted())
    # Twelve times the rate: the integrator diverges at once.
    hot = dict(dynamics=reactor(E=0.9), parameters=RATES)
    hurried = dict(dynamics=reactor(0.6, 1.5), parameters=RATES, max_steps=1)
    for case, result in (
        (hot, dlx.RESULTS.diverged),
        (hurried, dlx.RESULTS.not_converged),
    ):
        case = case | dict(record=run)
        found = sysid.physical(**case, throw=False)
        assert found.result == result
        for uncertain in (found.std, found.low, found.high, found.spread):
            assert np.all(np.isnan(uncertain))
        assert not np.any(found.identifiable)
        for text in (found.report(), repr(found), str(found)):
            assert "identifiable" not in text and "the fit failed" in text
        with pytest.raises(Exception, match=re.escape(dlx.RESULTS[result])):
            sysid.physical(**case)


def test_the_start_of_each_run_is_returned():
    states, controls, std = recorded()
    run = record(states, controls)
    both = [run[:41], run[40:81], run[80:100]]
    # With the true mass the residuals are not correlated, and one attempt will do.
    guess = pendulum(mass=TRUE["mass"])
    found = sysid.physical(guess, both, "system.length")
    firsts = np.stack([one.outputs[0] for one in both])
    assert_close(found.x0, firsts, atol=3 * float(std.max()))


def test_intervals_of_a_reactor_cover_the_truth():
    """More records, and more plants, are in `benchmarks.identification`."""
    truth, inside = np.array([2.092, 7.2e10]), []
    for seed in range(20):
        found = sysid.physical(reactor(0.6, 1.5), record(*reacted(seed)), RATES)
        inside += list((found.low < truth) & (truth < found.high))
    # Of 40 intervals of 95%, fewer than 33 has a chance below 0.1%.
    assert np.mean(inside) >= 33 / 40


def test_bad_input():
    states, controls = np.random.default_rng(0).normal(size=(11, 2)), np.zeros((10, 1))
    run = record(states, controls)
    with user_error(match="steps must be at most the 10 of the shortest record, got"):
        sysid.windows(run, 11)
    with user_error(match="at least 12 steps, as many as the model looks back"):
        sysid.arx(run, outputs_back=12, controls_back=1)
    with user_error(match="2 outputs and 1 controls, as the dynamics have, got 1"):
        sysid.physical(GUESS, record(states[:, :1], controls), "system.mass")
    with user_error(match="trainable"):
        sysid.physical(GUESS, run, "system.colour")
    with user_error(match="record must be a delucax.training.sysid.Record or a list"):
        sysid.linear(states)


def test_few_programs_are_compiled():
    """Each fit is a few programs, and another limit of steps compiles none of them."""
    states, controls, _ = recorded()
    few, two = record(states[:82], controls[:81]), record(states[:2], controls[:1])
    jax.clear_caches()
    with counted_programs() as events:
        sysid.linear(few, throw=False)
    assert 0 < len(events) <= 16
    # Two observations are four numbers, two of which tell where it starts: they do not
    # tell two parameters.
    options = dict(window=9, noise=0.01, throw=False)
    fit = lambda **more: sysid.physical(GUESS, two, BOTH, **options, **more)
    with counted_programs() as events:
        found = fit(max_steps=20)
    assert 0 < len(events) <= 24
    assert found.result == dlx.RESULTS.unexciting
    with counted_programs() as events:
        fit(max_steps=19)
    assert not events
