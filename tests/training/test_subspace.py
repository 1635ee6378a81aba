"""Linear state-space models of outputs and controls, by subspaces."""

import numpy as np
from helpers import assert_close, dtype, needs_x64, once, tolerance, user_error

import delucax as dlx
from delucax.training import sysid


RNG = np.random.default_rng(0)
# Of two controls and two outputs: a slow pair of modes and a fast one.
A = np.array([[0.9, 0.3, 0.0], [-0.3, 0.9, 0.1], [0.0, 0.0, 0.5]])
B = np.array([[0.0, 0.2], [1.0, 0.0], [0.3, 1.0]])
C = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, -2.0]])
STARTS = np.array([[1.0, 0.0, -1.0], [0.0, 2.0, 0.0], [-1.0, 1.0, 1.0]])
CONTROLS = RNG.normal(size=(3, 121, 2))


def outputs(u, x, A=A, B=B, C=C, gain=None, noise=None):
    """What a linear system in innovations form shows, by NumPy."""
    rows = []
    for k, control in enumerate(u):
        e = 0 if noise is None else noise[k]
        rows.append(C @ x + e)
        x = A @ x + B @ control + (0 if gain is None else gain @ e)
    return np.stack(rows)


OUTPUTS = np.stack([outputs(*pair) for pair in zip(CONTROLS, STARTS, strict=True)])


def record(y, u):
    return sysid.Record(y.astype(dtype()), u.astype(dtype()), dt=0.1)


def markov(A, B, C, count=25):
    A, B, C = map(np.asarray, (A, B, C))
    return np.stack([C @ np.linalg.matrix_power(A, k) @ B for k in range(count)])


def of(fit):
    return fit.model.A, fit.model.B, fit.model.C


def test_an_exact_system_of_several_records():
    # Of two lengths: the last is shorter than the stretches, and tells of B alone.
    cuts = [121, 121, 15]
    runs = zip(OUTPUTS, CONTROLS, cuts, strict=True)
    records = [record(y[:n], u[:n]) for y, u, n in runs]
    fit = sysid.subspace(records, 3)
    assert fit.result == dlx.RESULTS.successful
    atol = tolerance(1e-4, 1e-12)
    assert_close(markov(*of(fit)), markov(A, B, C), atol=atol)
    assert fit.singular_values.shape == (20,)
    assert fit.singular_values[2] > 1e3 * fit.singular_values[3]
    assert_close(fit.error, 0, atol=atol)
    assert_close(fit.model.dt, 0.1, rtol=1e-6)
    for y, u, x0 in zip(OUTPUTS, CONTROLS, fit.x0, strict=True):
        run = outputs(u, np.asarray(x0), *map(np.asarray, of(fit)))
        assert_close(run, y, atol=100 * atol)
    # A part of a record has its own first state, and a list one for each.
    later = fit.start(records[0][40:])
    run = outputs(CONTROLS[0, 40:], np.asarray(later), *map(np.asarray, of(fit)))
    assert_close(run, OUTPUTS[0, 40:], atol=100 * atol)
    assert_close(fit.start(records)[1], fit.x0[1], atol=100 * atol)


@needs_x64
def test_an_operating_point():
    shifted = record(OUTPUTS[0] + [3.0, -5.0], CONTROLS[0] + [1.0, 20.0])
    fit = sysid.subspace(shifted, 3, affine=True)
    assert_close(markov(*of(fit)), markov(A, B, C), atol=1e-10)
    x, u = fit.model.equilibrium()
    assert_close(fit.model(0.0, x, u), x, atol=1e-12)
    states = dlx.open_loop(fit.model, fit.x0, shifted.controls)[:-1]
    assert_close(states @ fit.model.C.T, shifted.outputs, atol=1e-9)
    assert_close(fit.start(shifted), fit.x0, atol=1e-9)


@needs_x64
def test_noise_and_the_kalman_gain():
    gain = np.array([[0.3, 0.0], [0.1, 0.2], [0.0, 0.1]])
    u, e = RNG.normal(size=(2, 6000, 2))
    e = e * [0.5, 1.0]
    y = outputs(u, np.zeros(3), gain=gain, noise=e)
    fit = sysid.subspace(record(y, u), 3)
    assert np.max(np.abs(np.linalg.eigvals(fit.model.A))) < 1
    size = np.max(np.abs(markov(A, B, C)))
    assert_close(markov(*of(fit)), markov(A, B, C), atol=0.05 * size)
    innovations = fit.model.A, fit.gain, fit.model.C
    assert_close(markov(*innovations), markov(A, gain, C), atol=0.1)


@needs_x64
def test_systems_that_are_not_stable():
    u = RNG.normal(size=(400, 1))
    b, c = np.array([[0.1], [1.0]]), np.array([[1.0, 0.0]])
    for a in ([[1.0, 0.2], [0.0, 1.0]], [[1.1, 0.2], [-0.1, 0.8]]):
        y = outputs(u[:120], np.ones(2), np.array(a), b, c)
        fit = sysid.subspace(record(y, u[:120]), 2)
        exact = markov(a, b, c)
        assert_close(markov(*of(fit)) / exact, 1, atol=1e-4)
        closed = fit.model.A - fit.start_gain @ fit.model.C
        assert np.max(np.abs(np.linalg.eigvals(closed))) < 1
    # An integrator with noise that it sums up.
    noise, gain = 0.1 * RNG.normal(size=(400, 1)), np.array([[0.5], [0.1]])
    a = np.array([[1.0, 0.2], [0.0, 0.5]])
    y = outputs(u, np.ones(2), a, b, c, gain, noise)
    fit = sysid.subspace(record(y, u), 2)
    assert_close(markov(*of(fit)), markov(a, b, c), atol=0.1)


@once
def test_bad_input_and_data_that_tell_too_little():
    y, u = OUTPUTS[0], CONTROLS[0]
    given = record(y, u)
    for call, match in (
        (lambda: sysid.subspace(y, 2), "record must be a delucax.training.sysid.Rec"),
        (lambda: sysid.subspace(given, 0), "order must be a whole number of at least"),
        (lambda: sysid.subspace(given, 2, horizon=0), "horizon must be a whole number"),
        (lambda: sysid.subspace(given, 7, horizon=4), "at most the 6 outputs of horiz"),
        (lambda: sysid.subspace(given, 3, horizon=30), "at least 240 windows of 60"),
        (lambda: sysid.subspace(given[:9], 3), "24 windows of 6 .*got 4 in 9"),
        (lambda: sysid.subspace(given, 1, affine=True), "at most the 1 states, if aff"),
        (lambda: given.split(1.5), "share must be between 0 and 1, got 1.5"),
    ):
        with user_error(match=match):
            call()
    with user_error(match="must have 2 outputs and 2 controls.*got 1 and 2"):
        sysid.subspace(given, 3).start(record(y[:, :1], u))
    # A sine excites two directions, and no more.
    t = np.arange(121.0)
    slow = record(outputs(u * 0, STARTS[0]), np.sin([0.3 * t, 0.3 * t + 1]).T)
    fit = sysid.subspace(slow, 3, throw=False)
    assert fit.result == dlx.RESULTS.unexciting
    with user_error(RuntimeError, match="^sysid.subspace: .*excite the system too"):
        sysid.subspace(slow, 3)
    # More states than there are leave numbers, if not a model of use.
    assert np.all(np.isfinite(sysid.subspace(given, 8, throw=False).model.A))
