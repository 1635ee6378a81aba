"""A step is the same at any time, however large the time is."""

import functools

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import assert_close, central_difference, needs_x32, needs_x64, thorough
from hypothesis import given, settings, strategies as st
from jaxtyping import Array

import delucax as dlx


PID = diffrax.PIDController(rtol=1e-6, atol=1e-8)
KINDS = {
    "explicit": dict(solver=diffrax.Tsit5()),
    "explicit substeps": dict(solver=dlx.dynamics.RK4(), substeps=3),
    "implicit": dict(solver=diffrax.Kvaerno3()),
    "implicit substeps": dict(solver=diffrax.ImplicitEuler(), substeps=3),
    "adaptive": dict(solver=diffrax.Tsit5(), stepsize_controller=PID),
    "adaptive implicit": dict(solver=diffrax.Kvaerno3(), stepsize_controller=PID),
    "Euler-Maruyama": dict(solver=diffrax.Euler(), substeps=2),
    "Milstein": dict(solver=diffrax.ItoMilstein(), substeps=2),
}
NOISY = ("Euler-Maruyama", "Milstein")
X, U = np.array([0.7, -1.3]), np.array([0.4])
DISTURBANCE = {True: np.array([0.1, -0.2, 0.3, 0.05]), False: np.array([0.1, -0.2])}


class Decay(dlx.AbstractSystem):
    state_names = ("x", "y")
    control_names = ("u",)
    noisy: bool = eqx.field(static=True)

    def vector_field(self, t, x, u, w):
        return jnp.stack([-x[0] + x[1] * u[0], -2 * x[1]])

    def diffusion(self, t, x, u):
        return jnp.stack([0.1 * x[0], 0.2 * x[1]]) if self.noisy else None


class Ageing(dlx.AbstractSystem):
    """Slow enough that the rounding of a late time is less than that of the state."""

    state_names = ("x", "y")
    control_names = ("u",)
    noisy: bool = eqx.field(static=True)

    def vector_field(self, t, x, u, w):
        return jnp.stack([-x[0] + 1e-5 * t * x[1], -2e-5 * t * x[1] + u[0]])

    def diffusion(self, t, x, u):
        return jnp.stack([1e-6 * t, 0.2 * x[1]]) if self.noisy else None


@eqx.filter_jit
def advance(dynamics, t, x, u, w):
    return dynamics.advance(t, x, u, w)[0]


def step_of(system, kind, dt):
    """One step, `(t, x, u, w) -> x_next`; the interval is no part of the program."""
    dynamics = dlx.Discretized(system(kind in NOISY), dt, **KINDS[kind])
    return jitted(dynamics)


def jitted(dynamics):
    return functools.partial(advance, dynamics)


def inputs(kind, dtype):
    return [jnp.asarray(a, dtype) for a in (X, U, DISTURBANCE[kind in NOISY])]


every = pytest.mark.parametrize(
    "kind",
    [
        pytest.param(kind, marks=thorough if kind == "adaptive implicit" else ())
        for kind in KINDS
    ],
)


@needs_x32
@every
def test_an_autonomous_step_does_not_depend_on_the_time(kind):
    given_inputs = inputs(kind, jnp.float32)
    for dt in (1e-3, 1e-4):
        step = step_of(Decay, kind, dt)
        first = np.asarray(step(jnp.float32(0), *given_inputs))
        for t in (1.0, 99.99, 1000.0, 3000.1, 1e5):
            later = np.asarray(step(jnp.float32(t), *given_inputs))
            np.testing.assert_array_equal(later, first)


@needs_x64
@every
@settings(max_examples=20, deadline=None)
@given(t=st.floats(0, 1e5, width=32))
def test_a_late_step_is_that_of_double_precision(kind, t):
    step = step_of(Ageing, kind, 1e-2)
    single = step(jnp.float32(t), *inputs(kind, jnp.float32))
    double = step(jnp.float64(t), *inputs(kind, jnp.float64))
    ulp = np.spacing(np.abs(np.asarray(single)))
    assert single.dtype == jnp.float32
    assert np.all(np.abs(np.asarray(single, np.float64) - double) <= 4 * ulp)


class Fast(dlx.AbstractSystem):
    """Slopes of up to 2 with respect to the time."""

    state_names = ("x", "y")
    control_names = ("u",)
    noisy: bool = eqx.field(static=True)

    def vector_field(self, t, x, u, w):
        return jnp.stack([jnp.sin(2 * t) - 0.1 * x[0], jnp.cos(2 * t) + u[0]])


class FastMap(dlx.AbstractDynamics):
    """A map is given the time itself, of which nothing is rounded."""

    state_names = ("x", "y")
    control_names = ("u",)
    dt: Array = dlx.parameter(1e-2)

    def advance(self, t, x, u, w):
        return x + self.dt * Fast(False).vector_field(
            t, x, u, w
        ), dlx.RESULTS.successful


WEIGHTS = {"explicit": 7.6, "explicit substeps": 1.0, "adaptive": 7.6, "implicit": 3.0}
"""At least the sum of the absolute weights of the stages."""


@needs_x64
@pytest.mark.parametrize("kind", [*WEIGHTS, "map"])
@settings(max_examples=20, deadline=None)
@given(t=st.floats(1, 1e5, width=32))
def test_a_late_step_of_a_fast_field_is_off_by_the_rounding_of_time(kind, t):
    step = step_of(Fast, kind, 1e-2) if kind in KINDS else jitted(FastMap())
    plain = [jnp.asarray(a, jnp.float32) for a in (X, U, DISTURBANCE[False])]
    single = np.asarray(step(jnp.float32(t), *plain), np.float64)
    double = step(jnp.float64(t), *(a.astype(jnp.float64) for a in plain))
    late = 0.0 if kind == "map" else np.spacing(np.float32(t + 1e-2)) / 2
    rounding = WEIGHTS.get(kind, 1.0) * 2 * late * 1e-2
    ulp = np.spacing(np.abs(single).astype(np.float32)).astype(np.float64)
    assert np.all(np.abs(single - double) <= 4 * ulp + rounding)


def adaptive(system, adjoint):
    return dlx.Discretized(
        system,
        0.1,
        diffrax.Tsit5(),
        stepsize_controller=diffrax.PIDController(rtol=1e-9, atol=1e-9),
        adjoint=adjoint,
    )


@needs_x64
@thorough
@pytest.mark.parametrize("name", ["stored", "direct", "backsolve", "fixed"])
def test_gradients_of_a_step(name):
    adjoints = {
        "stored": diffrax.RecursiveCheckpointAdjoint(),
        "direct": diffrax.DirectAdjoint(),
        "backsolve": diffrax.BacksolveAdjoint(),
    }
    system = dlx.system(lambda t, x, u, w: jnp.sin(3 * t) * x + u, states=1, controls=1)
    if name == "fixed":
        dynamics = dlx.Discretized(system, 0.1, substeps=2)
    else:
        dynamics = adaptive(system, adjoints[name])
    x, u = jnp.ones(1), jnp.array([0.3])

    @jax.jit
    def after(z):
        if name == "backsolve":
            return dynamics.advance(z[0], x, u, None)[0][0]
        moved = dlx.replace(dynamics, {"dt": z[1]})
        return moved.advance(z[0], x, u, None)[0][0]

    at = jnp.array([1.3, 0.1])
    expected = central_difference(after, at, step=1e-4)
    assert_close(jax.grad(after)(at), expected, rtol=1e-5)
