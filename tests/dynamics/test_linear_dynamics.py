import diffrax
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
from scipy.signal import cont2discrete

import delucax as dlx


pytestmark = needs_x64


A = jnp.array([[1.0, 0.1], [-0.2, 0.9]])
B = jnp.array([[0.0], [0.1]])


def test_affine_map_and_sensor():
    E = jnp.array([[1.0], [0.5]])
    dynamics = dlx.LinearDynamics(
        A,
        B,
        C=jnp.array([[1.0, 0.0]]),
        E=E,
        dt=0.1,
        x_ref=jnp.ones(2),
        u_ref=jnp.ones(1),
        x_next=jnp.array([2.0, 3.0]),
    )
    x, u, w = jnp.array([2.0, 0.0]), jnp.array([3.0]), jnp.array([0.5])
    expected = jnp.array([2.0, 3.0]) + A @ (x - 1) + B @ (u - 1) + E @ w
    assert_close(dynamics(0.0, x, u, w), expected, rtol=1e-6)
    assert_close(dynamics.observe(0.0, x), [2.0])
    assert dynamics.disturbance_size == 1 and dynamics.noise is None
    rest = dlx.LinearDynamics(A, B, x_ref=jnp.ones(2))
    assert rest.noise == "additive"
    assert_close(rest(0.0, jnp.ones(2), jnp.zeros(1)), [1, 1], rtol=1e-6)


def test_time_varying_is_indexed_by_rounding():
    As = jnp.stack([k * jnp.eye(2) for k in (1.0, 2.0, 3.0)])
    dynamics = dlx.LinearDynamics(As, B, dt=0.1)
    assert dynamics.is_time_varying and dynamics.B.shape == (3, 2, 1)
    x, u = jnp.ones(2), jnp.zeros(1)
    for k in range(3):
        assert_close(dynamics(k * 0.1, x, u), (k + 1) * x, rtol=1e-6)
    assert np.all(np.isnan(dynamics(0.3, x, u)))
    env = dlx.Environment(
        dynamics, dlx.costs.Quadratic(jnp.eye(2), jnp.eye(1)), initial_state=x
    )
    zero = dlx.controllers.Zero(1)
    key = jax.random.key(0)
    assert_close(dlx.rollout(env, zero, key=key, horizon=3).final_state, [6, 6])
    with user_error(RuntimeError, match="NaN or infinite"):
        dlx.rollout(env, zero, key=key, horizon=5)


@needs_x64
def test_linearize_is_central_differences():
    system = dlx.systems.Pendulum(length=1.3, damping=0.1)
    x, u, w = jnp.array([0.4, -0.3]), jnp.array([0.2]), jnp.zeros(2)
    dynamics = dlx.Discretized(system, 0.05, diffrax.ImplicitEuler())
    model = dlx.linearize(dynamics, 0.0, x, u)
    step = jax.jit(lambda x, u: dynamics(0.0, x, u, w))
    for i in range(2):
        by_x = central_difference(lambda x, i=i: step(x, u)[i], x)
        by_u = central_difference(lambda u, i=i: step(x, u)[i], u)
        assert_close(model.A[i], by_x, atol=1e-8)
        assert_close(model.B[i], by_u, atol=1e-8)
    assert_close(model.E, jnp.eye(2))
    assert_close(model(0.0, x, u), step(x, u), rtol=1e-14)
    assert model.state_names == ("angle", "velocity")


def test_a_diffusion_is_not_an_input_of_a_linearised_system():
    class Drifting(dlx.AbstractSystem):
        state_names, control_names, disturbance_names = ("x",), ("u",), ("noise",)

        def vector_field(self, t, x, u, w):
            return u - x

        def diffusion(self, t, x, u):
            return jnp.ones((1, 1))

    at = dict(x=[0.0], u=[0.0])
    assert dlx.linearize(Drifting(), **at).E is None
    steps = dlx.linearize(dlx.Discretized(Drifting(), dt=0.1), **at)
    assert_close(steps.E, [[0.95]], atol=0.06)


def test_linearize_keeps_the_operating_point():
    system = dlx.systems.Pendulum()
    model = dlx.linearize(system)
    assert isinstance(model, dlx.systems.LinearSystem)
    assert_close(model.A, [[0, 1], [15, 0]])
    assert_close(model.B, [[0], [3]])
    hanging = jnp.array([jnp.pi / 2, 0.0])
    tilted = dlx.linearize(system, 0.0, hanging, jnp.zeros(1))
    assert_close(tilted.x_ref, hanging)
    assert_close(tilted.dx_ref, [0, 15], rtol=1e-6)
    adaptive = dlx.Discretized(
        system,
        0.05,
        diffrax.Tsit5(),
        stepsize_controller=diffrax.PIDController(rtol=1e-5, atol=1e-6),
    )
    fine = dlx.Discretized(system, 0.05, diffrax.Tsit5(), substeps=4)
    assert_close(dlx.linearize(adaptive).A, dlx.linearize(fine).A, atol=1e-4)


