"""Maps from event to event, their fixed points and multipliers."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import assert_close, needs_x64, once

import delucax as dlx


GUESS = jnp.array([0.1 - np.pi / 8, 1.2])


def wheel(slope=0.1, dt=0.005):
    return dlx.Discretized(dlx.systems.RimlessWheel(slope=slope), dt=dt)


@needs_x64
def test_the_rimless_wheel_has_its_multiplier():
    """cos(2 half)^2, and the speed of the energy that a step gains."""
    orbit = dlx.analysis.periodic_orbit(wheel(), "step", GUESS)
    assert orbit.result == dlx.RESULTS.successful
    kept = np.cos(np.pi / 4) ** 2
    assert_close(orbit.multipliers, [kept, 0.0], atol=1e-8)
    gained = 4 * 9.81 * np.sin(np.pi / 8) * np.sin(0.1)
    speed = np.sqrt(kept * gained / (1 - kept))
    assert_close(orbit.state[1], speed, rtol=1e-9)
    of_slope = lambda slope: dlx.analysis.periodic_orbit(
        wheel(slope, 0.02), "step", GUESS
    ).state[1]
    assert_close(jax.grad(of_slope)(0.1), speed / (2 * np.tan(0.1)), rtol=1e-6)
    forward = jax.jvp(of_slope, (0.1,), (1.0,))[1]
    assert_close(forward, speed / (2 * np.tan(0.1)), rtol=1e-6)


def walk(slope, guess):
    """The gait of the simplest walker, from its first two states."""
    dynamics = dlx.Discretized(dlx.systems.SimplestWalker(slope=slope), dt=0.05)
    angle, rate = guess
    rest = 2 * angle, (1 - jnp.cos(2 * angle)) * rate
    return dlx.analysis.periodic_orbit(dynamics, "step", jnp.array([*guess, *rest]))


@needs_x64
def test_the_simplest_walker_is_that_of_its_paper():
    orbit = walk(0.009, (0.2, -0.2))
    assert_close(orbit.state[:2], [0.200311, -0.199832], atol=1e-6)
    pair = -0.19010 + 0.55760j
    assert_close(jnp.sort(orbit.multipliers)[:2], [pair.conjugate(), pair], atol=1e-5)
    # Its period doubles where a multiplier passes -1.
    between = walk(0.012, orbit.state[:2])
    before = walk(0.0150, between.state[:2])
    beyond = walk(0.0152, before.state[:2])
    assert jnp.abs(before.multipliers[0]) < 1 < jnp.abs(beyond.multipliers[0])


@needs_x64
def test_the_compass_gait_is_that_of_its_paper():
    # All digits of the paper, with its gravity.
    dynamics = dlx.Discretized(dlx.systems.CompassGait(gravity=9.8), dt=0.02)
    guess = [-0.323, 0.218, -0.378, -1.092]
    orbit = dlx.analysis.periodic_orbit(dynamics, "step", guess)
    assert_close(orbit.state, [-0.3234, 0.2187, -0.3772, -1.0918], atol=5e-5)
    assert_close(orbit.period, 0.7347, atol=5e-5)
    assert_close(orbit.multipliers[:2].real, -0.1997, atol=5e-5)
    assert_close(jnp.abs(orbit.multipliers[:2].imag), 0.5445, atol=5e-5)
    assert_close(orbit.multipliers[2], 0.1316, atol=5e-5)


@needs_x64
def test_the_time_of_return_has_a_derivative():
    time = jax.jit(lambda x: dlx.analysis.poincare_map(wheel(dt=0.02), "step", x).time)
    slope = jax.grad(time)(GUESS)
    h = jnp.array([0.0, 1e-5])
    assert_close(slope[1], (time(GUESS + h) - time(GUESS - h)) / 2e-5, rtol=1e-6)


@once
def test_an_event_that_does_not_come():
    options = dict(max_steps=20, throw=False)
    missed = dlx.analysis.poincare_map(wheel(dt=0.01), "step back", GUESS, **options)
    assert missed.result == dlx.RESULTS.not_converged
    # It comes in the 12th interval; a loop in blocks could take that many.
    for most, result in ((11, "not_converged"), (12, "successful")):
        options |= dict(max_steps=most)
        late = dlx.analysis.poincare_map(wheel(dt=0.067), "step", GUESS, **options)
        assert late.result == getattr(dlx.RESULTS, result)
    with pytest.raises(ValueError, match="event must be"):
        dlx.analysis.poincare_map(wheel(), "bounce", GUESS)


def test_dynamics_that_have_no_orbit():
    pendulum = dlx.Discretized(dlx.systems.Pendulum(), dt=0.1)
    with pytest.raises(ValueError, match="must be an AbstractHybridSystem"):
        dlx.analysis.poincare_map(pendulum, "step", [0.0, 0.0])
    steps = diffrax.PIDController(rtol=1e-5, atol=1e-5)
    wheel = dlx.systems.RimlessWheel()
    adaptive = dlx.Discretized(wheel, 0.1, diffrax.Tsit5(), stepsize_controller=steps)
    with pytest.raises(ValueError, match="adjoint with a forward mode"):
        dlx.analysis.periodic_orbit(adaptive, "step", [-0.29, 1.2])
