"""Observed orders: deterministic under switching controls, and strong ones."""

import functools

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import assert_close, needs_x64
from scipy.integrate import solve_ivp

import delucax as dlx


pytestmark = needs_x64
PENDULUM = dlx.systems.Pendulum(damping=0.2)
CONTROLS = np.array([2.0, -2.0, 1.0, 0.0, -1.0, 2.0, 0.5, -2.0])
X0 = np.array([1.0, -0.5])


def _exact(dt):
    x = X0
    for u in CONTROLS:

        def field(t, x, u=u):
            return np.array([x[1], 15 * np.sin(x[0]) + 3 * u - 0.2 * x[1]])

        x = solve_ivp(field, (0, dt), x, "DOP853", rtol=1e-13, atol=1e-14).y[:, -1]
    return x


@eqx.filter_jit
def run(dynamics, starts, controls):
    return jax.vmap(lambda x0: dlx.open_loop(dynamics, x0, controls))(starts)


@functools.cache
def states(solver, substeps, most):
    """At the switches. As many steps for all, so that one program does: those after the
    end are idle."""
    starts = jax.random.uniform(jax.random.key(0), (32, 2), minval=-3.0, maxval=3.0)
    controls = np.zeros((8 * most, 1))
    controls[: 8 * substeps, 0] = np.repeat(CONTROLS, substeps)
    dynamics = dlx.Discretized(PENDULUM, 0.4 / substeps, solver)
    every = np.asarray(run(dynamics, starts, controls))
    return every[:, : 8 * substeps + 1 : substeps]


@pytest.mark.parametrize(
    "solver, order, substeps",
    [
        # `test_integration.py` has Euler's and Heun's steps by hand.
        (dlx.dynamics.RK4(), 4, (32, 64)),
        (diffrax.Tsit5(), 5, (16, 32)),
        (diffrax.Kvaerno3(), 3, (64, 128)),
    ],
    ids=lambda value: type(value).__name__ if not isinstance(value, int) else None,
)
def test_order_under_switching_controls(solver, order, substeps):
    exact = states(diffrax.Dopri8(), 64, 64)
    found = [states(solver, n, substeps[1]) for n in substeps]
    errors = [np.sqrt(np.mean((each - exact) ** 2)) for each in found]
    observed = np.log2(errors[0] / errors[1]) / np.log2(substeps[1] / substeps[0])
    assert abs(observed - order) <= 0.1, (observed, errors)


def test_a_fine_solution_is_that_of_scipy():
    dynamics = dlx.Discretized(PENDULUM, 0.4, diffrax.Dopri8(), substeps=64)
    states = dlx.open_loop(dynamics, X0, CONTROLS[:, None])
    assert_close(states[-1], _exact(0.4), atol=1e-10)


def test_adaptive_meets_its_tolerance_at_the_switches():
    controller = diffrax.PIDController(rtol=1e-10, atol=1e-12)
    dynamics = dlx.Discretized(
        PENDULUM, 0.2, diffrax.Dopri8(), stepsize_controller=controller
    )
    states = dlx.open_loop(dynamics, X0, CONTROLS[:, None])
    assert_close(states[-1], _exact(0.2), atol=1e-8)


class Geometric(dlx.AbstractSystem):
    """Geometric Brownian motion, dx = a x dt + b x dB (Itô)."""

    state_names = ("x",)
    control_names = ("u",)
    a: jax.Array = dlx.parameter(0.5)
    b: jax.Array = dlx.parameter(1.0)

    def vector_field(self, t, x, u, w):
        return self.a * x

    def diffusion(self, t, x, u):
        return self.b * x


@pytest.mark.parametrize(
    "solver, stratonovich, order",
    [
        (diffrax.Euler(), False, 0.5),
        (diffrax.ItoMilstein(), False, 1.0),
        (diffrax.StratonovichMilstein(), True, 1.0),
    ],
    ids=["Euler-Maruyama", "Itô-Milstein", "Stratonovich-Milstein"],
)
def test_strong_order(solver, stratonovich, order):
    paths, finest, b = 4000, 512, 0.6
    drift = 0.5 - b**2 / 2 if stratonovich else 0.5  # of the same process
    key = jax.random.key(0)
    fine = jax.random.normal(key, (paths, finest)) / np.sqrt(finest)
    exact = jnp.exp(0.5 - b**2 / 2 + b * fine.sum(axis=1))
    errors, sizes = [], (32, 64, 128, 256)
    zero = jnp.zeros((sizes[-1], 1))

    @eqx.filter_jit
    def run(dynamics, w):
        after = lambda w: dlx.open_loop(dynamics, jnp.ones(1), zero, w[:, None])
        return jax.vmap(after)(w)[:, :, 0]

    for n in sizes:
        # As many steps for all, so that one program does: those after the end are idle.
        w = np.zeros((paths, sizes[-1]))
        w[:, :n] = fine.reshape(paths, n, finest // n).sum(axis=2)
        end = run(dlx.Discretized(Geometric(drift, b), 1 / n, solver), w)[:, n]
        errors.append(jnp.sqrt(jnp.mean((end - exact) ** 2)))
    slope = -np.polyfit(np.log(sizes), np.log(np.array(errors)), 1)[0]
    assert abs(slope - order) <= 0.1, (slope, errors)


def test_substeps_take_the_increments_one_after_the_other():
    w = jax.random.normal(jax.random.key(1), (4,)) * 0.1
    whole = dlx.Discretized(Geometric(), 0.4, diffrax.Euler(), substeps=4)
    part = dlx.Discretized(Geometric(), 0.1, diffrax.Euler())
    assert whole.disturbance_size == 4
    x = jnp.ones(1)
    for k in range(4):
        x = part(0.0, x, jnp.zeros(1), w[k : k + 1])
    assert_close(whole(0.0, jnp.ones(1), jnp.zeros(1), w), x, rtol=1e-14)


def test_ornstein_uhlenbeck_variance():
    class OrnsteinUhlenbeck(dlx.AbstractSystem):
        state_names = ("x",)
        control_names = ("u",)

        def vector_field(self, t, x, u, w):
            return -x

        def diffusion(self, t, x, u):
            return jnp.full((1, 1), 0.5)

    dt, steps, paths = 0.02, 400, 4000
    dynamics = dlx.Discretized(OrnsteinUhlenbeck(), dt)
    env = dlx.Environment(
        dynamics, dlx.costs.Function(lambda t, x, u: 0.0 * x[0]), horizon=steps
    )
    zero = dlx.controllers.Zero(1)
    keys = jax.random.split(jax.random.key(2), paths)
    end = jax.vmap(
        lambda k: dlx.rollout(env, zero, key=k, keep=(), throw=False).final_state[0]
    )(keys)
    # Euler-Maruyama is the AR(1) process x+ = (1 - dt) x + 0.5 dB, whose stationary
    # variance is 0.125 / (1 - dt / 2); the sampling error is sqrt(2 / paths).
    expected = 0.125 / (1 - dt / 2)
    assert abs(jnp.var(end) / expected - 1) < 3 * np.sqrt(2 / paths)
    assert abs(jnp.mean(end)) < 4 * np.sqrt(expected / paths)
