"""What a step of `Discretized` is, which solvers fit it, and how it fails."""

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
import pytest
from helpers import (
    assert_close,
    assert_gradient,
    dtype,
    needs_x64,
    user_error,
)
from jaxtyping import Array
from scipy.integrate import solve_ivp

import delucax as dlx


pytestmark = needs_x64


PENDULUM = dlx.systems.Pendulum(damping=0.1)
X, U = jnp.array([1.0, -0.5]), jnp.array([0.7])
PID = diffrax.PIDController(rtol=1e-6, atol=1e-6)
ADAPTIVE = dict(solver=diffrax.Tsit5(), stepsize_controller=PID)


def scalar(f, **kwargs):
    return dlx.system(lambda t, x, u, w: f(x), states=1, controls=1, **kwargs)


class Growth(dlx.AbstractSystem):
    """dx = (u - x) dt + g(x) dB, of one state with a diagonal or a full matrix."""

    state_names = ("x",)
    control_names = ("u",)
    full: bool = eqx.field(static=True, default=False)

    def vector_field(self, t, x, u, w):
        return u - x

    def diffusion(self, t, x, u):
        g = 0.2 * (1 + x**2)
        return g[:, None] if self.full else g


class Clipped(dlx.AbstractSystem):
    state_names = ("x",)
    control_names = ("u",)

    def vector_field(self, t, x, u, w):
        return u

    def project(self, x):
        return jnp.clip(x, -1, 1)


class Hidden(dlx.AbstractSystem):
    """Overrides every hook that dynamics pass on."""

    state_names = ("x",)
    control_names = ("u",)
    state_units = ("m",)
    control_units = ("N",)
    rest: Array = dlx.parameter(2.0)

    def vector_field(self, t, x, u, w):
        return u - x + self.rest

    def observe(self, t, x):
        return jnp.concatenate([x, x + t])

    def difference(self, x, x_ref):
        return 3 * (x - x_ref)

    def equilibrium(self):
        return self.rest[None], jnp.zeros(1)


# What a step is.


def test_substeps_are_shorter_steps():
    x, solver = X, diffrax.Tsit5()
    step = eqx.filter_jit(dlx.Discretized(PENDULUM, 0.1, solver, 3))
    part = eqx.filter_jit(dlx.Discretized(PENDULUM, 0.1 / 3, solver))
    for k in range(3):
        x = part(0.1 * k / 3, x, U)
    assert_close(step(0.0, X, U), x, atol=1e-14)


def test_a_step_by_hand():
    f = lambda x: PENDULUM.vector_field(0.0, x, U, None)
    h = 0.05
    euler = dlx.Discretized(PENDULUM, h, diffrax.Euler())
    assert_close(euler(0.0, X, U), X + h * f(X), atol=1e-15)
    heun = dlx.Discretized(PENDULUM, h, diffrax.Heun())
    expected = X + h / 2 * (f(X) + f(X + h * f(X)))
    assert_close(heun(0.0, X, U), expected, atol=1e-15)
    a, b = f(X), f(X + h / 2 * f(X))
    c = f(X + h / 2 * b)
    expected = X + h / 6 * (a + 2 * b + 2 * c + f(X + h * c))
    rk4 = dlx.Discretized(PENDULUM, h)
    assert_close(rk4(0.0, X, U), expected, atol=1e-15)


def test_time_within_a_step():
    """The field is asked at the times of the stages: the integral of t^2 is exact."""
    system = dlx.system(lambda t, x, u, w: t**2 * u, states=1, controls=1)
    for solver in (dlx.dynamics.RK4(), diffrax.Kvaerno3(), diffrax.Dopri5()):
        step = dlx.Discretized(system, 0.5, solver, substeps=2)
        exact = (1.5**3 - 1) / 3
        assert_close(step(1.0, jnp.zeros(1), jnp.ones(1)), [exact], rtol=1e-9)


def test_disturbances_enter_where_the_system_names_them():
    inside = dlx.systems.LinearSystem(-jnp.eye(1), jnp.eye(1), E=3 * jnp.eye(1))
    step = dlx.Discretized(inside, 0.1, diffrax.Euler())
    w = jnp.array([0.5])
    assert_close(step(0.0, jnp.ones(1), jnp.ones(1), w), [1 + 0.15], rtol=1e-6)
    # Otherwise after `project`, once an interval however many substeps there are.
    step = dlx.Discretized(Clipped(), 0.1, diffrax.Euler(), substeps=4)
    assert_close(step(0.0, jnp.ones(1), 20 * jnp.ones(1), w), [1.5], rtol=1e-6)
    assert_close(step(0.0, jnp.ones(1), -25 * jnp.ones(1)), [-1.0], rtol=1e-6)


