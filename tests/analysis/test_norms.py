import control
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import (
    assert_close,
    central_difference,
    needs_x64,
    user_error,
)

import delucax as dlx
from delucax.systems import LinearSystem


pytestmark = needs_x64


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
        slack = 1e-13
        assert gain * (1 - slack) <= peak.gain <= gain * (1 + 2e-4)
        if omega > 0:
            assert_close(peak.frequency, omega, rtol=2e-2)
        else:
            assert_close(peak.frequency, 0, atol=1e-3)
        there = an.frequency_response(model, peak.frequency)
        there = np.linalg.norm(np.asarray(there), 2)
        assert_close(there, peak.gain, rtol=1e-13)
        h2 = control.system_norm(theirs, 2)
        assert_close(an.h2_norm(model), h2, rtol=1e-12)
        if shape[1] == shape[2]:  # python-control refuses others
            hinf = control.system_norm(theirs, "inf", tol=1e-11)
            assert_close(peak.gain, hinf, rtol=1e-10)


@pytest.mark.parametrize("damping", [0.3, 1e-3, 1e-6])
def test_resonance_is_the_formula(damping):
    A = jnp.array([[0.0, 1.0], [-1.0, -2 * damping]])
    oscillator = LinearSystem(A, jnp.array([[0.0], [1.0]]), C=jnp.array([[1.0, 0.0]]))
    peak = an.hinf_norm(oscillator)
    gain = 1 / (2 * damping * np.sqrt(1 - damping**2))
    assert_close(peak.gain, gain, rtol=1e-9)
    assert_close(peak.frequency, np.sqrt(1 - 2 * damping**2), rtol=1e-9)


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


def spring_chain(theta):
    stiffness, damping, gain = theta
    A = jnp.array(
        [[0, 1, 0, 0], [-2, -0.3, 1, 0.1], [0, 0, 0, 1], [1, 0.1, -1, -0.2]], float
    )
    A = A.at[1, 0].add(-stiffness).at[3, 3].add(-damping)
    B = jnp.array([[0, 0], [1, 0], [0, 0], [0, 1]], float).at[1, 0].mul(gain)
    C = jnp.array([[1.0, 0, 0.2, 0], [0.0, 0, 1, 0]])
    return LinearSystem(A, B, C)


THETA = np.array([1.0, 0.1, 1.5])
SIDES = np.concatenate([np.eye(3), -np.eye(3), np.zeros((1, 3))])


def test_gradients_are_central_differences_beside_an_unstable_model():
    """Forwards; the second ones are those of reverse mode."""

    def measures(theta):
        model = spring_chain(theta)
        peak = an.hinf_norm(model, throw=False)
        values = jnp.stack([peak.gain, an.h2_norm(model), peak.frequency])
        return values, values

    thetas = np.concatenate([THETA + 1e-6 * SIDES, [[1, -5, 1.5]]])
    slopes, values = jax.jit(jax.vmap(jax.jacfwd(measures, has_aux=True)))(thetas)
    numeric = np.transpose(values[:3] - values[3:6]) / 2e-6
    assert_close(slopes[6], numeric, rtol=1e-6, atol=1e-7)
    # And what NumPy computes of concrete numbers.
    assert_close(measures(THETA)[0], values[6], rtol=1e-11)
    # The unstable one harms no other.
    assert np.all(np.isinf(values[7, :2])) and np.all(np.isfinite(values[:7]))
    assert np.all(np.isfinite(slopes))


def test_second_derivatives_are_central_differences():
    gain = lambda theta: an.hinf_norm(spring_chain(theta), throw=False).gain

    def slope(theta):
        found = jax.grad(gain)(theta)
        return found, found

    both = jax.jit(jax.vmap(jax.jacfwd(slope, has_aux=True)))
    curvatures, slopes = both(THETA + 1e-5 * SIDES)
    numeric = (slopes[:3] - slopes[3:6]) / 2e-5
    assert_close(curvatures[6], numeric, rtol=1e-6, atol=1e-6)


def test_alike_channels_have_finite_gradients():
    def gain(a):
        system = LinearSystem(-a * jnp.eye(3), jnp.eye(3))
        return an.hinf_norm(system, throw=False).gain

    value, slope = jax.jit(jax.value_and_grad(gain))(2.0)
    assert_close(value, 0.5, rtol=1e-6)
    assert_close(slope, -0.25, rtol=1e-4)


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


def test_frequency_response_and_dcgain_are_controls():
    for discrete in (False, True):
        model, theirs = random_model(3, 4, 2, 3, discrete)
        omegas = np.linspace(0.1, 8, 6).reshape(2, 3)
        found = an.frequency_response(model, omegas)
        assert found.shape == (2, 3, 3, 2)
        s = np.exp(1j * omegas * 0.3) if discrete else 1j * omegas
        expected = theirs(s.reshape(-1), squeeze=False)
        expected = np.moveaxis(expected, -1, 0).reshape(found.shape)
        close = 1e-12
        assert_close(found, expected, rtol=close, atol=close)
        assert_close(an.dcgain(model), theirs.dcgain(), rtol=close, atol=close)


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
