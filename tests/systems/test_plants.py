"""Tanks, a motor, masses on springs and oscillators."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.optimize
from helpers import assert_close, needs_x64, user_error

import delucax as dlx


pytestmark = needs_x64
s = dlx.systems


def field(system, x, u, w=None):
    x, u = jnp.asarray(x, float), jnp.asarray(u, float)
    return vector_field(system, x, u, None if w is None else jnp.asarray(w))


@eqx.filter_jit
def vector_field(system, x, u, w):
    return system.vector_field(0.0, x, u, w)


def test_tanks_drain_by_torricelli():
    tanks = s.TwoTank(lower_outlet=0.05)
    out = np.sqrt(2 * 981.0) * np.array([0.071 * np.sqrt(9.0), 0.05 * np.sqrt(4.0)])
    expected = [(12.0 - out[0]) / 28, (out[0] - out[1]) / 28]
    assert_close(field(tanks, [9.0, 4.0], [12.0]), expected, rtol=1e-5)
    slope = jax.jit(jax.jacobian(lambda x: field(tanks, x, [0.0])))(jnp.zeros(2))
    assert np.all(np.isfinite(slope)) and slope[0, 0] < 0


@pytest.mark.parametrize("level", [0.0, 0.001, 5.0])
def test_tanks_rest_at_any_level(level):
    tanks = s.TwoTank(lower_outlet=0.09)
    x, u = tanks.equilibrium(level)
    assert_close(field(tanks, x, u), [0, 0], atol=1e-14)
    assert_close(x[1], level)


def test_an_empty_tank_stays_so():
    dynamics = dlx.Discretized(s.TwoTank(), dt=1.0)
    states = dlx.open_loop(dynamics, jnp.array([5.0, 0.0]), jnp.zeros((600, 1)))
    assert np.all(states >= -1e-6) and states[-1, 0] < 0.01


def test_a_reactor_rests_at_any_concentration():
    reactor = s.CSTR()
    for c in (0.2, 0.5, 0.8):
        x, u = reactor.equilibrium(c)
        assert_close(field(reactor, x, u), [0, 0], atol=2e-12)
        assert_close(x[0], c)
    # The root of the vector field, from the numbers of the literature.
    x, u = reactor.equilibrium()
    slopes = jax.jit(
        jax.jacobian(lambda z: field(reactor, jnp.stack([0.5, z[0]]), z[1:]))
    )
    root = scipy.optimize.root(
        lambda z: np.asarray(field(reactor, [0.5, z[0]], [z[1]])),
        [350.0, 300.0],
        jac=lambda z: np.asarray(slopes(z)),
        tol=1e-15,
    ).x
    assert_close([x[1], u[0]], root, rtol=1e-14)
    assert_close([x[1], u[0]], [350.001, 300.0014], atol=1e-4)
    control = lambda rate: s.CSTR(rate=rate).equilibrium()[1]
    slope = jax.jit(jax.jacobian(control))(7.2e10)
    assert_close(
        slope[0], (s.CSTR(rate=7.2e10 + 1e4).equilibrium()[1] - u)[0] / 1e4, rtol=1e-2
    )


def test_a_reactor_does_not_stay_by_itself():
    reactor = s.CSTR()
    x, u = reactor.equilibrium()
    slopes = jax.jit(jax.jacobian(lambda x: field(reactor, x, u)))
    poles = np.linalg.eigvals(slopes(x))
    assert_close(np.sort(poles.real), [-0.454, 2.834], atol=1e-3)
    dynamics = dlx.Discretized(reactor, 0.05, substeps=8)
    for shift in (-1.0, 1.0):
        start = x + jnp.array([0.0, shift])
        states = dlx.open_loop(dynamics, start, jnp.tile(u, (400, 1)))
        # It goes out, from the warm side after running hot.
        assert (jnp.max(states[:, 1]) > 400.0) == (shift > 0)
        assert_close(states[-1], [0.8772, 324.4784], atol=1e-4)
    assert np.all(np.isfinite(field(reactor, [0.5, -10.0], u)))


def test_motor_in_the_steady_state():
    """At a standstill a voltage along the magnets drives v / R and no torque; at speed
    the power that goes in is lost in copper and friction."""
    motor = s.PermanentMagnetMotor()
    x, u = jnp.array([2.0, 0.0, 0.0]), jnp.array([2.0 * 2.875, 0.0])
    assert_close(field(motor, x, u), np.zeros(3), atol=1e-4)
    x, u = motor.equilibrium(100.0)
    power = 1.5 * jnp.dot(u, x[:2])
    lost = 1.5 * 2.875 * jnp.dot(x[:2], x[:2]) + 0.001 * 100.0**2
    assert_close(power, lost, rtol=1e-12)
    slowed = field(motor, x, u, [0.8])[2] - field(motor, x, u)[2]
    assert_close(slowed, -0.8 / 0.0008, rtol=1e-4)
    salient = s.PermanentMagnetMotor(d_inductance=0.006, q_inductance=0.009)
    torque = 6 * (0.175 * 3.0 + (0.006 - 0.009) * -2.0 * 3.0)
    assert_close(salient.torque(jnp.array([-2.0, 3.0, 0.0])), torque, rtol=1e-5)


def test_a_chain_has_the_matrices_of_a_chain():
    k, c, m = (
        np.array([1.0, 2.0, 3.0]),
        np.array([0.1, 0.2, 0.3]),
        np.array([1, 2, 4.0]),
    )
    chain = s.MassSpringDamper(m, k, c, masses=3)

    def joined(k):
        return np.array(
            [
                [k[0] + k[1], -k[1], 0],
                [-k[1], k[1] + k[2], -k[2]],
                [0, -k[2], k[2]],
            ]
        )

    model = dlx.linearize(chain)
    lower = -np.concatenate([joined(k), joined(c)], axis=1) / m[:, None]
    assert_close(model.A[3:], lower, rtol=1e-6)
    assert_close(model.B[:, 0], [0, 0, 0, 0, 0, 1 / 4])
    assert chain.state_names[0] == "position_1" and len(chain.state_units) == 6
    assert s.MassSpringDamper().state_names == ("position", "velocity")
    with user_error(match=r"stiffness must be a number or have shape \(2,\), got"):
        s.MassSpringDamper(stiffness=k, masses=2)


def test_lorenz_rests_on_its_wing():
    x, u = s.Lorenz().equilibrium()
    assert_close(x, [np.sqrt(72), np.sqrt(72), 27], rtol=1e-6)
    x, _ = s.Lorenz(rho=0.5).equilibrium()
    assert_close(x, np.zeros(3))
    slope = jax.jit(jax.jacobian(lambda rho: s.Lorenz(rho=rho).equilibrium()[0]))
    assert np.all(np.isfinite(slope(0.5))) and np.all(np.isfinite(slope(28.0)))


def test_van_der_pol_goes_to_its_cycle():
    dynamics = dlx.Discretized(s.VanDerPol(), dt=0.05)
    states = dlx.open_loop(dynamics, jnp.array([0.1, 0.0]), jnp.zeros((1200, 1)))
    # The amplitude at mu = 1, of the literature.
    assert_close(np.max(states[800:, 0]), 2.0086, atol=2e-3)


@pytest.mark.parametrize(
    "call, match",
    [
        (lambda: s.DoubleIntegrator(0.0), "mass must be positive"),
        (lambda: s.MassSpringDamper(masses=0), "masses must be a whole number"),
        (lambda: s.TwoTank(smoothing=0.0), "smoothing must be positive"),
        (lambda: s.CSTR(flow=0.0), "flow must be positive"),
        (lambda: s.PermanentMagnetMotor(flux=-1.0), "flux must be positive"),
        (lambda: s.NeuralSystem(2, 1, key=0), "NeuralSystem: key must be one random"),
        (
            lambda: s.NeuralSystem(2, 1, depth=-1, key=jax.random.key(0)),
            "depth must be a whole number of at least 0",
        ),
        (
            lambda: s.NeuralSystem(2.5, 1, key=jax.random.key(0)),
            "NeuralSystem: states must be a whole number or a tuple of names, got 2.5",
        ),
    ],
)
def test_bad_constants(call, match):
    with user_error(match=match):
        call()
