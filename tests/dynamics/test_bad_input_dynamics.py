import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import pytest
from helpers import once, user_error

import delucax as dlx


pytestmark = once


PENDULUM = dlx.systems.Pendulum()
ADAPTIVE = dict(
    solver=diffrax.Tsit5(),
    stepsize_controller=diffrax.PIDController(rtol=1e-3, atol=1e-3),
)
LINEAR = dlx.linearize(PENDULUM)


@pytest.mark.parametrize(
    "make",
    [
        lambda dt: dlx.Discretized(PENDULUM, dt),
        lambda dt: dlx.LinearDynamics(jnp.eye(2), jnp.ones((2, 1)), dt=dt),
        lambda dt: dlx.c2d(LINEAR, dt),
        lambda dt: dlx.costs.Rate(dlx.costs.PendulumCost(), dt),
    ],
)
@pytest.mark.parametrize(
    "dt, match",
    [
        ("0.1", "positive and finite, got '0.1'"),
        (None, "positive and finite, got None"),
        (jnp.ones(2), r"a number, got shape \(2,\)"),
    ],
)
def test_a_step_that_is_no_number(make, dt, match):
    with user_error(match=f"dt must be {match}"):
        make(dt)


@pytest.mark.parametrize(
    "arguments, match",
    [
        ({"stepsize_controller": "x"}, "stepsize_controller must be adaptive.*'x'"),
        (
            {"stepsize_controller": diffrax.ConstantStepSize()},
            "stepsize_controller must be adaptive.*ConstantStepSize",
        ),
        ({"adjoint": "x"}, "adjoint must be a Diffrax adjoint.*got 'x'"),
    ],
)
def test_bad_input(arguments, match):
    with user_error(match=f"Discretized: {match}"):
        dlx.Discretized(PENDULUM, 0.1, **(ADAPTIVE | arguments))


@pytest.mark.parametrize(
    "returned, match",
    [
        (lambda x, u: [x[1], u[0]], "got a list.*jnp.stack"),
        (lambda x, u: None, "got a NoneType"),
    ],
)
def test_a_vector_field_that_returns_no_array(returned, match):
    system = dlx.system(lambda t, x, u, w: returned(x, u), states=2, controls=1)
    dynamics, x, u = dlx.Discretized(system, 0.1), jnp.zeros(2), jnp.zeros(1)
    match = rf"FunctionSystem: vector_field must return an array.*\(2,\).*{match}"
    with user_error(match=match):
        dynamics(0.0, x, u)
    with user_error(match=match):
        dlx.simulate(system, jnp.zeros((2, 1)), 0.0, 0.2, x)
    with user_error(match=match):
        dlx.linearize(system, 0.0, x, u)


@pytest.mark.parametrize(
    "mass", [None, "heavy", ["heavy"], object(), [[1.0], [1.0, 2.0]]]
)
def test_parameters_that_are_no_numbers(mass):
    with user_error(match="Pendulum: mass must be a number or an array"):
        dlx.systems.Pendulum(mass=mass)


class Listed(dlx.AbstractSystem):
    """Its methods return lists."""

    state_names = ("x",)
    control_names = ("u",)
    kind: str = eqx.field(static=True)

    def vector_field(self, t, x, u, w):
        return -x

    def project(self, x):
        return [x[0]] if self.kind == "project" else x

    def diffusion(self, t, x, u):
        return [[1.0]] if self.kind == "diffusion" else None


@pytest.mark.parametrize("kind", ["project", "diffusion"])
def test_a_method_that_returns_no_array(kind):
    with user_error(match=f"Listed: {kind} must return an array.*got a list"):
        dlx.Discretized(Listed(kind), 0.1)(0.0, jnp.ones(1), jnp.zeros(1))


def test_complex_controls():
    dynamics = dlx.Discretized(PENDULUM, 0.1)
    with user_error(match="controls must be real, got dtype complex"):
        dlx.open_loop(dynamics, jnp.zeros(2), 1j * jnp.ones((3, 1)))
    with user_error(match="must be real, got dtype complex"):
        dlx.open_loop(dynamics, 1j * jnp.ones(2), jnp.ones((3, 1)))


def test_an_open_loop_says_where_it_fails():
    grows = dlx.system(lambda t, x, u, w: x**3, states=1, controls=1)
    dynamics = dlx.Discretized(grows, 0.1)
    with user_error(match=r"open_loop: x0 must be finite, got \[nan\]"):
        dlx.open_loop(dynamics, [jnp.nan], jnp.zeros((9, 1)))
    first = r"^open_loop: The states .* The state 2 is the first that is not finite"
    with user_error(RuntimeError, match=first):
        dlx.open_loop(dynamics, [3.0], jnp.zeros((50, 1)))
    last = lambda x0: dlx.open_loop(dynamics, x0, jnp.zeros((50, 1)))[-1, 0]
    with user_error(RuntimeError, match=first):
        jax.grad(last)(jnp.array([3.0]))
    ball = dlx.make("bouncing_ball").dynamics
    guard = r"^open_loop: A state is beyond .* It was the event bounce at t = 0\.$"
    with user_error(RuntimeError, match=guard):
        dlx.open_loop(ball, -jnp.ones(2), jnp.zeros((9, ball.control_size)))
    with user_error(RuntimeError, match="^Discretized: A state is beyond"):
        ball(0.0, -jnp.ones(2), jnp.zeros(ball.control_size))
