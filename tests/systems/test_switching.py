"""Plants that switch, against what is known of them in closed form."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import (
    assert_close,
    assert_gradient,
    needs_x64,
    once,
    tolerance,
    user_error,
)

import delucax as dlx


s = dlx.systems
Q = dlx.RESULTS


def events_of(system, x0, controls, dt):
    """The times and names of the events of a rollout, and its states."""
    n, m = system.state_size, system.control_size
    cost = dlx.costs.Quadratic(np.ones(n), np.ones(m))
    env = dlx.Environment(dlx.Discretized(system, dt), cost)
    held = dlx.controllers.OpenLoop(controls)
    steps, keep = len(controls), ("states", "events")
    key = jax.random.key(0)
    run = dlx.rollout(env, held, key=key, x0=x0, horizon=steps, keep=keep)
    times, names = zip(*run.event_list(), strict=True)
    return np.array(times), names, run.states


def test_a_thermostat_switches_at_the_times_of_its_exponentials():
    room = s.Thermostat(capacity=3.0, loss=0.25, power=5.0, outside=4.0)
    times, names, _ = events_of(room, [19.5, 1.0], np.zeros((160, 1)), 0.1)
    warm, lasts = 4.0 + 5.0 / 0.25, 3.0 / 0.25
    heats = lambda low: lasts * np.log((warm - low) / (warm - 21))
    cools = lasts * np.log((21 - 4) / (19 - 4))
    assert names[:3] == ("too warm", "too cold", "too warm")
    expected = np.cumsum([heats(19.5), cools, heats(19), cools])
    assert_close(times[:4], expected, **tolerance(dict(rtol=1e-5), dict(rtol=1e-9)))


@needs_x64
def test_a_mass_sticks_and_slips_with_the_period_of_the_closed_form():
    mass = s.StickSlip(mass=2.0, stiffness=15.0, belt=0.3, static=1.4, kinetic=0.9)
    frequency, apart = np.sqrt(15.0 / 2.0), (1.4 - 0.9) / 15.0
    sticks = 2 * apart / 0.3
    slips = 2 * (np.pi - np.arctan(frequency * apart / 0.3)) / frequency
    times, names, _ = events_of(mass, [0.0, 0.3, 0.0], np.zeros((500, 1)), 0.01)
    assert names[:4] == ("break behind", "meet behind") * 2
    expected = 1.4 / 15.0 / 0.3 + np.cumsum([0, slips, sticks, slips])
    assert_close(times[:4], expected, rtol=2e-8)


@eqx.filter_jit
def broken(z):
    """A mass after an interval and its events, with derivatives, from its state and the
    force."""
    dynamics = dlx.Discretized(s.StickSlip(), 0.1)

    def run(z):
        x, *others = dynamics.advance_with_events(0.0, z[:3], z[3:], None)
        return x, (x, *others)

    return jax.jacfwd(run, has_aux=True)(z)


@needs_x64
@pytest.mark.parametrize("force, mode", [(2.0, 2.0), (-2.0, 1.0)])
def test_a_force_breaks_a_mass_loose(force, mode):
    """At once where it is too large for the friction, in either direction; and the
    derivatives are those of a mass that slips."""
    J, (stuck, result, events) = broken(jnp.array([0.02, 0.2, 0.0, force]))
    slip, (slipping, *_) = broken(jnp.array([0.02, 0.2, mode, force]))
    assert result == Q.successful and events.times[0] == 0
    assert list(events.kinds[:2]) == [mode - 1, -1] and stuck[2] == mode
    assert_close(stuck, slipping)
    # The velocity of a mass that sticks is the belt's.
    assert_close(J[:, 1], 0)
    assert_close(J[:, [0, 3]], slip[:, [0, 3]], rtol=1e-12)


@needs_x64
def test_a_mass_that_cannot_stick_passes_the_belt():
    _, (x, result, events) = broken(jnp.array([0.0, 0.15, 1.0, 4.0]))
    assert result == Q.successful and events.kinds[0] == 2 and x[2] == 2
    _, (x, _, events) = broken(jnp.array([0.02, 0.2, 0.0, 1.0]))
    assert events.kinds[0] == -1
    assert_close(x, [0.04, 0.2, 0.0], rtol=1e-12)


@needs_x64
def test_a_valve_opens_bounces_rests_and_leaves():
    valve = s.ValveWithStops(damping=0.0)
    w, forces = np.sqrt(40.0), np.where(np.arange(240) < 200, 30.0, 0.0)[:, None]
    times, names, states = events_of(valve, [0.5, 0.0, 0.0], forces, 0.005)
    # From the middle about 1.25, and then from the stop about the same.
    first, hits = np.arccos(1 / 3) / w, 0.75 * w * np.sin(np.arccos(1 / 3))
    away = 2 * np.arctan(0.3 * hits / (0.25 * w)) / w
    assert_close(times[:2], [first, first + away], rtol=1e-7)
    # Undamped, the valve comes back as fast as it left, until 0.3 of that is slow.
    count = int(np.ceil(np.log(0.02 / hits) / np.log(0.3)))
    assert names == ("open",) * count + ("leave open",)
    assert_close(times[-1], 1.0, atol=1e-12)
    assert_close(states[200], [1, 0, 2])
    assert_close(states[240, 0], 0.5 + 0.5 * np.cos(0.2 * w), atol=1e-7)


@needs_x64
@pytest.mark.parametrize(
    "system, name, x, u",
    [
        (s.Thermostat(), "high", [19.5, 0.0], 0.1),
        (s.StickSlip(damping=0.1), "kinetic", [0.1, 0.2, 0.0], 0.1),
        (s.ValveWithStops(), "restitution", [0.1, -3.0, 0.0], -3.0),
    ],
)
def test_gradients_are_central_differences(system, name, x, u):
    """Through several events, with respect to the state, the control and a constant."""

    def total(z):
        changed = dlx.replace(system, {name: z[-1]})
        dynamics = dlx.Discretized(changed, dt=0.1)
        controls = jnp.full((35, 1), z[-2])
        states = dlx.open_loop(dynamics, jnp.append(z[:-2], x[-1]), controls)
        return jnp.sum(states**2)

    z = [*x[:-1], u, float(getattr(system, name))]
    assert np.all(assert_gradient(total, z, rtol=1e-6) != 0)


@once
def test_a_thermostat_that_is_off_in_a_cold_room_switches_on():
    dynamics = dlx.Discretized(s.Thermostat(), 0.1)
    step = eqx.filter_jit(dynamics.advance_with_events)
    x, result, events = step(0.0, jnp.array([15.0, 0.0]), jnp.zeros(1), None)
    assert result == Q.successful and x[1] == 1
    assert events.times[0] == 0 and list(events.kinds[:2]) == [0, -1]


@once
def test_bad_input():
    with user_error(match="Thermostat: low must be below high, got 21.0 and 21.0"):
        s.Thermostat(low=21.0)
    with user_error(match="StickSlip: kinetic must be below static"):
        s.StickSlip(kinetic=1.5)
    with user_error(match="ValveWithStops: adhesion must be positive"):
        s.ValveWithStops(adhesion=0.0)

    class Wrong(s.StickSlip):
        urgent_events = ("break",)

    with pytest.raises(ValueError, match="Wrong: urgent_events must be among the ev"):
        Wrong()
