import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import assert_close, needs_x64, user_error
from jaxtyping import Array

import delucax as dlx


pytestmark = needs_x64


PENDULUM = dlx.systems.Pendulum(damping=0.1)
FEEDBACK = dlx.controllers.Linear(jnp.array([[20.0, 5.0]]))
INTEGRATOR = dlx.system(lambda t, x, u, w: u, states=1, controls=1)
SWITCHED = dlx.system(lambda t, x, u, w: u - x, states=1, controls=1)
DRIVEN = dlx.system(lambda t, x, u, w: t + u - x, states=1, controls=1)
CONTROLS = jnp.asarray(np.random.default_rng(0).uniform(-2, 2, (4, 1)))
HANGING = jnp.array([3.0, 0.5])
UPRIGHT = jnp.array([0.1, 0.0])
LOOSE = diffrax.PIDController(rtol=1e-4, atol=1e-6)
FINE = diffrax.PIDController(rtol=1e-8, atol=1e-8)


class Told(dlx.AbstractController):
    """Acts with the sum of what it was told that it applied, and one more."""

    rate: Array = dlx.weight(0.5)

    def init(self, *, key=None):
        return jnp.asarray(0.0), jnp.asarray(0), "not an array"

    def __call__(self, t, y, state):
        total, count, note = state
        return self.rate * (1 - total - y[:1]), (total, count + 1, note)

    def applied(self, u, cost, state):
        total, count, note = state
        return total + 0.1 * u[0] + cost, count, note


def loss(arguments, weights, **how):
    system, source, x0 = arguments
    run = dlx.simulate(system, source, 0.0, 0.2, x0, **how)
    return jnp.sum(weights * run.states) + jnp.sum(run.controls**3)


def assert_gradient(arguments, *, rtol=1e-6, forwards=False, **how):
    """The gradient in some directions is that of central differences."""
    params, static = eqx.partition(arguments, eqx.is_inexact_array)
    flat, unravel = jax.flatten_util.ravel_pytree(params)
    rng = np.random.default_rng(0)
    weights = jnp.asarray(rng.normal(size=(5, 2)))

    def f(flat):
        return loss(eqx.combine(unravel(flat), static), weights, **how)

    if forwards:
        value = jax.jit(f)
        gradient = jax.jit(jax.jacfwd(f))(flat)
    else:
        both = jax.jit(jax.value_and_grad(f))
        value = lambda flat: both(flat)[0]
        gradient = both(flat)[1]
    for _ in range(3):
        v = jnp.asarray(rng.normal(size=flat.shape))
        h = 1e-3
        near = value(flat + h * v) - value(flat - h * v)
        far = value(flat + 2 * h * v) - value(flat - 2 * h * v)
        expected = (8 * near - far) / (12 * h)
        scale = np.linalg.norm(gradient) * np.linalg.norm(v)
        assert abs(gradient @ v - expected) <= rtol * scale


@needs_x64
@pytest.mark.parametrize(
    "how",
    [
        {"solver": diffrax.Heun(), "substeps": 2},
        {"adjoint": diffrax.DirectAdjoint(), "solver": diffrax.Heun()},
        {
            "solver": diffrax.Bosh3(),
            "stepsize_controller": FINE,
            "adjoint": diffrax.BacksolveAdjoint(
                solver=diffrax.Heun(), stepsize_controller=FINE
            ),
            "ts": np.array([0.0, 0.03, 0.1, 0.16, 0.2]),
        },
    ],
    ids=["fixed", "direct", "backsolve"],
)
def test_gradient_of_open_loop(how):
    """`test_gradient_of_feedback` has adaptive steps."""
    assert_gradient((PENDULUM, CONTROLS, HANGING), **how)


@needs_x64
def test_forward_gradient():
    assert_gradient(
        (PENDULUM, CONTROLS, HANGING),
        forwards=True,
        adjoint=diffrax.ForwardMode(),
        solver=diffrax.Heun(),
    )


@needs_x64
@pytest.mark.parametrize(
    "controller, how",
    [
        (Told(), {"stepsize_controller": FINE, "solver": diffrax.Bosh3()}),
        # `test_gradient_of_open_loop` solves backwards in time.
        (FEEDBACK, {"hold": None, "solver": diffrax.Heun(), "substeps": 2}),
    ],
    ids=["sampled", "continuous"],
)
def test_gradient_of_feedback(controller, how):
    arguments = (PENDULUM, controller, UPRIGHT)
    assert_gradient(arguments, dt=0.05, **how)


@needs_x64
def test_gradient_with_respect_to_the_end():
    def f(t1):
        how = {"solver": diffrax.Euler()}
        run = dlx.simulate(INTEGRATOR, CONTROLS, 0.0, t1, jnp.zeros(1), **how)
        return run.final_state[0]

    assert_close(jax.jit(jax.grad(f))(0.3), jnp.mean(CONTROLS), rtol=1e-12)


@needs_x64
@pytest.mark.parametrize(
    "adjoint", [diffrax.RecursiveCheckpointAdjoint(), diffrax.BacksolveAdjoint()]
)
def test_gradient_with_respect_to_both_ends(adjoint):
    def f(t0, t1):
        fine = diffrax.PIDController(rtol=1e-10, atol=1e-10)
        how = dict(stepsize_controller=fine, adjoint=adjoint, solver=diffrax.Bosh3())
        run = dlx.simulate(DRIVEN, CONTROLS[:1], t0, t1, jnp.ones(1), **how)
        return run.final_state[0]

    # dx/dt = t - x + u: x = t - 1 + u + c exp(-t).
    def exact(t0, t1):
        u = CONTROLS[0, 0]
        return t1 - 1 + u + (2 - t0 - u) * jnp.exp(t0 - t1)

    ends = 0.3, 0.8
    got, expected = (jax.jit(jax.grad(g, argnums=(0, 1)))(*ends) for g in (f, exact))
    assert_close(jnp.stack(got), jnp.stack(expected), rtol=1e-7)


def test_a_gradient_that_fails_is_loud():
    how = dict(stepsize_controller=LOOSE, solver=diffrax.Bosh3())
    how["adjoint"] = diffrax.BacksolveAdjoint(max_steps=1)
    f = lambda x0: dlx.simulate(
        SWITCHED, CONTROLS[:1], 0.0, 20.0, x0, **how
    ).final_state.sum()
    with user_error(RuntimeError, match="maximum number of solver steps"):
        jax.block_until_ready(jax.jit(jax.grad(f))(jnp.ones(1)))
