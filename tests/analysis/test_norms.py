import control
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import (
    assert_close,
    central_difference,
    needs_x64,
    tolerance,
    user_error,
)

import delucax as dlx
from delucax.systems import LinearSystem


an = dlx.analysis


def random_model(seed, n, m, p, discrete):
    rng = np.random.default_rng(seed)
    A = rng.normal(size=(n, n))
    values = np.linalg.eigvals(A)
    if discrete:
        A = A / np.max(np.abs(values)) * 0.95
    else:
        A = A - (np.max(values.real) + 0.1) * np.eye(n)
    B, C = rng.normal(size=(n, m)), rng.normal(size=(p, n))
    if discrete:
        return dlx.LinearDynamics(A, B, C, dt=0.3), control.ss(A, B, C, 0, 0.3)
    return LinearSystem(A, B, C), control.ss(A, B, C, 0)


def swept(model, discrete):
    """The peak of the gain over a fine sweep, in NumPy."""
    A, B, C = (np.asarray(M, np.float64) for M in (model.A, model.B, model.C))
    omegas = np.linspace(0, np.pi / 0.3, 3000)
    if not discrete:
        omegas = np.concatenate([[0], np.logspace(-3, 3, 6000)])
    s = np.exp(1j * omegas * 0.3) if discrete else 1j * omegas
    eye = np.eye(len(A))
    gains = C @ np.linalg.solve(s[:, None, None] * eye - A, B.astype(complex))
    sizes = np.linalg.norm(gains, 2, axis=(1, 2))
    return np.max(sizes), omegas[np.argmax(sizes)]


@pytest.mark.parametrize("shape, discrete", [((4, 2, 3), False), ((5, 2, 2), True)])
def test_norms_are_controls_and_no_sweep_is_above(shape, discrete):
    for seed in (0, 1):
        model, theirs = random_model(seed, *shape, discrete)
        peak = an.hinf_norm(model)
        gain, omega = swept(model, discrete)
        assert peak.result == dlx.RESULTS.successful
        slack = tolerance(1e-5, 1e-13)
        assert gain * (1 - slack) <= peak.gain <= gain * (1 + 2e-4)
        if omega > 0:
            assert_close(peak.frequency, omega, rtol=2e-2)
        else:
            assert_close(peak.frequency, 0, atol=1e-3)
        there = an.frequency_response(model, peak.frequency)
        there = np.linalg.norm(np.asarray(there), 2)
        assert_close(there, peak.gain, rtol=tolerance(1e-5, 1e-13))
        h2 = control.system_norm(theirs, 2)
        assert_close(an.h2_norm(model), h2, rtol=tolerance(1e-4, 1e-12))
        if shape[1] == shape[2]:  # python-control refuses others
            hinf = control.system_norm(theirs, "inf", tol=1e-11)
            assert_close(peak.gain, hinf, rtol=tolerance(1e-4, 1e-10))


@pytest.mark.parametrize("damping", [0.3, 1e-3, pytest.param(1e-6, marks=needs_x64)])
def test_resonance_is_the_formula(damping):
    A = jnp.array([[0.0, 1.0], [-1.0, -2 * damping]])
    oscillator = LinearSystem(A, jnp.array([[0.0], [1.0]]), C=jnp.array([[1.0, 0.0]]))
    peak = an.hinf_norm(oscillator)
    gain = 1 / (2 * damping * np.sqrt(1 - damping**2))
    close = tolerance(1e-3, 1e-9)
    assert_close(peak.gain, gain, rtol=close)
    assert_close(peak.frequency, np.sqrt(1 - 2 * damping**2), rtol=close)


def test_of_two_peaks_the_higher_is_found():
    # Two resonances far apart, the narrow one higher by one part in a thousand.
    def resonance(omega, damping, gain):
        A = np.array([[0, omega], [-omega, -2 * damping * omega]])
        return A, np.array([[0], [omega * gain * 2 * damping]]), np.array([[1.0, 0]])

    wide, narrow = resonance(1.0, 0.2, 1.0), resonance(300.0, 1e-4, 1.03)
    A = np.block([[wide[0], np.zeros((2, 2))], [np.zeros((2, 2)), narrow[0]]])
    model = LinearSystem(
        A, np.concatenate([wide[1], narrow[1]]), np.concatenate([wide[2], narrow[2]], 1)
    )
    peak = an.hinf_norm(model)
    assert_close(peak.frequency, 300, rtol=1e-3)
    assert peak.gain > 1.02


