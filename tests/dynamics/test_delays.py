"""Delays of controls, sensors and states that need not be whole steps."""

from math import factorial

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import (
    assert_close,
    assert_gradient,
    dtype,
    needs_x64,
    once,
    tolerance,
    user_error,
)
from jaxtyping import Array
from scipy.linalg import expm
from scipy.optimize import brentq

import delucax as dlx


A, B = np.array([[0.0, 1.0], [-2.0, -0.3]]), np.array([[0.0], [1.0]])
H = 0.1
START = np.array([1.0, 0.5])
CONTROLS = np.random.default_rng(0).standard_normal((12, 1))


class Spring(dlx.AbstractSystem):
    state_names, control_names = ("p", "v"), ("u",)

    def vector_field(self, t, x, u, w):
        return jnp.asarray(A, x.dtype) @ x + jnp.asarray(B, x.dtype) @ u

    def equilibrium(self):
        return jnp.zeros(2), jnp.zeros(1)


def late(delays=None, *, substeps=4, **options):
    plant = dlx.Discretized(Spring(), dt=H, substeps=substeps)
    return dlx.dynamics.TransportDelay(plant, **(delays or {}), **options)


def sampled(tau):
    """Phi, and the effects of the older and of the newer control of an interval.

    Åström and Wittenmark, 1997, equations 2.12 and 2.13.
    """
    held = np.block([[A, B], [np.zeros((1, 3))]])
    whole = int(np.floor(tau / H + 1e-9))
    rest = tau - whole * H
    newer = expm(held * (H - rest))[:2, 2:]
    older = expm(A * (H - rest)) @ expm(held * rest)[:2, 2:]
    return whole, expm(A * H), older, newer


def exactly(tau):
    """The states under `CONTROLS` that act `tau` late."""
    whole, phi, older, newer = sampled(tau)
    past = lambda k: CONTROLS[k] if k >= 0 else np.zeros(1)
    states = [START]
    for k in range(len(CONTROLS)):
        forced = older @ past(k - whole - 1) + newer @ past(k - whole)
        states.append(phi @ states[-1] + forced)
    return np.stack(states)


@pytest.mark.parametrize("tau", [0.0, 0.03, 0.1, 0.13, 0.37])
@needs_x64
def test_a_late_control_is_the_exact_sampled_system(tau):
    plant = dlx.Discretized(
        Spring(),
        dt=H,
        solver=diffrax.Dopri8(),
        stepsize_controller=diffrax.PIDController(rtol=1e-12, atol=1e-12),
    )
    delayed = dlx.dynamics.TransportDelay(plant, controls=tau)
    states = dlx.open_loop(delayed, delayed.filled(START), CONTROLS)
    assert_close(states[:, :2], exactly(tau), atol=1e-10)


@needs_x64
def test_the_characteristic_polynomial_of_a_sampled_loop():
    """`det(z^3 I - ...)` of a feedback `u = -K x` that acts 1.3 steps late."""
    K, tau = np.array([[1.5, 0.4]]), 1.3 * H
    delayed = late({"controls": tau}, substeps=200)
    model = dlx.linearize(delayed)
    closed = np.asarray(model.A) - np.asarray(model.B) @ np.pad(K, ((0, 0), (0, 2)))
    _, phi, older, newer = sampled(tau)

    def characteristic(z):
        # z x = phi x - older K x / z^2 - newer K x / z, times z^2
        matrix = z * np.eye(2) - phi + older @ K / z**2 + newer @ K / z
        return z**2 * np.linalg.det(matrix)

    polynomial = np.poly(np.linalg.eigvals(closed))
    for z in (0.7, -1.1, 0.4 + 0.9j):
        assert abs(np.polyval(polynomial, z) - characteristic(z)) < 1e-8


@pytest.mark.parametrize("tau", [0.0, 0.03, 0.1, 0.25])
def test_a_late_sensor_reads_the_state_of_then(tau):
    delayed = late({"sensor": tau, "controls": 0.06}, sensor_memory=3)
    states = dlx.open_loop(delayed, delayed.filled(START), CONTROLS)
    read = jax.vmap(lambda x: delayed.observe(0.0, x))(states)
    # The same plant on a grid of 0.01, on which its control acts 6 steps late.
    fine = dlx.dynamics.Delayed(dlx.Discretized(Spring(), dt=0.01), controls=6)
    exact = dlx.open_loop(fine, fine.filled(START), np.repeat(CONTROLS, 10, axis=0))
    back = 10 * np.arange(len(states)) - round(tau / 0.01)
    expected = np.where(back[:, None] < 0, START, exact[np.maximum(back, 0), :2])
    assert_close(read, expected, atol=tolerance(1e-5, 1e-7))


def test_whole_steps_are_those_of_delayed():
    plant = dlx.Discretized(Spring(), dt=H)
    whole = dlx.dynamics.Delayed(plant, controls=2)
    some = dlx.dynamics.TransportDelay(plant, controls=0.2)
    run = lambda d: dlx.open_loop(d, d.filled(START), CONTROLS)
    assert_close(run(some), run(whole), atol=tolerance(1e-6, 1e-14))
    assert some.state_names == whole.state_names


