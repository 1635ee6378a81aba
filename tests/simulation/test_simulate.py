import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.integrate
from helpers import assert_close, dtype, needs_x64, once, tolerance, user_error
from jaxtyping import Array

import delucax as dlx
from delucax.simulation._hold import Hold, interval_before


PENDULUM = dlx.systems.Pendulum(damping=0.1)
FEEDBACK = dlx.controllers.Linear(jnp.array([[20.0, 5.0]]))
HANGING = jnp.array([3.0, 0.5])
UPRIGHT = jnp.array([0.1, 0.0])
LOOSE = diffrax.PIDController(rtol=1e-4, atol=1e-6)
ADAPTIVE = diffrax.PIDController(rtol=tolerance(1e-5, 1e-10), atol=1e-10)
INTEGRATOR = dlx.system(lambda t, x, u, w: u, states=1, controls=1)
SWITCHED = dlx.systems.LinearSystem(-jnp.eye(1), jnp.eye(1), E=jnp.eye(1))


def switching(steps, seed=0, size=1):
    controls = np.random.default_rng(seed).uniform(-2, 2, (steps, size))
    return jnp.asarray(controls, dtype())


class Projected(dlx.AbstractSystem):
    state_names = ("x",)
    control_names = ("u",)

    def vector_field(self, t, x, u, w):
        return u

    def project(self, x):
        return jnp.clip(x, -1, 1)


class Noisy(dlx.AbstractSystem):
    state_names = ("x",)
    control_names = ("u",)

    def vector_field(self, t, x, u, w):
        return u

    def diffusion(self, t, x, u):
        return jnp.ones(1)


class Sensed(dlx.AbstractSystem):
    """Sees the position alone, and sees it late in the day as double."""

    state_names = ("x", "v")
    control_names = ("u",)

    def vector_field(self, t, x, u, w):
        return jnp.stack([x[1], u[0]])

    def observe(self, t, x):
        return (1 + t) * x[:1]


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


# Exact at the switch.


@pytest.mark.parametrize(
    "how",
    [
        {"solver": diffrax.Heun(), "substeps": 3},
        {"stepsize_controller": LOOSE},
        pytest.param(
            {"stepsize_controller": diffrax.PIDController(1e-4, 1e-6, dtmax=0.006)},
            marks=once,
        ),
    ],
    ids=["fixed", "adaptive", "short steps"],
)
def test_switches_are_exact(how):
    """The integral of a held control is known, and one wrong stage would show."""
    controls = switching(97)
    sums = np.cumsum(np.asarray(controls, float)[:, 0])
    for t0, t1 in [(0.0, 3.1), (100.0, 101.7)]:
        run = dlx.simulate(INTEGRATOR, controls, t0, t1, jnp.zeros(1), **how)
        expected = np.concatenate([[0], sums]) * (t1 - t0) / 97
        ulp = np.finfo(dtype()).eps * t1
        assert_close(run.states[:, 0], expected, atol=20 * ulp)
        assert_close(run.controls, controls)


@pytest.mark.parametrize("count", [1, 200])
def test_interval_of_a_step(count):
    grid = np.arange(count + 1, dtype=dtype())
    hold = Hold(diffrax.Tsit5(), count, False)
    interval = jax.jit(jax.vmap(hold._interval))
    tiny = np.finfo(grid.dtype).tiny  # below it XLA flushes to zero
    below = np.where(grid == 0, -tiny, np.nextafter(grid, grid.dtype.type(-9)))
    above = np.where(grid == 0, tiny, np.nextafter(grid, grid.dtype.type(999)))
    here = np.arange(count)
    for low, high in [
        (grid[:-1], grid[1:]),
        (grid[:-1], above[:-1]),
        (below[1:], grid[1:]),
        (above[:-1], below[1:]),
        # Diffrax may begin one rounding before a switch and go on from there.
        (below[:-1], grid[1:]),
    ]:
        assert_close(interval(low, high), here)
        assert_close(interval(-high, -low), here)
    assert_close(interval(-above[1:], -grid[:-1]), here)
    assert_close(interval_before(jnp.asarray(grid[1:]), count), here)
    assert_close(interval_before(jnp.asarray(above[:-1]), count), here)