def test_what_is_passed_on_from_the_system():
    step = dlx.Discretized(Hidden(), 0.1)
    assert_close(step.observe(1.0, jnp.ones(1)), [1.0, 2.0])
    assert step.observation_size == 2
    assert_close(step.difference(jnp.ones(1), jnp.zeros(1)), [3.0])
    x, u = step.equilibrium()
    assert_close(step(0.0, x, u), x, rtol=1e-6)
    assert (step.state_units, step.control_units) == (("m",), ("N",))
    assert (step.state_names, step.control_names) == (("x",), ("u",))
    assert step.noise == "additive" and step.disturbance_size == 1


def test_precision_follows_the_state():
    for kind in {jnp.float32, dtype()}:
        for solver in (diffrax.Tsit5(), diffrax.Kvaerno3()):
            step = dlx.Discretized(PENDULUM, 0.05, solver)
            x = eqx.filter_eval_shape(step, 0.0, X.astype(kind), U.astype(kind))
            assert x.dtype == kind


def test_a_new_interval_does_not_compile_again():
    traced = []

    @eqx.filter_jit
    def run(dynamics):
        traced.append(None)
        return dynamics(0.0, X, U)

    a, b = (run(dlx.Discretized(PENDULUM, dt)) for dt in (0.05, 0.1))
    run(dlx.replace(dlx.Discretized(PENDULUM, 0.2), {"dt": 0.3}))
    assert len(traced) == 1 and not np.allclose(a, b)


# Implicit steps.


@pytest.mark.parametrize("rate, size", [(-1e4, 1.0), (-3.0, 1e4), (-1e4, 1e3)])
def test_implicit_euler_of_a_stiff_decay(rate, size):
    step = dlx.Discretized(scalar(lambda x: rate * x), 0.1, diffrax.ImplicitEuler())
    x = step(0.0, jnp.array([size]), jnp.zeros(1))
    # The step cancels all but a thousandth of the state.
    assert_close(x, [size / (1 - 0.1 * rate)], rtol=1e-9)


@pytest.mark.parametrize(
    "solver",
    [
        diffrax.Kvaerno3(),
        diffrax.Kvaerno5(),
        diffrax.ImplicitEuler(),
    ],
)
def test_implicit_steps_converge_where_diffrax_gives_up(solver):
    """Diffrax's chord method stops after two iterations, for a shorter step. Here the
    slope changes so much over a step that it takes more."""
    field = lambda x: [x[1], 100 * ((1 - x[0] ** 2) * x[1] - x[0])]
    van_der_pol = dlx.system(
        lambda t, x, u, w: jnp.stack(field(x)), states=2, controls=1
    )
    dynamics = dlx.Discretized(van_der_pol, 0.05, solver, substeps=5)
    start = np.array([2.0, -0.66])
    states = dlx.open_loop(dynamics, start, jnp.zeros((6, 1)))
    exact = solve_ivp(
        lambda t, x: field(x),
        (0, 0.3),
        start,
        t_eval=np.linspace(0, 0.3, 7),
        method="Radau",
        rtol=1e-10,
        atol=1e-12,
    )
    first_order = isinstance(solver, diffrax.ImplicitEuler)
    assert_close(states, exact.y.T, atol=3e-3 if first_order else 3e-5)


def test_an_implicit_step_without_a_solution():
    """`x1 = x0 + h x1^2` has no real root where `4 h x0 > 1`."""
    step = dlx.Discretized(scalar(lambda x: x**2), 0.5, diffrax.ImplicitEuler())
    x, result = step.advance(0.0, jnp.ones(1), jnp.zeros(1), None)
    assert result != dlx.RESULTS.successful
    with user_error(RuntimeError, match="stages of an implicit solver were not solved"):
        step(0.0, jnp.ones(1), jnp.zeros(1))


