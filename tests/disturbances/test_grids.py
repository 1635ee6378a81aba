"""What is switched on and off at given times acts in exactly the steps that it should,
however the times of the steps are rounded."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import needs_x32, user_error
from hypothesis import given, settings, strategies as st

import delucax as dlx


d = dlx.disturbances
MOST = 2**22
PULSE, WAVE = 20, 64  # how many times are looked at

INTERVALS = (0.01, 0.02, 0.001, 1 / 3, 0.05, 0.0001, 0.7)
intervals = st.sampled_from(INTERVALS) | st.floats(1e-5, 10)
# As many small as large ones.
steps = (
    st.integers(0, MOST) | st.integers(0, 22).map(lambda n: 2**n) | st.integers(0, 9)
)


@eqx.filter_jit
def sequence(disturbance, k, dt):
    """The disturbance at steps `k`, timed as a rollout times them."""
    return disturbance.sequence(None, (k * dt).astype(dt.dtype))[:, 0]


def padded(k, size):
    """`k` repeated at its end, for programs of one shape."""
    return np.concatenate([k, np.full(size - len(k), k[-1])])


def pulse(start, stop, first, last, dt):
    """Whether a window acts from step `first` to before `last`, of those around."""
    near = np.concatenate([c + np.arange(-4, 5) for c in (first, last)])
    k = padded(np.unique(np.clip([0, 1, *near], 0, MOST)), PULSE)
    window = d.Constant(1.0, size=1).between(start, stop)
    w = sequence(window, jnp.asarray(k), jnp.asarray(dt))
    np.testing.assert_array_equal(w, (k >= first) & (k < last))


def test_shocks_on_a_thousand_grids():
    rng = np.random.default_rng(0)
    dt = np.where(rng.random(1000) < 0.5, rng.choice(INTERVALS, 1000), 0)
    dt = np.where(dt > 0, dt, 10 ** rng.uniform(-5, 1, 1000))
    size = 2 ** rng.uniform(0, 22, (2, 1000))
    first = np.minimum(size[0].astype(int), MOST - 1)
    last = np.minimum(first + np.where(size[1] < 2048, size[1], 5).astype(int), MOST)
    near = [c[:, None] + np.arange(-4, 5) for c in (first, last)]
    k = np.sort(np.clip(np.concatenate(near, axis=1), 1, MOST))
    k = np.concatenate([np.broadcast_to([0, 1], (1000, 2)), k], axis=1)

    @eqx.filter_jit
    @eqx.filter_vmap
    def acts(k, dt, start, stop):
        push = d.Constant(1.0, size=1).between(start, stop)
        return push.sequence(None, (k * dt).astype(dt.dtype))[:, 0]

    w = acts(*(jnp.asarray(a) for a in (k, dt, first * dt, last * dt)))
    expected = (k >= first[:, None]) & (k < last[:, None])
    np.testing.assert_array_equal(w, expected)


@settings(max_examples=100, deadline=None)
@given(dt=intervals, first=steps, count=steps, as_arrays=st.booleans())
def test_a_shock_acts_in_its_steps(dt, first, count, as_arrays):
    last = min(first + count, MOST)
    start, duration = first * dt, (last - first) * dt
    if as_arrays:
        step = jnp.asarray(dt)
        start, duration = first * step, (last - first) * step
    shock = d.shock(1.0, start=start, duration=duration, size=1)
    pulse(shock.start, shock.stop, first, last, dt)


@settings(max_examples=100, deadline=None)
@given(
    dt=intervals,
    first=st.integers(0, 10_000),
    count=st.integers(0, 1000),
    early=st.floats(0.1, 0.9),
    late=st.floats(0.1, 0.9),
)
def test_between_steps_times_are_compared_as_they_are(dt, first, count, early, late):
    start, stop = (first + early) * dt, (first + count + 1 + late) * dt
    pulse(start, stop, first + 1, first + count + 2, dt)


@settings(max_examples=100, deadline=None)
@given(dt=intervals, period=st.integers(1, 500), share=st.floats(0, 1), at=steps)
def test_a_square_wave_of_whole_steps(dt, period, share, at):
    high = round(share * period)
    k = np.unique(np.clip([0, 1, *(at + np.arange(WAVE - 2))], 0, MOST))
    k = padded(k, WAVE)
    wave = d.Square(1.0, period=period * dt, duty=high / period, size=1)
    w = sequence(wave, jnp.asarray(k), jnp.asarray(dt))
    np.testing.assert_array_equal(w, np.where(k % period < high, 1, -1))


@settings(max_examples=100, deadline=None)
@given(dt=intervals, period=st.integers(3, 41), high=st.integers(1, 40))
def test_a_square_wave_of_half_steps(dt, period, high):
    """Of two periods that are a whole number of steps together."""
    high = min(high, period - 1)
    k = np.arange(WAVE)
    wave = d.Square(1.0, period=period / 2 * dt, duty=high / period, size=1)
    w = sequence(wave, jnp.asarray(k), jnp.asarray(dt))
    np.testing.assert_array_equal(w, np.where(2 * k % period < high, 1, -1))


@settings(max_examples=100, deadline=None)
@given(dt=intervals, begin=st.integers(0, 100_000), first=st.integers(0, 30))
def test_a_horizon_that_does_not_begin_at_zero(dt, begin, first):
    k = begin + jnp.arange(32)
    shock = d.shock(1.0, start=(begin + first) * dt, duration=5 * dt, size=1)
    w = sequence(shock, k, jnp.asarray(dt))
    steps = np.arange(32)
    np.testing.assert_array_equal(w, (steps >= first) & (steps < first + 5))


def test_a_single_time():
    single = eqx.filter_jit(lambda d, t: d.sequence(None, t))
    push = d.Constant(1.0, size=1).between(1.0, 2.0)
    wave = d.Square(1.0, period=3.0, size=1)
    for t, inside, high in ((0.0, 0, 1), (1.0, 1, 1), (1.9, 1, -1), (2.0, 0, -1)):
        times = jnp.array([t])
        assert single(push, times) == inside
        assert single(wave, times) == high


def test_every_step_of_a_long_horizon():
    k, dt = jnp.arange(MOST), jnp.asarray(0.02)
    w = sequence(d.shock(1.0, 41943.04, 0.1, size=1), k, dt)
    np.testing.assert_array_equal(np.flatnonzero(w), 2097152 + np.arange(5))


@needs_x32
def test_more_steps_than_single_precision_tells_apart():
    push = d.shock(1.0, start=1.0, duration=1.0, size=1)
    wave = d.Square(1.0, period=1.0, size=1)
    for name, disturbance in (("between", push), ("Square", wave)):
        with user_error(match=f"{name}: the horizon .* at most 4194304.*X64"):
            sequence(disturbance, jnp.arange(MOST + 1), jnp.asarray(0.01))
        late = 1e6 + 0.01 * jnp.arange(9)
        with user_error(
            match=f"{name}: times in float32 are too coarse for steps of .*"
        ):
            disturbance.sequence(None, late)
        # In a compiled program times are not known.
        w = eqx.filter_jit(lambda d, t: d.sequence(None, t))(disturbance, late)
        assert np.all(np.isnan(w))


def test_late_brownian_increments_have_the_size_of_their_step(key):
    late = 1000 + 1e-3 * jnp.arange(100)
    known = d.Brownian(1, dt=1e-3).sequence(key, late)
    np.testing.assert_allclose(d.Brownian(1).sequence(key, late), known, rtol=1e-3)


@pytest.mark.parametrize("k", [0, 7])
def test_a_rollout_meets_a_shock_of_whole_steps(k, key):
    dynamics = dlx.LinearDynamics(jnp.eye(1), jnp.eye(1), dt=0.02)
    push = d.shock(1.0, start=k * 0.02, duration=5 * 0.02, size=1)
    cost = dlx.costs.Quadratic(jnp.eye(1), jnp.eye(1))
    env = dlx.Environment(dynamics, cost, push, horizon=20)
    run = dlx.rollout(env, dlx.controllers.Zero(1), key=key)
    acted = np.flatnonzero(run.disturbances[:, 0])
    np.testing.assert_array_equal(acted, k + np.arange(5))