@pytest.mark.parametrize(
    "solver",
    [
        dlx.dynamics.RK4(),
        pytest.param(diffrax.Kvaerno3(), marks=needs_x64),
    ],
    ids=lambda solver: type(solver).__name__,
)
def test_fixed_steps_are_those_of_discretized(solver):
    controls = switching(40)
    run = dlx.simulate(PENDULUM, controls, 0.0, 2.0, HANGING, solver=solver, substeps=2)
    dynamics = dlx.Discretized(PENDULUM, 0.05, solver, substeps=2)
    expected = dlx.open_loop(dynamics, HANGING, controls)
    # Single precision rounds the times of the switches too, by 1e-7 of 2 seconds.
    assert_close(run.states, expected, atol=tolerance(2e-5, 1e-13))
    assert run.states.dtype == dtype()


def test_adaptive_steps_agree_with_scipy():
    controls = switching(20)
    run = dlx.simulate(
        PENDULUM, controls, 0.5, 1.5, HANGING, stepsize_controller=ADAPTIVE
    )
    x = np.asarray(HANGING, float)
    for k in range(20):
        u = float(controls[k, 0])

        def field(t, x, u=u):
            return [x[1], 15 * np.sin(x[0]) + 3 * u - 0.1 * x[1]]

        step = scipy.integrate.solve_ivp(
            field, (0, 0.05), x, method="DOP853", rtol=1e-13, atol=1e-13
        )
        x = step.y[:, -1]
        assert_close(run.states[k + 1], x, atol=tolerance(3e-5, 3e-9))
    assert_close(run.times, np.linspace(0.5, 1.5, 21), atol=tolerance(1e-6, 1e-14))


@needs_x64
def test_held_disturbances():
    controls, w = switching(10), switching(10, seed=1)
    run = dlx.simulate(SWITCHED, controls, 0.0, 1.0, jnp.ones(1), w=w)
    dynamics = dlx.Discretized(SWITCHED, 0.1, diffrax.Tsit5())
    expected = dlx.open_loop(dynamics, jnp.ones(1), controls, w)
    assert_close(run.states, expected, atol=1e-13)
    assert_close(run.disturbances, w)
    # They are held under a control that is not, and say how long the intervals are.
    zero = dlx.controllers.Zero(1)
    run = dlx.simulate(SWITCHED, zero, 0.0, 1.0, jnp.ones(1), w=w, hold=None)
    expected = dlx.open_loop(dynamics, jnp.ones(1), jnp.zeros((10, 1)), w)
    assert_close(run.states, expected, atol=1e-13)


# Feedback.


@pytest.mark.parametrize(
    "controller, how",
    [
        pytest.param(FEEDBACK, {"stepsize_controller": ADAPTIVE}, marks=needs_x64),
        (Told(), {"substeps": 2}),
    ],
    ids=["linear", "memory"],
)
def test_sampled_feedback_is_that_of_a_rollout(controller, how, key):
    run = dlx.simulate(PENDULUM, controller, 0.0, 1.0, UPRIGHT, dt=0.05, **how)
    dynamics = dlx.Discretized(PENDULUM, 0.05, diffrax.Tsit5(), substeps=8)
    env = dlx.Environment(dynamics, dlx.costs.Function(lambda t, x, u: 0.0))
    expected = dlx.rollout(env, controller, key=key, x0=UPRIGHT, horizon=20)
    for name in ("states", "controls", "observations"):
        a, b = getattr(run, name), getattr(expected, name)
        assert_close(a, b, atol=tolerance(2e-5, 3e-7))