SPRING = (
    np.array([[0, 1], [-3, -0.3]]),
    np.array([[0.2, 0], [0.5, 1]]),
    np.array([[1.0, 0.2], [0, 1]]),
)
ALIKE = -2 * np.eye(2), np.eye(2), np.eye(2)


def measures(e, A, B, C, dA, dB):
    """The sum of two norms and a frequency, as the model moves."""
    model = LinearSystem(A + e * dA, B + e * dB, C)
    peak = an.hinf_norm(model, throw=False)
    return peak.gain + 0.3 * an.h2_norm(model), peak.frequency


@needs_x64
def test_derivatives_are_central_differences_beside_an_unstable_model():
    """To second order, of a spring, and one of channels alike."""
    h, still = 1e-5, np.zeros((2, 2))
    stiffer, damped, stronger = np.zeros((3, 2, 2))
    stiffer[1, 0], damped[1, 1], stronger[1, 0] = -1, -1, 1
    ways = (stiffer, still), (damped, still), (still, stronger)
    batch = [(e, *SPRING, *way) for way in ways for e in (-h, 0.0, h)]
    batch += [(0.0, *ALIKE, np.eye(2), still)]
    batch += [(0.0, SPRING[0] - 5 * damped, *SPRING[1:], *ways[0])]

    @jax.jit
    @jax.vmap
    def derivatives(e, *model):
        both = jax.value_and_grad(lambda e: measures(e, *model), has_aux=True)
        (values, slope), ((forwards, turning), second) = jax.jvp(both, (e,), (1.0,))
        return jnp.stack([*values, slope, forwards, turning, second])

    found = np.asarray(derivatives(*map(np.stack, zip(*batch, strict=True))))
    low, here, high = found[:9].reshape(3, 3, 6).swapaxes(0, 1)
    # The number, the frequency and the slope; and their derivatives.
    numeric = (high[:, :3] - low[:, :3]) / (2 * h)
    assert_close(here[:, [3, 4, 5]], numeric, rtol=1e-6, atol=1e-6)
    assert_close(here[:, 2], here[:, 3], rtol=1e-9)
    # And what NumPy computes of concrete numbers.
    assert_close(measures(*batch[1]), here[0, :2], rtol=1e-11)
    # Of 1 / a in each of two channels.
    assert_close(found[9, 0], 0.5 + 0.3 * 2**-0.5, rtol=1e-6)
    assert_close(found[9, 2], 0.25 + 0.3 * 2**-2.5, rtol=1e-4)
    # The unstable one harms no other.
    assert np.isinf(found[10, 0]) and np.all(np.isfinite(found[:9]))
    assert np.all(np.isfinite(found[:, 2:4]))


def test_unstable_models_have_infinite_norms():
    values = []
    for damping in (0.5, 0.0, -0.5):
        A = np.array([[0.0, 1.0], [-4.0, -damping]])
        system = LinearSystem(A, np.array([[0.0], [1.0]]), C=np.array([[1.0, 0.0]]))
        peak = an.hinf_norm(system, throw=False)
        values.append([peak.gain, an.h2_norm(system), peak.frequency])
    values = np.array(values)
    assert_close(values[1:, :2], np.full((2, 2), np.inf))
    # Where the pole is that is to blame.
    assert_close(values[1:, 2], [2.0, np.sqrt(4 - 0.0625)], rtol=1e-5)
    # Of 1 / (s^2 + s/2 + 4), with damping ratio 1/8.
    expected = [1 / (4 * 0.25 * np.sqrt(1 - 1 / 64)), np.sqrt(1 / (2 * 4 * 0.5))]
    assert_close(values[0, :2], expected, rtol=1e-5)


