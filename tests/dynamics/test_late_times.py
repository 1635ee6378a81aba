"""A step is the same at any time, however large the time is."""

import functools

import diffrax
import equinox as eqx
import jax
import jax.lax as lax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import assert_close, assert_gradient, needs_x32, needs_x64
from jaxtyping import Array

import delucax as dlx


PID = diffrax.PIDController(rtol=1e-6, atol=1e-8)
KINDS = {
    "explicit substeps": dict(solver=dlx.dynamics.RK4(), substeps=3),
    "implicit substeps": dict(solver=diffrax.ImplicitEuler(), substeps=3),
    "adaptive": dict(solver=diffrax.Tsit5(), stepsize_controller=PID),
    "adaptive implicit": dict(solver=diffrax.Kvaerno3(), stepsize_controller=PID),
    "Milstein": dict(solver=diffrax.ItoMilstein(), substeps=2),
}
NOISY = ("Milstein",)
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


class Fast(dlx.AbstractSystem):
    """Slopes of up to 4 with respect to the time, which the field does not round."""

    state_names = ("x", "y")
    control_names = ("u",)
    noisy: bool = eqx.field(static=True)

    def vector_field(self, t, x, u, w):
        return jnp.stack(
            [jnp.sin(t) - x[0], jnp.sin(2 * t) + jnp.cos(4 * t) * u[0] - 0.1 * x[1]]
        )

    def diffusion(self, t, x, u):
        return jnp.stack([jnp.cos(t), jnp.sin(2 * t)]) if self.noisy else None


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


@needs_x32
@pytest.mark.parametrize("kind", KINDS)
def test_an_autonomous_step_does_not_depend_on_the_time(kind):
    given_inputs = inputs(kind, jnp.float32)
    for dt in (1e-3, 1e-4):
        step = step_of(Decay, kind, dt)
        first = np.asarray(step(jnp.float32(0), *given_inputs))
        for t in (1.0, 99.99, 1000.0, 3000.1, 1e5):
            later = np.asarray(step(jnp.float32(t), *given_inputs))
            np.testing.assert_array_equal(later, first)


class FastMap(dlx.AbstractDynamics):
    """A map is given the time itself, of which nothing is rounded."""

    state_names = ("x", "y")
    control_names = ("u",)
    dt: Array = dlx.parameter()

    def advance(self, t, x, u, w):
        dx = Fast(False).vector_field(t, x, u, w)
        return x + self.dt * dx, dlx.RESULTS.successful


def of_precision(tree, dtype):
    """All numbers of a tree in one precision; what they are is that of float32."""
    single = lambda a: a.astype(jnp.float32).astype(dtype)  # noqa: E731
    return jax.tree.map(lambda a: single(a) if eqx.is_inexact_array(a) else a, tree)


def ulps(single, double):
    single = np.asarray(single)
    assert single.dtype == np.float32
    return np.max(np.abs(single - np.asarray(double)) / np.spacing(np.abs(single)))


LATE = [*(kind for kind in KINDS if kind != "adaptive implicit"), "map"]


@needs_x64
@pytest.mark.parametrize("kind", LATE)
def test_a_late_step_of_a_fast_field_is_that_of_double_precision(kind):
    if kind == "map":
        dynamics = FastMap(jnp.asarray(0.05))
    else:
        dynamics = dlx.Discretized(Fast(kind in NOISY), 0.05, **KINDS[kind])

    @eqx.filter_jit
    def after(late, dtype):
        at = lambda t: of_precision(dynamics, dtype).advance(t, *inputs(kind, dtype))[0]
        return jax.vmap(at)(of_precision(late + jnp.linspace(0, 10, 100), dtype))

    for late in (1e3, 1e4, 1e5):
        late = jnp.asarray(late)
        assert ulps(after(late, jnp.float32), after(late, jnp.float64)) <= 4