@needs_x64
def test_continuous_feedback_agrees_with_scipy():
    run = dlx.simulate(
        Sensed(),
        dlx.controllers.Linear(jnp.array([[4.0]])),
        0.0,
        1.0,
        jnp.array([1.0, 0.0]),
        hold=None,
        dt=0.1,
        solver=diffrax.Dopri8(),
    )
    exact = scipy.integrate.solve_ivp(
        lambda t, x: [x[1], -4 * (1 + t) * x[0]],
        (0, 1),
        [1.0, 0.0],
        t_eval=np.linspace(0, 1, 11),
        method="DOP853",
        rtol=1e-13,
        atol=1e-13,
    )
    assert_close(run.states, exact.y.T, atol=1e-10)
    seen = (1 + exact.t[:-1]) * exact.y[0, :-1]
    assert_close(run.observations[:, 0], seen, atol=1e-10)
    assert_close(run.controls[:, 0], -4 * seen, atol=1e-9)


@needs_x64
def test_a_function_of_time():
    signal = lambda t: jnp.stack([jnp.cos(t)])
    exact = np.sin(np.linspace(0, 1, 11))
    run = dlx.simulate(INTEGRATOR, signal, 0.0, 1.0, jnp.zeros(1), hold=None, dt=0.1)
    assert_close(run.states[:, 0], exact, atol=1e-10)
    assert_close(run.controls[:, 0], np.cos(0.1 * np.arange(10)), atol=1e-6)
    held = dlx.simulate(INTEGRATOR, signal, 0.0, 1.0, jnp.zeros(1), dt=0.1)
    sums = np.cumsum(np.cos(0.1 * np.arange(10))) * 0.1
    assert_close(held.states[1:, 0], sums, atol=1e-6)
    assert_close(held.controls[:, 0], np.cos(0.1 * np.arange(10)), atol=1e-6)


@once
def test_a_controller_that_draws(key):
    noise = dlx.controllers.Random(jnp.ones(1))
    run = dlx.simulate(INTEGRATOR, noise, 0.0, 1.0, jnp.zeros(1), dt=0.1, key=key)
    assert len(np.unique(run.controls)) == 10
    sums = np.cumsum(np.asarray(run.controls)[:, 0]) * 0.1
    assert_close(run.states[1:, 0], sums, atol=1e-5)
    with user_error(match="key must be one random key"):
        dlx.simulate(INTEGRATOR, noise, 0.0, 1.0, jnp.zeros(1), dt=0.1)


# What is saved.


@needs_x64
def test_save_times():
    controls = switching(10)
    ts = np.array([0.05, 0.1, 0.3, 0.35, 1.0])
    how = {"stepsize_controller": ADAPTIVE}
    run = dlx.simulate(INTEGRATOR, controls, 0.0, 1.0, jnp.zeros(1), ts=ts, **how)
    ends = np.concatenate([[0], np.cumsum(np.asarray(controls, float)[:, 0]) * 0.1])
    exact = np.interp(ts, np.linspace(0, 1, 11), ends)
    assert_close(run.times, ts, rtol=1e-6)
    assert_close(run.states[:, 0], exact, atol=1e-12)
    assert_close(run.controls, controls[np.array([0, 2, 3, 9])])
    assert run.steps == 4 and run.length == 4
    assert_close(run.final_state, run.states[-1])


@once
def test_what_a_trajectory_of_it_holds():
    run = dlx.simulate(PENDULUM, switching(5), 0.0, 0.25, UPRIGHT)
    assert run.costs is None and run.terminated is None
    assert run.final_cost == 0 and run.total_cost == 0
    assert run.states.shape == (6, 2) and run.controls.shape == (5, 1)
    assert run.observations.shape == (5, 2) and run.disturbances.shape == (5, 2)
    assert run.state_names == PENDULUM.state_names and run.batch_shape == ()
    assert_close(run.dt, 0.05, rtol=1e-6)
    assert run.result == dlx.RESULTS.successful
    table = run.to_pandas()
    assert list(table.columns[:4]) == ["time", "angle", "velocity", "torque"]


