"""The physics of the lungs, and the published numbers of the original's."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import assert_close, needs_x64, user_error
from hypothesis import given, settings, strategies as st
from original_lungs import (
    OriginalBalloonLung,
    OriginalDelayLung,
    OriginalSingleCompartment,
)

import delucax as dlx
from delucax import lung
from delucax.controllers import LeakyPID


pytestmark = needs_x64

DT = 0.03
LUNGS = {
    "single": lung.SingleCompartment(valves=lung.Valves(leak=0.01)),
    "double": lung.DoubleCompartment(valves=lung.Valves(leak=0.01)),
    "balloon": lung.BalloonLung(valves=lung.Valves(leak=0.01)),
    "delay": lung.DelayLung(valves=lung.Valves(leak=0.01)),
}


def test_total_of_the_original_notebook():
    dynamics = OriginalBalloonLung()
    waveform = lung.BreathWaveform(
        keypoints=(0, 1e-8 / 3, 1 / 3, 0.5, 1), levels=(0, 1, 1, 0, 0)
    )
    # What a hidden step left behind.
    x = dynamics(0.0, jnp.array([1.5, -1.0]), jnp.zeros(2))
    assert_close(x[1], 0.054874, rtol=1e-4)
    pid = LeakyPID(jnp.full(2, 3.0), jnp.full(2, 4.0), jnp.zeros(2), dt=DT)
    state, target, total = pid.init(), 5.0, 0.0
    for k in range(10):
        error = dynamics.observe(0.0, x)[0] - target
        u, state = pid(DT * k, jnp.full(2, error), state)
        target = waveform.pressure(DT * k)
        total -= abs(target - x[1])
        x = dynamics(DT * k, x, u)
    assert_close(total, -170.7004493227582, rtol=1e-12)


ORIGINALS = {
    "balloon": (
        OriginalBalloonLung(),
        [1.5, 0.0],
        [21.738, 4.137, 2.597, 3.997, 6.760],
    ),
    "balloon, gain 1": (
        OriginalBalloonLung(gain=1.0),
        [1.5, 0.0],
        [22.449, 4.896, 4.710, 2.885, 6.513],
    ),
    "balloon, rest 6, gain 1": (
        OriginalBalloonLung(gain=1.0, rest=6.0),
        [6.0, 0.0],
        [22.497, 17.356, 17.824, 17.358, 18.207],
    ),
    "delay, 25 steps": (
        OriginalDelayLung(),
        [1.5] + [0.0] * 50,
        [22.500, 21.857, 22.029, 21.857, 22.263],
    ),
    "delay, 10 steps": (
        OriginalDelayLung(delay=10),
        [1.5] + [0.0] * 20,
        [22.500, 14.849, 14.634, 14.821, 15.868],
    ),
    "single compartment": (
        OriginalSingleCompartment(),
        [0.2, 0.2 / 50 + 10],
        [12.489, 10.808, 8.267, 9.003, 5.023],
    ),
}
GAINS = jnp.array([[1.0, 1, 0], [1, 1, 0], [3, 4, 0], [10, 10, 0], [0, 10, 10]])


@pytest.mark.parametrize("name", ORIGINALS)
def test_scores_of_the_original(name):
    """Zero, bang-bang and three PIDs, over six peak pressures."""
    dynamics, x0, expected = ORIGINALS[name]

    @jax.jit
    def score(kind, gains, pip):
        waveform = lung.BreathWaveform.at_pip(lung.BreathWaveform(), pip)
        pid = LeakyPID(*gains, dt=DT, reference=waveform, bounds=(0, 100))
        bang = lung.BangBang(waveform)

        def body(carry, k):
            x, memory = carry
            t, y = DT * k, dynamics.observe(0.0, x)
            u, memory = pid(t, y, memory)
            u = jnp.select([kind == 0, kind == 1], [0 * u, bang(t, y, None)[0]], u)
            after = dynamics.advance(t, x, jnp.append(u, 0.0), None)[0]
            return (after, memory), jnp.abs(waveform(t) - y)[0]

        start = jnp.array(x0), pid.init()
        return jnp.mean(jax.lax.scan(body, start, jnp.arange(29))[1])

    over_pips = jax.vmap(score, (None, None, 0))
    pips = jnp.arange(10.0, 36.0, 5.0)
    found = jax.vmap(over_pips, (0, 0, None))(jnp.arange(5), GAINS, pips)
    assert_close(jnp.mean(found, axis=1), expected, atol=5.01e-4)


@pytest.mark.parametrize("name", LUNGS)
def test_order_of_the_solver(name):
    """It goes to a fine solution at the fourth order, under controls that switch."""
    plant = LUNGS[name]
    rng = np.random.default_rng(0)
    controls = np.stack([rng.uniform(5, 40, 10), rng.uniform(0, 1, 10)], 1)
    interval = 0.01 if name == "delay" else DT

    def end(pieces):
        dynamics = dlx.Discretized(plant, dt=interval, substeps=pieces)
        return dlx.open_loop(dynamics, plant.resting(5.0), controls)[-1]

    best = end(64)
    coarse, fine = (np.max(np.abs(end(n) - best)) for n in (4, 8))
    assert fine < 1e-3 and 0.8 * 16 < coarse / fine < 1.5 * 16


@pytest.mark.parametrize("name", LUNGS)
def test_steady_state(name):
    """With a held valve: by the leak alone, and by the expiratory valve alone."""
    for leak, u, expected in (
        (0.01, [12.0, 0.0], lambda v: v.flow(12.0) / 0.01),
        (0.0, [20.0, 1.0], lambda v: 5 + v.flow(20.0) * v.expiratory_resistance),
    ):
        plant = dlx.replace(LUNGS[name], {"valves.leak": leak})
        substeps = 8 if name == "delay" else 2
        dynamics = dlx.Discretized(plant, dt=0.05, substeps=substeps)
        controls = jnp.tile(jnp.array(u), (4000, 1))
        last = dlx.open_loop(dynamics, plant.resting(5.0), controls)[-1]
        assert_close(plant.pressure(last), expected(plant.valves), rtol=1e-9)


@pytest.mark.parametrize("name", LUNGS)
def test_volumes_balance(name):
    """What flows in is what flows out and what stays, to rounding, in any state."""
    plant = LUNGS[name]
    rng = np.random.default_rng(1)
    for _ in range(5):
        x = plant.resting(10.0) * jnp.asarray(rng.uniform(0.8, 1.5, plant.state_size))
        x = x.at[:2].set(rng.uniform(0, 1, 2))
        slope = plant.vector_field(0.0, x, jnp.array([30.0, 0.5]), None)
        stored = jnp.sum(slope[2:])
        if name == "delay":
            stored = slope[3] + 1e-3 * plant.pipe * slope[2]
        outflow = plant.valves.outflow(x[1], plant.pressure(x))
        assert_close(x[0], stored + outflow, rtol=1e-12)


@pytest.mark.parametrize("name", LUNGS)
def test_rests_where_it_says(name):
    plant = dlx.replace(LUNGS[name], {"valves.leak": 0.0})
    x = plant.resting(12.0)
    assert_close(plant.observe(0.0, x), [12.0], rtol=1e-12)
    assert_close(plant.vector_field(0.0, x, jnp.zeros(2), None), 0.0, atol=1e-12)


@pytest.mark.parametrize("name", ["single", "double", "balloon"])
@settings(max_examples=50, deadline=None, database=None)
@given(
    resistance=st.floats(5.0, 80.0),
    inflow=st.floats(0.0, 100.0),
    opening=st.floats(0.0, 1.0),
)
def test_a_breath_begins_as_its_equation_says(name, resistance, inflow, opening):
    """A stage of a solver looks at an expiratory valve that has closed too far, where
    the balance of the flows has no solution at some resistances."""
    coarse, fine = (breath(name, n, resistance, inflow, opening) for n in (1, 16))
    assert_close(coarse, fine, atol=0.01)


def breath(name, substeps, resistance, inflow, opening):
    return first_step(
        LUNGS[name], substeps, jnp.array([resistance, inflow, opening], float)
    )


@functools.partial(jax.jit, static_argnums=1)
def first_step(plant, substeps, numbers):
    resistance, inflow, opening = numbers
    plant = dlx.replace(plant, {"resistance": resistance})
    x0 = plant.resting(10.0).at[1].set(opening)
    u = jnp.stack([inflow, jnp.zeros(())])
    return dlx.Discretized(plant, DT, substeps=substeps)(0.0, x0, u)[2:]


@pytest.mark.parametrize("name", LUNGS)
def test_slope_where_the_valve_is_shut(name):
    """A valve that is about to open has the slope of one that is open."""
    plant = LUNGS[name]
    x = plant.resting(12.0)
    slope = lambda opening: jax.jacfwd(
        lambda o: plant.vector_field(0.0, x.at[1].set(o), jnp.zeros(2), None)
    )(opening)
    assert_close(slope(0.0), slope(1e-9), rtol=1e-6)
    assert np.any(slope(0.0)[2:] != 0)


def test_the_quickest_lung_rests_while_its_valve_is_open():
    """What rounding moves comes to rest again: the steps are short enough."""
    env = lung.double_compartment(resistance=5.0, compliance=10.0, noise=0.0)
    x0 = env.initial_state.at[2].multiply(1.01)
    controls = jnp.tile(jnp.array([0.0, 1.0]), (200, 1))
    states = dlx.open_loop(env.dynamics, x0, controls)
    assert_close(states[-1][env.cost.index], 5.0, rtol=1e-5)


def test_balloon_has_a_greatest_pressure():
    with user_error(match="pressure must be at most the 69.* that the balloon"):
        lung.BalloonLung().resting(80.0)


def test_nine_lungs_at_once_and_their_derivatives():
    R, C = (a.ravel() for a in np.meshgrid([5.0, 20.0, 50.0], [10.0, 20.0, 50.0]))
    u = jnp.linspace(40.0, 10.0, 5)

    def last(R, C):
        return lung.LungModel(lung.SingleCompartment(R, C)).predict(u)[-1]

    both = jax.jit(jax.vmap(jax.value_and_grad(last, (0, 1))))
    _, (by_R, by_C) = both(R, C)
    h = 1e-5
    rise = lambda dR, dC: (both(R + dR, C + dC)[0] - both(R - dR, C - dC)[0]) / (2 * h)  # noqa: E731
    assert_close(by_R, rise(h, 0), rtol=1e-6)
    assert_close(by_C, rise(0, h), rtol=1e-6)


def test_valve_is_closed_and_fully_open_at_its_ends():
    valves = lung.Valves(max_flow=2.0)
    flows = valves.flow(jnp.linspace(0.0, 100.0, 11))
    assert_close(flows[jnp.array([0, 10])], [0.0, 2.0], atol=1e-12)
    assert np.all(np.diff(flows) > 0)


def test_sensor_is_late():
    plant = lung.SingleCompartment()
    dynamics = dlx.Discretized(plant, dt=DT)
    env = lung.ventilation(dynamics, resting_state=plant.resting(5.0), sensor_delay=2)
    controls = jnp.array([[30.0, 0.0]] * 6)
    states = dlx.open_loop(env.dynamics, env.initial_state, controls)
    now = states[:, env.cost.index]
    observed = jax.vmap(lambda x: env.dynamics.observe(0.0, x)[0])(states)
    assert_close(now, jax.vmap(lambda x: plant.pressure(x[:3]))(states), rtol=1e-12)
    assert_close(observed, jnp.concatenate([jnp.full(2, 5.0), now[:-2]]), rtol=1e-12)
    with user_error(match="must observe one pressure, got 2"):
        lung.PressureSensor(dlx.Discretized(dlx.systems.Pendulum(), dt=DT))


def test_waveform():
    waveform = lung.BreathWaveform(pip=30.0, rate=10.0)
    times = jnp.array([0.0, 1.9, 2.5, 3.5, 6.0, 8.5])
    expected = [30.0, 30.0, 17.5, 5.0, 30.0, 17.5]
    assert_close(waveform.pressure(times), expected, rtol=1e-12)
    assert waveform(0.1).shape == (1,)
    inhaling = waveform.is_inspiration(jnp.array([0.0, 2.0, 2.1, 5.99, 6.0]))
    assert inhaling.tolist() == [True, True, False, False, True]
    slope = jax.grad(lambda pip: lung.BreathWaveform(pip).pressure(1.25))(35.0)
    assert_close(slope, 0.5, rtol=1e-12)
    # The beginning of a breath, however k dt rounds.
    many = lung.BreathWaveform().pressure(DT * jnp.arange(0, 10_000, 100))
    assert_close(many, 35.0)
    k = np.arange(100_000)
    inhaling = lung.BreathWaveform().is_inspiration(0.1 * jnp.asarray(k))
    np.testing.assert_array_equal(inhaling, k % 30 <= 10)


def test_wrong_waveforms_are_named():
    with user_error(match="keypoints must increase from 0 to 1"):
        lung.BreathWaveform(keypoints=(0.0, 0.5, 0.4, 1.0))
    with user_error(match="pip must be at least peep = 5.0, got 3"):
        lung.BreathWaveform(pip=3.0)
    with user_error(match="keypoints and levels must be vectors of one size"):
        lung.BreathWaveform(levels=(1.0, 0.0))
    with user_error(match="rate must be positive"):
        lung.BreathWaveform(rate=0.0)
    with user_error(match="inspiration must be between 0 and 1"):
        lung.BreathWaveform(inspiration=1.5)
    with user_error(match="there is no BreathWaveform in"):
        lung.BreathWaveform.at_pip(lung.SingleCompartment(), 20.0)
    with user_error(match="at_pip: pip must be at least peep"):
        lung.BreathWaveform.at_pip(lung.BreathWaveform(), 2.0)


def test_delayed_controls_and_sensor():
    plant = dlx.Discretized(dlx.systems.Pendulum(), dt=0.05)
    controls = jnp.sin(jnp.arange(8.0))[:, None]
    late = dlx.dynamics.Delayed(plant, controls=2, sensor=1)
    x0 = jnp.array([0.3, 0.1])
    states = dlx.open_loop(late, late.filled(x0), controls)
    shifted = jnp.concatenate([jnp.zeros((2, 1)), controls[:-2]])
    expected = dlx.open_loop(plant, x0, shifted)
    assert_close(jax.vmap(late.inner)(states), expected, rtol=1e-12)
    seen = jax.vmap(lambda x: late.observe(0.0, x))(states)
    assert_close(seen[1:], expected[:-1], rtol=1e-12)
    assert len(late.state_names) == late.state_size == 2 + 2 + 2
    with user_error(match="controls must be a whole number of at least 0"):
        dlx.dynamics.Delayed(plant, controls=-1)