@pytest.mark.parametrize("kind", ["controls", "sensor"])
@needs_x64
def test_derivatives_with_respect_to_a_delay(kind):
    def cost(tau):
        delayed = late({kind: tau}, control_memory=4, sensor_memory=4)
        states = dlx.open_loop(delayed, delayed.filled(START), CONTROLS)
        read = jax.vmap(lambda x: delayed.observe(0.0, x))(states)
        return jnp.sum(read[6:] ** 2)

    for tau in (0.137, 0.02):
        gradient = assert_gradient(cost, np.array(tau), rtol=1e-6)
        assert_close(jax.jvp(cost, (tau,), (1.0,))[1], gradient, rtol=1e-10)
    # To the right where the delay is whole.
    for tau in (0.0, 0.2):
        right = (cost(tau + 1e-6) - cost(tau)) / 1e-6
        assert_close(jax.grad(cost)(tau), right, rtol=1e-5)


@pytest.mark.parametrize("tau", [0.0, H])
@needs_x64
def test_derivatives_with_respect_to_a_whole_delay_with_adaptive_steps(tau):
    """Diffrax takes no step in a part without length."""
    steps = diffrax.PIDController(rtol=1e-10, atol=1e-10)
    options = dict(solver=diffrax.Tsit5(), stepsize_controller=steps)
    plant = dlx.Discretized(Spring(), dt=H, **options)

    def end(tau):
        delayed = dlx.dynamics.TransportDelay(plant, controls=tau, control_memory=2)
        x = delayed.filled(START, np.ones(1))
        return dlx.open_loop(delayed, x, CONTROLS[:4])[-1, 0]

    right = (end(tau + 1e-5) - end(tau)) / 1e-5
    assert_close(jax.grad(end)(tau), right, rtol=1e-4)


def test_a_delay_beyond_the_memory_has_a_status():
    delayed = late({"controls": 0.05}, control_memory=2)
    x = delayed.filled(START)
    for tau in (0.15, 0.2, 0.201, -0.01):
        changed = eqx.tree_at(lambda d: d.controls, delayed, jnp.asarray(tau))
        _, result = changed.advance(0.0, x, jnp.ones(1), None)
        beyond = result == dlx.RESULTS.delay_beyond_memory
        assert bool(beyond) == (tau > 0.2 or tau < 0)


class Additive(dlx.AbstractSystem):
    """With a disturbance that is added to the next state."""

    state_names, control_names = ("x",), ("u",)

    def vector_field(self, t, x, u, w):
        return u


def test_an_added_disturbance_enters_once_and_is_read_at_the_end():
    plant = dlx.Discretized(Additive(), dt=H)
    delayed = dlx.dynamics.TransportDelay(plant, 0.04, 0.1, sensor_memory=2)
    x = delayed.filled([1.0])
    x, _ = delayed.advance(0.0, x, jnp.ones(1), jnp.array([5.0]))
    assert_close(x[0], 6.06, atol=1e-5)
    assert_close(delayed.observe(0.1, x), [1.0], atol=1e-6)
    x, _ = delayed.advance(0.1, x, jnp.ones(1), jnp.zeros(1))
    assert_close(delayed.observe(0.2, x), [6.06], atol=1e-5)


class Lag(dlx.systems.AbstractDelaySystem):
    state_names, control_names = ("x",), ("u",)
    delays: Array = dlx.parameter([1.0])
    rate: Array = dlx.parameter(1.0)

    def vector_field(self, t, x, u, w, late):
        return -self.rate * late[0] + u

    def equilibrium(self):
        return jnp.zeros(1), jnp.zeros(1)


def solution(t):
    """Of `x' = -x(t - 1)` with `x = 1` until 0: a polynomial in each unit of time."""
    terms = range(int(np.floor(t)) + 2)
    return sum((-1) ** k * (t - k + 1) ** k / factorial(k) for k in terms)


def test_a_delayed_state_is_integrated_to_order_four():
    errors = []
    for n in (4, 8, 16):
        steps = dlx.dynamics.MethodOfSteps(Lag(), dt=1 / n)
        assert steps.memory == n
        states = dlx.open_loop(steps, steps.filled([1.0]), jnp.zeros((6 * n, 1)))
        errors.append(abs(float(states[-1, 0]) - solution(6.0)))
    assert errors[-1] < tolerance(1e-6, 1e-7)
    if dtype() == jnp.float64:
        assert np.all(np.log2(np.array(errors[:-1]) / errors[1:]) > 3.8)


@needs_x64
def test_the_limit_of_stability_of_a_delayed_state():
    """`x' = -a x(t - tau)` is stable until `a tau` is pi / 2."""

    def growth(rate):
        steps = dlx.dynamics.MethodOfSteps(Lag(rate=rate), dt=0.1)
        values = np.linalg.eigvals(np.asarray(dlx.linearize(steps).A))
        return np.abs(values).max() - 1

    assert abs(brentq(growth, 1.4, 1.7) - np.pi / 2) < 1e-3