@needs_x64
def test_batches():
    controls, decay = switching(4), np.exp(-0.25)
    starts = jnp.array([[0.5], [1.0], [4.0]])
    run = lambda x0: dlx.simulate(
        SWITCHED, controls, 0.0, 1.0, x0, stepsize_controller=ADAPTIVE
    )
    batch = jax.jit(jax.vmap(run))(starts)
    assert batch.batch_shape == (3,) and batch.times.shape == (3, 5)
    x = np.asarray(starts, float)
    for k in range(4):
        x = decay * x + (1 - decay) * float(controls[k, 0])
        assert_close(batch.states[:, k + 1], x, atol=1e-8)


@once
def test_compiles_once():
    count = 0

    def field(t, x, u, w):
        nonlocal count
        count += 1
        return u - x

    system = dlx.system(field, states=1, controls=1)
    for k in range(3):
        dlx.simulate(system, k * jnp.ones((6, 1)), 0.0, 1.0 + k, jnp.ones(1))
        if k == 0:
            first = count
    assert count == first


@once
def test_progress_meter(capfd):
    meter = diffrax.TextProgressMeter()
    run = dlx.simulate(
        INTEGRATOR, switching(3), 0.0, 1.0, jnp.zeros(1), progress_meter=meter
    )
    jax.block_until_ready(run.states)
    jax.effects_barrier()
    assert "100.00%" in capfd.readouterr().out


# What goes wrong.


@once
@pytest.mark.parametrize(
    "how, words, at",
    [
        ({}, "NaN or infinite", 0.3),
        ({"stepsize_controller": LOOSE}, "maximum number of solver steps", None),
    ],
)
def test_a_failed_solve_raises(how, words, at):
    explodes = dlx.system(lambda t, x, u, w: x**2, states=1, controls=1)
    arguments = (explodes, jnp.zeros((20, 1)), 0.0, 2.0, 5 * jnp.ones(1))
    with user_error(RuntimeError, match=f"simulate: .*{words}"):
        dlx.simulate(*arguments, **how)
    run = dlx.simulate(*arguments, throw=False, **how)
    assert run.result != dlx.RESULTS.successful
    assert words in dlx.RESULTS[run.result]


PID = diffrax.PIDController(rtol=1e-6, atol=1e-6)
U, X = jnp.zeros((4, 1)), jnp.zeros(2)