def test_a_root_finder_with_tolerances_of_its_own_is_kept():
    loose = optx.Newton(rtol=1.0, atol=1.0)
    tight = optx.Newton(rtol=1e-5, atol=1e-5)
    system = scalar(lambda x: -(x**3))
    found = [
        dlx.Discretized(system, 1.0, diffrax.ImplicitEuler(root_finder=finder))(
            0.0, 2 * jnp.ones(1), jnp.zeros(1)
        )
        for finder in (loose, tight)
    ]
    assert_close(found[1], [1.0], atol=1e-5)
    assert abs(found[0] - found[1]) > 1e-4


# Noise inside.


@pytest.mark.parametrize(
    "solver, full, weight, corrected",
    [
        (None, False, 0.0, 0.0),
        (diffrax.Euler(), False, 0.0, 0.0),
        (diffrax.Euler(), True, 0.0, 0.0),
        (diffrax.ItoMilstein(), False, 0.5, 0.5),
        (diffrax.StratonovichMilstein(), False, 0.5, 0.0),
    ],
    ids=["default", "Euler-Maruyama", "full matrix", "Ito", "Stratonovich"],
)
def test_stochastic_steps_by_hand(solver, full, weight, corrected):
    step = dlx.Discretized(Growth(full), 0.1, solver)
    assert step.noise == "brownian" and step.disturbance_size == 1
    x, u, dB = 0.8, 0.3, 0.17
    g, slope = 0.2 * (1 + x**2), 0.4 * x
    expected = x + 0.1 * (u - x) + g * dB + g * slope * (weight * dB**2)
    expected -= g * slope * corrected * 0.1
    found = step(0.0, jnp.array([x]), jnp.array([u]), jnp.array([dB]))
    assert_close(found, [expected], atol=1e-14)


@pytest.mark.parametrize(
    "solver",
    [diffrax.EulerHeun(), diffrax.Heun(), diffrax.Midpoint(), diffrax.Ralston()],
    ids=lambda solver: type(solver).__name__,
)
def test_stratonovich_steps_agree_to_their_order(solver):
    """All approximate the same solution; without noise they are the plain methods."""
    found, milstein = (
        dlx.Discretized(Growth(), 1e-3, s)(0.0, jnp.ones(1), U, jnp.array([0.02]))
        for s in (solver, diffrax.StratonovichMilstein())
    )
    # They differ by terms such as dt dB, and not by those such as dB^2 / 2 = 2e-4.
    assert_close(found, milstein, atol=1e-5)
    still = dlx.Discretized(Growth(), 1e-3, solver)(0.0, jnp.ones(1), U)
    assert_close(still, [1 - 0.3e-3], atol=1e-6)


class Driven(dlx.AbstractSystem):
    """Two states under `motions` Brownian motions."""

    state_names = ("x", "y")
    control_names = ("u",)
    motions: int = eqx.field(static=True)

    def vector_field(self, t, x, u, w):
        return -x

    def diffusion(self, t, x, u):
        return jnp.arange(1.0, 1 + 2 * self.motions).reshape(2, -1).astype(x.dtype)


class Named(Driven):
    disturbance_names = ("wind", "sea")


@pytest.mark.parametrize(
    "motions, solver", [(1, diffrax.EulerHeun()), (3, diffrax.Euler())]
)
def test_as_many_brownian_motions_as_the_diffusion_has_columns(motions, solver, key):
    system = Driven(motions)
    step = dlx.Discretized(system, 0.1, solver, substeps=2)
    assert step.disturbance_size == 2 * motions
    w = jnp.linspace(-0.2, 0.5, 2 * motions)
    x, g = jnp.ones(2), system.diffusion(0.0, jnp.ones(2), None)
    for dB in w.reshape(2, motions):
        x = x - 0.05 * x + g @ dB
    assert_close(step(0.0, jnp.ones(2), jnp.zeros(1), w), x, rtol=1e-12)
    env = dlx.Environment(step, dlx.costs.Quadratic(jnp.eye(2), jnp.eye(1)), horizon=3)
    run = dlx.rollout(env, dlx.controllers.Zero(1), key=key)
    assert run.disturbances.shape == (3, 2 * motions)
    model = dlx.linearize(step, x=jnp.ones(2), u=jnp.zeros(1))
    assert model.E.shape == (2, 2 * motions)


