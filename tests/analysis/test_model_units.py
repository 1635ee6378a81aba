"""A plant in other units of time, states, inputs and outputs is the same plant."""

import numpy as np
import pytest
from helpers import assert_close, dtype, tolerance

import delucax as dlx
from delucax.systems import LinearSystem


an = dlx.analysis
rng = np.random.default_rng(0)
A = rng.normal(size=(4, 4)) - 2.5 * np.eye(4)
B, C = rng.normal(size=(4, 2)), rng.normal(size=(2, 4))
# One factor for the states, then of the time, the inputs and the outputs.
ONES = np.ones(4), 1.0, 1.0, 1.0
OTHERS = {
    "fast": (np.ones(4), 1e6, 1.0, 1.0),
    "slow": (np.ones(4), 1e-6, 1.0, 1.0),
    "strong": (np.ones(4), 1.0, 1e5, 1.0),
    "states": (np.array([1.0, 1e4, 1e-3, 1e2]), 1.0, 1.0, 1.0),
    "all": (np.array([1e3, 1.0, 1e-3, 1e2]), 1e3, 1e4, 1e-4),
}


def model(units):
    """The plant with one unit of the new time as long as `time` of the old."""
    state, time, effort, reading = units
    given = (
        A * time * state / state[:, None],
        B * time * effort / state[:, None],
        reading * C * state,
    )
    return LinearSystem(*(M.astype(dtype()) for M in given))


def properties(units):
    """The properties of the plant, in units of the first."""
    system, (state, time, effort, reading) = model(units), units
    outer = state[:, None] * state
    peak, horizon = an.hinf_norm(system), 0.7 / time
    gain = effort * reading
    gramian, over = (
        an.controllability_gramian(system, at) * outer / (time * effort**2)
        for at in (None, horizon)
    )
    energy = an.observability_gramian(system) / outer * time / reading**2
    sampled = dlx.c2d(system, horizon)
    return {
        "poles": np.sort_complex(an.poles(system)) / time,
        "zeros": np.sort_complex(an.zeros(system)) / time,
        "dcgain": an.dcgain(system) / gain,
        "hinf": peak.gain / gain,
        "frequency": peak.frequency / time,
        "h2": an.h2_norm(system) / (gain * time**0.5),
        "gramian": gramian,
        "over": over,
        "energy": energy,
        "A": sampled.A * state[:, None] / state,
        "B": sampled.B * state[:, None] / effort,
        "back": dlx.d2c(sampled).A * state[:, None] / state / time,
    }


@pytest.mark.parametrize("name", OTHERS)
def test_a_plant_in_other_units(name):
    found, expected = properties(OTHERS[name]), properties(ONES)
    for key, value in expected.items():
        close = tolerance(1e-5, 1e-13) * np.max(np.abs(value))
        np.testing.assert_allclose(found[key], value, rtol=0, atol=close, err_msg=key)


def test_plants_of_fast_oscillators():
    """As they are usually written."""
    A = np.array([[0.0, 1.0], [-2e6, -3e3]])
    B = np.array([[0.0], [1.0]])
    system = lambda C: LinearSystem(A, B, np.array([C]))
    assert_close(an.zeros(system([5e3, 1.0])), [-5e3], rtol=1e-5)
    assert an.zeros(system([1.0, 0.0])).shape == (0,)
    A[1] = -1e8, -1e3
    assert_close(an.dcgain(system([1.0, 0.0])), [[1e-8]], rtol=1e-5)
    A = np.diag([-1e-4, -1e4])
    gain = an.dcgain(LinearSystem(A, np.ones((2, 1))))
    assert_close(gain, [[1e4], [1e-4]], rtol=1e-5)


@pytest.mark.parametrize("size", [1e4, 1e9])
def test_a_strong_input(size):
    """The results are linear or quadratic in the input, however large it is."""
    pole = LinearSystem(-np.eye(1), np.full((1, 1), size))
    e, close = np.exp(-1.0), tolerance(1e-5, 1e-13)
    gramian = an.controllability_gramian(pole, 1.0)
    assert_close(gramian / size / size, [[(1 - e**2) / 2]], rtol=close)
    sampled = dlx.c2d(pole, 1.0)
    assert_close(sampled.A, [[e]], rtol=close)
    assert_close(sampled.B / size, [[1 - e]], rtol=close)
    Qd, Rd, Sd = dlx.controllers.sampled_weights(pole, np.eye(1), np.eye(1), 1.0)
    assert_close(Qd, [[(1 - e**2) / 2]], rtol=close)
    assert_close(Sd / size, [[(1 - e) - (1 - e**2) / 2]], rtol=close)
    both = 1 - 2 * (1 - e) + (1 - e**2) / 2
    assert_close(Rd / size / size, [[both + 1 / size**2]], rtol=close)