@pytest.mark.parametrize("ours, scipys", [("zoh", "zoh"), ("tustin", "bilinear")])
def test_c2d_is_scipys(ours, scipys):
    rng = np.random.default_rng(0)
    continuous = dlx.systems.LinearSystem(
        rng.normal(size=(4, 4)), rng.normal(size=(4, 2))
    )
    model = dlx.c2d(continuous, 0.1, ours)
    Ad, Bd, *_ = cont2discrete(
        (continuous.A, continuous.B, np.eye(4), np.zeros((4, 2))), 0.1, scipys
    )
    assert_close(model.A, Ad, atol=1e-13)
    assert_close(model.B, Bd, atol=1e-13)


def test_zoh_of_a_linearised_system_is_a_fine_integration():
    system = dlx.systems.Pendulum()
    x, u = jnp.array([0.5, 0.1]), jnp.array([0.3])
    linear = dlx.linearize(system, 0.0, x, u)
    sampled = dlx.c2d(linear, 0.05)
    fine = dlx.Discretized(linear, 0.05, diffrax.Dopri8(), substeps=4)
    at = (0.0, jnp.array([0.6, -0.2]), jnp.array([1.0]))
    assert_close(sampled(*at), fine(*at), atol=1e-14)


def test_lqr_about_a_point_holds_it():
    """The operating point is kept: no quiet sag away from it."""
    system = dlx.systems.Pendulum()
    tilt = 0.3
    u = jnp.array([-5.0 * jnp.sin(tilt)])
    dynamics = dlx.Discretized(system, 0.05)
    x = jnp.array([tilt, 0.0])
    controller = dlx.controllers.LQR(
        dlx.linearize(dynamics, 0.0, x, u), jnp.eye(2), jnp.eye(1)
    )
    env = dlx.Environment(dynamics, dlx.costs.PendulumCost(), horizon=200)
    run = dlx.rollout(env, controller, key=jax.random.key(0), x0=x + 0.05)
    assert_close(run.final_state, x, atol=1e-6)


@pytest.mark.parametrize(
    "make, match",
    [
        (lambda: dlx.LinearDynamics(A[:1], B), "A must be square"),
        (lambda: dlx.LinearDynamics(A, B.T), "B must have as many rows"),
        (lambda: dlx.LinearDynamics(A, B, dt=0.0), "dt must be positive"),
        (lambda: dlx.LinearDynamics(A * jnp.inf, B), "A must be finite"),
        (lambda: dlx.LinearDynamics(A, B, x_ref=jnp.ones(3)), "x_ref must have shape"),
        (lambda: dlx.LinearDynamics(A[None], jnp.ones((2, 2, 1))), "time axis"),
        (lambda: dlx.LinearDynamics(A, B, state_names=("x",)), "2 names"),
        (lambda: dlx.linearize(dlx.make("pendulum")), "model must be"),
        (lambda: dlx.c2d(dlx.LinearDynamics(A, B), 0.1), "must be a LinearSystem"),
        (lambda: dlx.c2d(dlx.systems.LinearSystem(A, B), 0.1, "foh"), "'zoh' or"),
        (lambda: dlx.c2d(dlx.systems.LinearSystem(A, B), -0.1), "dt must be positive"),
    ],
)
def test_bad_arguments(make, match):
    with user_error(match=match):
        make()


class Inverse(dlx.AbstractDynamics):
    """Its state is finite again after it was infinite."""

    state_names, control_names = ("x",), ("u",)
    dt: jax.Array = dlx.parameter(1.0)

    def advance(self, t, x, u, w):
        return 1 / x, dlx.RESULTS.successful


def test_open_loop():
    dynamics = dlx.LinearDynamics(A, B)
    controls = jnp.ones((3, 1))
    states = dlx.open_loop(dynamics, jnp.zeros(2), controls)
    x = jnp.zeros(2)
    for k in range(3):
        x = A @ x + B @ controls[k]
        assert_close(states[k + 1], x, rtol=1e-5)
    gradient = jax.grad(lambda u: dlx.open_loop(dynamics, jnp.zeros(2), u)[-1, 1])
    assert_close(gradient(controls)[2], B[1], rtol=1e-6)
    for arguments, match in [
        ((jnp.zeros(3), controls), "x0 must have shape"),
        ((jnp.zeros(2), jnp.ones((3, 2))), r"controls must have shape \(steps, 1\)"),
        ((jnp.zeros(2), jnp.ones((0, 1))), "at least one step"),
        ((jnp.zeros(2), controls, jnp.ones((2, 2))), r"w must have shape \(3, 2\)"),
    ]:
        with user_error(match=match):
            dlx.open_loop(dynamics, *arguments)
    with user_error(match="dynamics must be"):
        dlx.open_loop(dlx.make("pendulum"), jnp.zeros(2), controls)
    unstable = dlx.LinearDynamics(1e30 * jnp.eye(2), B)
    with pytest.raises(Exception, match="NaN or infinite"):
        dlx.open_loop(unstable, jnp.ones(2), jnp.ones((20, 1)))
    with pytest.raises(Exception, match="NaN or infinite"):
        dlx.open_loop(Inverse(), jnp.zeros(1), jnp.ones((2, 1)))