def test_a_gain_of_zero():
    A, B = -np.eye(2), np.array([[1.0], [0.0]])
    silent = LinearSystem(A, B, C=np.array([[0.0, 1.0]]))
    assert an.hinf_norm(silent).gain == 0
    norm = lambda A: an.h2_norm(LinearSystem(A, B, silent.C))
    value, slope = jax.jit(jax.value_and_grad(norm))(A)
    assert value == 0
    assert np.all(np.isfinite(slope))


def test_of_nan_the_norms_are_nan():
    """A search for the least norm must not end there."""

    @jax.jit
    @jax.vmap
    def norms(a, b):
        model = LinearSystem(-a * jnp.eye(1), b * jnp.eye(1))
        peak = an.hinf_norm(model, throw=False)
        ill_posed = peak.result == dlx.RESULTS.ill_posed
        gramian = an.controllability_gramian(model, throw=False)[0, 0]
        still = an.dcgain(model, throw=False)[0, 0]
        turning = jnp.abs(an.frequency_response(model, 0.0)[0, 0])
        others = gramian, still, turning
        return jnp.stack([an.h2_norm(model), peak.gain, *others]), ill_posed

    found, ill_posed = norms(np.array([2, np.nan, 2]), np.array([1, 1, np.nan]))
    nan = np.full(5, np.nan)
    assert_close(found, [[0.5, 0.5, 0.25, 0.5, 0.5], nan, nan], rtol=1e-6)
    np.testing.assert_array_equal(ill_posed, [False, True, True])


def test_frequency_response_and_dcgain_are_controls():
    for discrete in (False, True):
        model, theirs = random_model(3, 4, 2, 3, discrete)
        omegas = np.linspace(0.1, 8, 6).reshape(2, 3)
        found = an.frequency_response(model, omegas)
        assert found.shape == (2, 3, 3, 2)
        s = np.exp(1j * omegas * 0.3) if discrete else 1j * omegas
        expected = theirs(s.reshape(-1), squeeze=False)
        expected = np.moveaxis(expected, -1, 0).reshape(found.shape)
        close = tolerance(1e-4, 1e-12)
        assert_close(found, expected, rtol=close, atol=close)
        assert_close(an.dcgain(model), theirs.dcgain(), rtol=close, atol=close)


@needs_x64
def test_frequency_response_is_differentiable_in_the_frequency():
    model, _ = random_model(4, 3, 1, 1, False)
    decibels = lambda w: 20 * jnp.log10(jnp.abs(an.frequency_response(model, w)[0, 0]))
    both = jax.jit(jax.value_and_grad(decibels))
    numeric = central_difference(lambda w: both(w)[0], 1.3)
    assert_close(both(1.3)[1], numeric, atol=1e-7)
    assert_close(decibels(1.3), both(1.3)[0], rtol=1e-11)


def test_integrators_have_no_dcgain():
    A = jnp.array([[0.0, 1.0], [0.0, -1.0]])
    B = jnp.array([[0.0], [1.0]])
    integrator = LinearSystem(A, B)
    with user_error(RuntimeError, match="dcgain: a pole is at frequency zero"):
        an.dcgain(integrator)
    with pytest.raises(Exception, match="a pole is at frequency zero"):
        jax.block_until_ready(
            jax.jit(lambda A: an.dcgain(LinearSystem(A, B)))(A),
        )
    gain = lambda A: an.dcgain(LinearSystem(A, B), throw=False)[0, 0]
    As = jnp.stack([A, A.at[1, 0].set(-2.0)])
    values, slopes = jax.jit(jax.vmap(jax.value_and_grad(gain)))(As)
    assert_close(values, [np.inf, 0.5], rtol=1e-6)
    assert np.all(np.isfinite(slopes))
    response = an.frequency_response(integrator, jnp.array([0.0, 1.0]))
    assert np.all(np.isinf(np.asarray(response[0])))
    assert np.all(np.isfinite(np.asarray(response[1])))
    with user_error(match="omega must be real and finite"):
        an.frequency_response(integrator, jnp.array([jnp.nan]))