@pytest.mark.parametrize(
    "shape, words",
    [
        (
            (3, 2),
            r"diffusion must return an array of shape \(2, k\).*got shape \(3, 2\)",
        ),
        ((), r"diffusion must return an array .*got shape \(\)"),
    ],
)
def test_a_diffusion_of_the_wrong_shape(shape, words):
    class Wrong(Driven):
        def diffusion(self, t, x, u):
            return jnp.ones(shape)

    with user_error(match=f"Wrong: {words}"):
        dlx.Discretized(Wrong(1), 0.1)


def test_names_of_brownian_motions():
    assert dlx.Discretized(Named(2), 0.1).disturbance_size == 2
    with user_error(match="Named: disturbance_names must name the 3 Brownian motions"):
        dlx.Discretized(Named(3), 0.1)


def test_substeps_of_noise_need_their_increments():
    step = dlx.Discretized(Growth(), 0.1, substeps=3)
    with user_error(match=r"w \(the disturbance\) must have shape \(3,\)"):
        step(0.0, jnp.ones(1), U, jnp.ones(1))


# Adaptive steps.


@pytest.mark.parametrize(
    "solver",
    [
        diffrax.HalfSolver(dlx.dynamics.RK4()),
        diffrax.Kvaerno4(),
    ],
    ids=["wrapped", "implicit"],
)
def test_solvers_that_adapt(solver):
    adaptive = dlx.Discretized(PENDULUM, 0.05, solver, stepsize_controller=PID)
    fine = dlx.Discretized(PENDULUM, 0.05, diffrax.Tsit5(), substeps=20)
    assert_close(adaptive(0.0, X, U), fine(0.0, X, U), atol=1e-5)


def test_too_few_steps_is_a_status_and_an_error():
    step = dlx.Discretized(
        PENDULUM, 5.0, diffrax.Tsit5(), stepsize_controller=PID, max_steps=3
    )
    _, result = step.advance(0.0, X, U, None)
    assert result == dlx.RESULTS.max_steps_reached
    with user_error(RuntimeError, match="maximum number of solver steps"):
        step(0.0, X, U)


def test_tolerance_below_the_precision_is_blamed():
    eps = float(jnp.finfo(float).eps)
    fine = diffrax.PIDController(rtol=1e-4 * eps, atol=1e-4 * eps)
    for controller in (fine, diffrax.ClipStepSizeController(fine)):
        dynamics = dlx.Discretized(
            PENDULUM, 0.05, diffrax.Tsit5(), stepsize_controller=controller
        )
        _, result = dynamics.advance(0.0, jnp.array([0.1, 0.0]), jnp.zeros(1), None)
        assert result == dlx.RESULTS.beyond_precision
    run = dlx.simulate(
        PENDULUM,
        jnp.zeros((1, 1)),
        0.0,
        0.05,
        jnp.array([0.1, 0.0]),
        solver=diffrax.Tsit5(),
        stepsize_controller=fine,
        max_steps=256,
        throw=False,
    )
    assert run.result == dlx.RESULTS.beyond_precision


class Wave(dlx.AbstractSystem):
    state_names = ("x",)
    control_names = ("u",)
    length: Array = dlx.parameter(1.0)

    def vector_field(self, t, x, u, w):
        return u - jnp.sin(x) / self.length


def backsolve(**kwargs):
    return dlx.Discretized(
        Wave(),
        0.2,
        diffrax.Bosh3(),
        stepsize_controller=diffrax.PIDController(rtol=1e-9, atol=1e-9),
        adjoint=diffrax.BacksolveAdjoint(**kwargs),
    )


@needs_x64
def test_a_backward_solve_that_fails_is_loud():
    after = lambda x: backsolve(max_steps=1)(0.0, x, U)[0]
    with user_error(RuntimeError, match="maximum number of solver steps"):
        jax.block_until_ready(jax.jit(jax.grad(after))(X[:1]))


def test_backsolve_inside_a_rollout():
    cost = dlx.costs.Quadratic([1.0], [0.1])
    env = dlx.Environment(backsolve(), cost, horizon=3)

    def total(leaves):
        """Of a length, a gain and a start."""
        plant = dlx.replace(env, {"dynamics.system.length": leaves[0]})
        linear, key = dlx.controllers.Linear(leaves[None, 1:2]), jax.random.key(0)
        run = dlx.rollout(plant, linear, key=key, x0=leaves[2:], throw=False)
        return run.total_cost

    at = jnp.array([1.1, 2.0, 1.0])
    assert_gradient(total, at, step=1e-4, rtol=1e-5)