@once
@pytest.mark.parametrize(
    "change, words",
    [
        ({"system": lambda t, x, u, w: x}, "system must be an AbstractSystem"),
        ({"system": Projected(), "x0": X[:1]}, "Projected projects its state"),
        ({"system": Noisy(), "x0": X[:1]}, "has a diffusion.*Discretized"),
        ({"t1": 0.0}, "t1 must be above t0, got t0 = 0.0, t1 = 0.0"),
        ({"t1": np.inf}, "t1 must be finite"),
        ({"t0": jnp.zeros(2)}, "t0 must be a number"),
        ({"x0": jnp.zeros(3)}, r"x0 must have shape \(2,\), got shape \(3,\)"),
        ({"x0": jnp.full(2, np.nan)}, "x0 must be finite"),
        ({"controls": jnp.zeros((4, 2))}, r"must have shape \(steps, 1\).*\(4, 2\)"),
        ({"controls": jnp.zeros((0, 1))}, "at least one step"),
        ({"controls": None}, r"must have shape \(steps, 1\), .*got None"),
        ({"hold": "first"}, "hold must be 'zero' or None, got 'first'"),
        ({"hold": None}, "hold=None needs a controller or a function of time"),
        ({"w": jnp.zeros((4, 2))}, "Pendulum has no disturbance_names"),
        ({"controls": FEEDBACK}, "dt must be given"),
        ({"controls": FEEDBACK, "hold": None}, "dt must be given"),
        ({"controls": FEEDBACK, "dt": 0.3}, "must be a whole multiple of dt"),
        ({"controls": FEEDBACK, "dt": -0.1}, "dt must be positive"),
        ({"controls": FEEDBACK, "dt": 2.0}, "must be a whole multiple of dt"),
        ({"dt": 0.1}, "got 4 by controller_or_controls, 10 by dt"),
        ({"solver": diffrax.Tsit5}, "solver must be a Diffrax solver"),
        ({"solver": diffrax.KenCarp3()}, "needs a split"),
        ({"solver": diffrax.ReversibleHeun()}, "does not fit fixed steps"),
        (
            {"solver": dlx.dynamics.RK4(), "stepsize_controller": PID},
            "RK4 has no error estimate",
        ),
        (
            {"solver": diffrax.Euler(), "stepsize_controller": PID},
            "Euler has no error estimate",
        ),
        (
            {"solver": diffrax.LeapfrogMidpoint(), "stepsize_controller": PID},
            "LeapfrogMidpoint has no error estimate",
        ),
        (
            {"stepsize_controller": diffrax.ConstantStepSize()},
            "must be adaptive.*pass substeps. Got ConstantStepSize",
        ),
        ({"stepsize_controller": PID, "substeps": 2}, "substeps must be 1"),
        ({"substeps": 0}, "substeps must be a whole number of at least 1"),
        ({"max_steps": 10}, "max_steps needs a stepsize_controller"),
        ({"stepsize_controller": PID, "max_steps": 0}, "max_steps must be a whole"),
        ({"adjoint": "backsolve"}, "adjoint must be a Diffrax adjoint"),
        ({"adjoint": diffrax.ImplicitAdjoint()}, "steady state"),
        ({"adjoint": diffrax.BacksolveAdjoint()}, "needs a stepsize_controller"),
        (
            {
                "adjoint": diffrax.BacksolveAdjoint(),
                "stepsize_controller": PID,
                "controls": FEEDBACK,
                "dt": 0.25,
            },
            "does not fit a held controller",
        ),
        (
            {
                "adjoint": diffrax.BacksolveAdjoint(solver=diffrax.Euler()),
                "stepsize_controller": PID,
            },
            "BacksolveAdjoint: solver Euler has no error estimate",
        ),
        (
            {
                "adjoint": diffrax.BacksolveAdjoint(
                    stepsize_controller=diffrax.ConstantStepSize()
                ),
                "stepsize_controller": PID,
            },
            "BacksolveAdjoint: stepsize_controller must be adaptive",
        ),
        ({"ts": jnp.array([0.5, 2.0])}, "ts must increase and lie between"),
        ({"ts": jnp.array([0.5, 0.2])}, "ts must increase and lie between"),
        ({"ts": jnp.array([0.5])}, "at least two times"),
        ({"controls": Told(), "hold": None, "dt": 0.25}, "controller without a state"),
        (
            {"controls": dlx.controllers.Zero(2), "dt": 0.25},
            r"Zero: the control must have shape \(1,\).*got shape \(2,\)",
        ),
        (
            {"controls": lambda t: jnp.zeros(3), "dt": 0.25, "hold": None},
            r"<lambda>: the control must have shape.*got shape \(3,\)",
        ),
    ],
)
def test_errors(change, words):
    arguments = dict(system=PENDULUM, controls=U, t0=0.0, t1=1.0, x0=X) | change
    positional = [arguments.pop(k) for k in ("system", "controls", "t0", "t1", "x0")]
    with user_error(match=words):
        dlx.simulate(*positional, **arguments)


@once
def test_traced_intervals_are_an_error():
    f = lambda dt: dlx.simulate(PENDULUM, FEEDBACK, 0.0, 1.0, X, dt=dt).final_state
    with user_error(match="must be known numbers, not traced ones"):
        jax.jit(f)(0.1)