def test_intervals_of_several_substeps_and_two_delays():
    class Two(Lag):
        delays: Array = dlx.parameter([0.3, 0.05])

        def vector_field(self, t, x, u, w, late):
            return -late[0] * late[1] + u

    run = lambda d, n: dlx.open_loop(d, d.filled([1.0]), jnp.ones((n, 1)))[-1, 0]
    coarse = dlx.dynamics.MethodOfSteps(Two(), dt=0.1)
    assert (coarse.substeps, coarse.memory) == (2, 6)
    fine = dlx.dynamics.MethodOfSteps(Two(), dt=0.05)
    assert_close(run(coarse, 10), run(fine, 20), atol=tolerance(1e-6, 1e-12))


@needs_x64
def test_derivatives_with_respect_to_a_delay_of_the_state():
    def cost(tau):
        system = Lag(delays=jnp.reshape(tau, 1))
        steps = dlx.dynamics.MethodOfSteps(system, 0.1, substeps=1, memory=15)
        states = dlx.open_loop(steps, steps.filled([1.0]), 0.3 * jnp.ones((40, 1)))
        return jnp.sum(states[:, 0] ** 2)

    assert_gradient(cost, np.array(0.73), rtol=1e-7)


def test_a_delay_of_many_steps():
    """The rounding of single precision grows with their number."""
    for tau in (0.6, 1.1, 1.2):
        steps = dlx.dynamics.MethodOfSteps(Lag(delays=[tau]), dt=0.01)
        assert steps.memory == round(100 * tau)
        _, result = steps.advance(0.0, steps.filled([1.0]), jnp.zeros(1), None)
        assert bool(result == dlx.RESULTS.successful)


def test_room_for_longer_delays_changes_nothing():
    """The state jumps where a disturbance is added, at the ends of old steps."""
    w = jnp.array([[1.0], [0.0], [0.0], [-2.0], [0.0], [0.0]])

    def run(memory):
        steps = dlx.dynamics.MethodOfSteps(Lag(delays=[0.2]), dt=H, memory=memory)
        x = steps.filled([1.0])
        return dlx.open_loop(steps, x, jnp.zeros((6, 1)), w)[:, 0]

    assert_close(run(4), run(2), atol=tolerance(1e-6, 1e-14))


def test_a_given_past():
    steps = dlx.dynamics.MethodOfSteps(Lag(delays=[np.pi / 2]), dt=np.pi / 40)
    # `x' = -x(t - pi / 2)` has the solution `sin(t)`.
    x0 = steps.started(lambda t: jnp.sin(t)[None])
    states = dlx.open_loop(steps, x0, jnp.zeros((40, 1)))
    assert_close(states[20, 0], 1.0, atol=tolerance(1e-5, 1e-6))
    assert_close(states[40, 0], 0.0, atol=tolerance(1e-5, 2e-6))


@once
def test_what_does_not_fit_is_named():
    plant, delay = dlx.Discretized(Spring(), dt=H), dlx.dynamics.TransportDelay
    steps = dlx.dynamics.MethodOfSteps
    for make, words in (
        (lambda: delay(plant, -0.1), "controls must be at least 0, got -0.1"),
        (lambda: delay(plant, sensor=np.nan), "sensor must be finite"),
        (lambda: delay(plant, 0.3, control_memory=2), "must be at most 2 steps of"),
        (lambda: delay(dlx.LinearDynamics(A, B)), "dynamics must be an Abstr"),
        (lambda: steps(Lag(), dt=0.0), "dt must be positive"),
        (lambda: steps(Lag(delays=[0.0]), H), "delays must be positive"),
        (lambda: steps(Lag(delays=[]), H), "delays must be positive"),
        (lambda: steps(Lag(), H, memory=3), "at most memory = 3 substeps"),
        (lambda: steps(Lag(delays=[0.05]), H, substeps=1), "at least one substep"),
        (lambda: steps(Spring(), H), "system must be an AbstractDelaySystem"),
        (lambda: steps(Lag(), H, solver=diffrax.Kvaerno3()), "explicit Runge-Kutta"),
    ):
        with user_error(match=words):
            make()


@once
def test_a_delay_of_whole_steps_needs_no_more_memory():
    """In single precision a tenth is more than five times a fiftieth."""
    plant = dlx.Discretized(dlx.systems.Pendulum(), dt=0.02)
    assert dlx.dynamics.TransportDelay(plant, controls=0.1).control_memory == 5
    dlx.dynamics.TransportDelay(plant, controls=0.1, control_memory=5)
    late = dlx.dynamics.TransportDelay(plant, controls=0.28, control_memory=15)
    late = eqx.tree_at(lambda d: d.controls, late, jnp.asarray(0.3))
    _, result = late.advance(
        0.0, late.filled(jnp.array([0.1, 0.0])), jnp.zeros(1), None
    )
    assert result == dlx.RESULTS.successful