@needs_x64
def test_late_gradients_are_those_of_double_precision():
    field = lambda t, x, u, w: jnp.sin(2 * t) * x[::-1] + jnp.cos(4 * t) * u
    dynamics = dlx.Discretized(dlx.system(field, states=2, controls=1), 0.05)

    @eqx.filter_jit
    def slopes(dtype):
        held = of_precision(dynamics, dtype)
        z = of_precision((jnp.asarray(1e5 + 0.7), jnp.array(X), jnp.array(U)), dtype)
        f = lambda t, x, u: jnp.sum(held.advance(t, x, u, None)[0])
        return jax.grad(f, argnums=(0, 1, 2))(*z), jax.jvp(f, z, z)[1]

    for single, double in zip(
        jax.tree.leaves(slopes(jnp.float32)),
        jax.tree.leaves(slopes(jnp.float64)),
        strict=True,
    ):
        assert_close(single, double, rtol=1e-5, atol=1e-6)


@jax.custom_vjp
def backwards_alone(t):
    return jnp.sin(t)


backwards_alone.defvjp(
    lambda t: (jnp.sin(t), t), lambda t, cotangent: (cotangent * jnp.cos(t),)
)


@needs_x32
@pytest.mark.parametrize(
    "signal",
    [
        backwards_alone,
        jax.jit(backwards_alone),
        lambda t: lax.scan(lambda c, _: (backwards_alone(c), None), t, length=2)[0],
        lambda t: jnp.sqrt(jnp.abs(t - 1e4)),
        lambda t: jax.pure_callback(np.sin, t, t, vmap_method="sequential"),
        jnp.floor,
    ],
    ids=["custom_vjp", "in jit", "in scan", "kink", "callback", "floor"],
)
def test_a_field_without_derivatives_is_evaluated_as_it_is(signal):
    field = lambda t, x, u, w: signal(t) + u - x
    system, h = dlx.system(field, states=1, controls=1), 2.0**-7
    dynamics = dlx.Discretized(system, 2 * h, diffrax.Euler(), substeps=2)
    x, u = jnp.ones(1), jnp.array([0.3])
    step = jax.jit(lambda t: dynamics.advance(t, x, u, None)[0])
    batch = jax.jit(jax.vmap(step))

    @jax.jit
    def by_hand(t):
        half = x + h * field(t, x, u, None)
        return half + h * field(t + h, half, u, None)

    times = np.array([0.0, 1e4], np.float32)
    expected = [by_hand(t) for t in times]
    assert_close([step(t) for t in times], expected, rtol=1e-6)
    assert_close(batch(times), expected, rtol=1e-6)


@needs_x32
def test_what_does_not_vary_with_time_costs_nothing():
    def equations(system):
        dynamics = dlx.Discretized(system, 0.05)
        x = jnp.ones(system.state_size)
        step = lambda t: dynamics.advance(t, x, jnp.ones(1), None)[0]
        return len(jax.make_jaxpr(step)(0.0).eqns)

    def rows(t, x, u, w):
        return dlx.references.Sequence(jnp.ones((3, 1)), jnp.asarray(0.1))(t) + u - x

    def ignored(t, x, u, w):
        return (
            dlx.references.Sequence(jnp.ones((3, 1)), jnp.asarray(0.1))(0.0 * x[0])
            + u
            - x
        )

    make = functools.partial(dlx.system, states=1, controls=1)
    # Nothing but the product of the time with 0.
    assert equations(make(rows)) <= equations(make(ignored))


def adaptive(system, adjoint):
    return dlx.Discretized(
        system,
        0.1,
        diffrax.Bosh3(),
        stepsize_controller=diffrax.PIDController(rtol=1e-8, atol=1e-8),
        adjoint=adjoint,
    )


@needs_x64
@pytest.mark.parametrize("name", ["stored", "backsolve", "fixed"])
def test_gradients_of_a_step(name):
    adjoints = {
        "stored": diffrax.RecursiveCheckpointAdjoint(),
        "backsolve": diffrax.BacksolveAdjoint(),
    }
    system = dlx.system(lambda t, x, u, w: jnp.sin(3 * t) * x + u, states=1, controls=1)
    if name == "fixed":
        dynamics = dlx.Discretized(system, 0.1, diffrax.Heun(), substeps=2)
    else:
        dynamics = adaptive(system, adjoints[name])
    x, u = jnp.ones(1), jnp.array([0.3])

    def after(z):
        if name == "backsolve":
            return dynamics.advance(z[0], x, u, None)[0][0]
        moved = dlx.replace(dynamics, {"dt": z[1]})
        return moved.advance(z[0], x, u, None)[0][0]

    assert_gradient(after, jnp.array([1.3, 0.1]), step=1e-4, rtol=1e-5)