# What does not fit.


@pytest.mark.parametrize(
    "arguments, words",
    [
        (dict(system=lambda t, x, u, w: x), "system must be an AbstractSystem"),
        (dict(dt=0.0), "dt must be positive and finite, got 0.0"),
        (dict(dt=-0.1), "dt must be positive"),
        (dict(dt=np.nan), "dt must be positive"),
        (dict(dt=np.inf), "dt must be positive"),
        (dict(solver=diffrax.Tsit5), "solver must be a Diffrax solver"),
        (dict(solver="RK4"), "solver must be a Diffrax solver"),
        (dict(solver=diffrax.KenCarp3()), "KenCarp3 needs a split"),
        (dict(solver=diffrax.LeapfrogMidpoint()), "does not fit fixed steps"),
        (dict(solver=diffrax.SemiImplicitEuler()), "does not fit fixed steps"),
        (dict(solver=diffrax.HalfSolver(diffrax.Heun())), "does not fit fixed steps"),
        (
            dict(solver=diffrax.HalfSolver(diffrax.Kvaerno3())),
            "hides its root finder",
        ),
        (dict(substeps=0), "substeps must be a whole number of at least 1, got 0"),
        (dict(substeps=2.0), "substeps must be a whole number"),
        (dict(substeps=True), "substeps must be a whole number"),
        (dict(adjoint=diffrax.DirectAdjoint()), "adjoint needs a stepsize_controller"),
        (dict(max_steps=10), "max_steps needs a stepsize_controller"),
        (
            dict(solver=diffrax.Tsit5(), stepsize_controller=PID, substeps=2),
            "substeps must be 1",
        ),
        (
            dict(solver=diffrax.Tsit5(), stepsize_controller=PID, max_steps=0),
            "max_steps must be a",
        ),
        (
            dict(stepsize_controller=PID, solver=diffrax.Euler()),
            r"Euler has no error estimate.*HalfSolver\(Euler\(\)\)",
        ),
        (dict(stepsize_controller=PID), "RK4 has no error estimate"),
        (
            dict(stepsize_controller=PID, solver=diffrax.LeapfrogMidpoint()),
            "LeapfrogMidpoint has no error estimate",
        ),
        (
            dict(stepsize_controller=PID, solver=diffrax.KenCarp3()),
            "KenCarp3 needs a split",
        ),
        (
            dict(system=Growth(), solver=diffrax.Tsit5()),
            "Tsit5 does not fit a system with a diffusion. Use one of Euler",
        ),
        (
            dict(system=Growth(), solver=diffrax.Tsit5(), stepsize_controller=PID),
            "stepsize_controller must be left out for a system with a diffusion",
        ),
    ],
)
def test_constructor_errors(arguments, words):
    with user_error(match=f"Discretized: .*{words}"):
        dlx.Discretized(**(dict(system=PENDULUM, dt=0.05) | arguments))


@pytest.mark.parametrize("value", [np.nan, np.inf, 0.0, -1.0])
def test_parameters_that_are_not_legal(value):
    with user_error(match="Pendulum: length must be"):
        dlx.Discretized(dlx.systems.Pendulum(length=value), 0.05)
    with user_error(match="Pendulum: length must be"):
        dynamics = dlx.Discretized(PENDULUM, 0.05)
        dlx.replace(dynamics, {"system.length": value})


def test_shapes():
    step = dlx.Discretized(PENDULUM, 0.05)
    with user_error(match=r"x \(the state\) must have shape \(2,\), got shape \(3,\)"):
        step(0.0, jnp.zeros(3), U)
    with user_error(match=r"u \(the control\) must have shape \(1,\)"):
        step(0.0, X, jnp.zeros(2))
    with user_error(match=r"w \(the disturbance\) must have shape \(2,\)"):
        step(0.0, X, U, jnp.zeros(1))
    wrong = dlx.Discretized(scalar(lambda x: jnp.zeros(2)), 0.05)
    with user_error(match=r"vector_field must return an array .*\(1,\).*got \(2,\)"):
        wrong(0.0, jnp.zeros(1), jnp.zeros(1))
