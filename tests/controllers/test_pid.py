import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import assert_close, once, tolerance, user_error

import delucax as dlx


PID, LeakyPID = dlx.controllers.PID, dlx.controllers.LeakyPID
DT = 0.1


def run_by_hand(controller, measured, applied=lambda u: u):
    """The controls for a sequence of measurements."""
    state, controls = controller.init(), []
    for k, y in enumerate(measured):
        u, state = controller(k * DT, jnp.atleast_1d(jnp.asarray(y, float)), state)
        state = controller.applied(applied(u), jnp.zeros(()), state)
        controls.append(np.asarray(u))
    return np.stack(controls)


def tank(bounds=None, horizon=400):
    """A leaky tank under a constant outflow, which only an integral can make up for."""

    def field(t, x, u, w):
        return u - x - 0.7

    system = dlx.system(field, states=("level",), controls=("inflow",))
    cost = dlx.costs.Quadratic(jnp.eye(1), jnp.eye(1))
    dynamics = dlx.Discretized(system, dt=DT)
    return dlx.Environment(dynamics, cost, control_bounds=bounds, horizon=horizon)


def test_each_term():
    y = [0.0, -1.0, -1.0, -3.0]
    e = -np.array(y)
    assert_close(run_by_hand(PID(2.0, dt=DT), y)[:, 0], 2 * e, rtol=1e-6)
    # The integral of what was seen before this step.
    integral = DT * np.concatenate([[0.0], np.cumsum(e)[:-1]])
    assert_close(run_by_hand(PID(0.0, 3.0, dt=DT), y)[:, 0], 3 * integral, rtol=1e-5)
    slope = np.concatenate([[0.0], np.diff(e)]) / DT
    bare = PID(0.0, kd=0.5, dt=DT, derivative_time_constant=0.0)
    assert_close(run_by_hand(bare, y)[:, 0], 0.5 * slope, rtol=1e-5)
    lag, filtered, expected = 0.3, 0.0, []
    for rise in slope * DT:
        filtered = (lag * filtered + rise) / (lag + DT)
        expected.append(0.5 * filtered)
    smooth = PID(0.0, kd=0.5, dt=DT, derivative_time_constant=lag)
    assert_close(run_by_hand(smooth, y)[:, 0], expected, rtol=1e-5)


def test_derivative_of_measurement_or_error():
    reference = lambda t: jnp.where(t > 0.05, 1.0, 0.0)
    options = dict(kd=1.0, dt=DT, reference=reference, derivative_time_constant=0.0)
    no_kick = run_by_hand(PID(0.0, **options), [0.0, 0.0, 0.0])
    assert_close(no_kick, np.zeros((3, 1)))
    kick = run_by_hand(PID(0.0, derivative_on="error", **options), [0.0, 0.0, 0.0])
    assert_close(kick[:, 0], [0.0, 1 / DT, 0.0], rtol=1e-5)


def test_integral_removes_the_offset(key):
    env, x0 = tank(), jnp.zeros(1)
    level = lambda pid: dlx.rollout(env, pid, key=key, x0=x0).final_state[0]
    assert_close(level(PID(2.0, 2.0, dt=DT, reference=1.5)), 1.5, atol=1e-4)
    # Without one: u = 2 (1.5 - x) = x + 0.7.
    assert_close(level(PID(2.0, dt=DT, reference=1.5)), 2.3 / 3, atol=1e-4)


@once
@pytest.mark.parametrize("whose", ["environment", "controller"])
def test_anti_windup(key, whose):
    # For 10 time units the reference is out of reach, then it is not.
    reference = lambda t: jnp.where(t < 10.0, 5.0, 1.0)
    bounds = (0.0, 2.0)
    env = tank(bounds if whose == "environment" else None, horizon=160)
    own = bounds if whose == "controller" else None

    def overshoot(**options):
        pid = PID(2.0, 2.0, dt=DT, reference=reference, bounds=own, **options)
        run = dlx.rollout(env, pid, key=key, x0=jnp.zeros(1))
        assert run.controls.min() >= 0 and run.controls.max() <= 2
        return jnp.sum(run.states[130:, 0] - 1.0) * DT

    # Back-calculation returns at once; next to none takes its time to unwind.
    assert abs(overshoot()) < 0.15
    assert overshoot(anti_windup_time=1e6) > 0.5


def test_back_calculation_arithmetic():
    # What was applied differs from what was asked by -3; T_a = 0.5.
    pid = PID(1.0, 2.0, dt=DT, anti_windup_time=0.5)
    controls = run_by_hand(pid, [-1.0, -1.0], applied=lambda u: u - 3.0)
    integral = 2.0 * DT * 1.0 + DT * (-3.0) / 0.5
    assert_close(controls[:, 0], [1.0, 1.0 + integral], rtol=1e-5)
    # By default T_a = kp / ki = 0.5 as well.
    again = run_by_hand(PID(1.0, 2.0, dt=DT), [-1.0, -1.0], lambda u: u - 3.0)
    assert_close(again, controls, rtol=1e-6)


@once
def test_scheduled_gains_hear_what_was_applied(key):
    make = lambda kp: PID(kp, 2.0, dt=DT, anti_windup_time=0.5)
    pids = dlx.controllers.Scheduled(eqx.filter_vmap(make)(jnp.array([1.0, 3.0])), DT)
    controls = run_by_hand(pids, 3 * [-1.0], applied=lambda u: u - 3.0)
    rise = DT * (2.0 - 3.0 / 0.5)
    assert_close(controls[:, 0], [1.0, 3.0 + rise, 3.0 + 2 * rise], rtol=1e-5)
    equal = dlx.controllers.Scheduled(eqx.filter_vmap(make)(jnp.ones(2)), DT)
    run = lambda pid: dlx.rollout(tank((0.9, 2.0), 20), pid, key=key, x0=jnp.zeros(1))
    assert_close(run(equal).states, run(make(1.0)).states, rtol=1e-5)


def test_no_integral_is_wound_by_saturation():
    for windup in (None, 0.5):
        pid = PID(4.0, dt=DT, bounds=(-1.0, 1.0), anti_windup_time=windup)
        controls = run_by_hand(pid, [-9.0, -9.0, -0.1])
        assert_close(controls[:, 0], [1.0, 1.0, 0.4], rtol=1e-5)


@once
def test_loops_and_outputs():
    y = jnp.array([1.0, 2.0, 3.0])
    u = lambda **options: PID(jnp.array([1.0, 10.0]), dt=DT, **options)
    act = lambda pid: pid(0.0, y, pid.init())[0]
    assert_close(act(u(output=(2, 0))), [-3.0, -10.0])
    C = jnp.array([[1.0, 1.0, 0.0], [0.0, 0.0, 2.0]])
    assert_close(act(u(output=C)), [-3.0, -60.0])
    assert_close(act(u(output=lambda y: y[1:] ** 2)), [-4.0, -90.0])
    assert_close(act(PID(2.0, dt=DT, output=1)), [-4.0])
    assert_close(act(PID(2.0, dt=DT, output=lambda y: y[1])), [-4.0])
    assert_close(act(u(output=(0, 1), reference=[1.0, 1.0])), [0.0, -10.0])
    assert_close(act(u(output=(0, 1), bounds=(-5.0, [5.0, 5.0]))), [-1.0, -5.0])
    assert_close(act(PID(1.0, dt=DT, output=(0, 1, 2))), [-1.0, -2.0, -3.0])


@once
def test_gains_are_weights(key):
    env = dlx.make("pendulum")
    pid = PID(25.0, 5.0, 5.0, dt=env.dt, output=0)
    loss = dlx.training.expected_cost(env, batch=2, horizon=10)
    _, gradient = dlx.training.analytic(loss, pid, key)
    names = ("kp", "ki", "kd", "dt")
    moved = {name for name in names if getattr(gradient, name) is not None}
    assert moved == {"kp", "ki", "kd"}


def test_leaky_pid_arithmetic():
    e = np.array([1.0, 3.0, -2.0, 0.5])
    a = DT / (DT + 0.5)
    P = I = D = 0.0
    expected = []
    for error in e:
        I += a * (error - I)
        D += a * (error - P - D)
        P = error
        expected.append(3 * P + 4 * I + 2 * D)
    leaky = LeakyPID(3.0, 4.0, 2.0, dt=DT)
    assert_close(run_by_hand(leaky, -e)[:, 0], expected, rtol=1e-5)
    held = LeakyPID(3.0, 4.0, 2.0, dt=DT, bounds=(-1.0, 5.0))
    assert_close(run_by_hand(held, -e)[:, 0], np.clip(expected, -1, 5), rtol=1e-5)


def test_leaky_pid_on_the_original_lung():
    # The published total of the original's balloon lung, both valves under LeakyPID.
    dt = 0.03
    pid = LeakyPID(dt=dt)

    def pressure(volume):
        r, r0 = ((3 * v / (4 * np.pi)) ** (1 / 3) for v in (volume, 1.5))
        return 40 * (1 - (r0 / r) ** 6) / (r0**2 * r)

    def lung(volume, before, u_in, u_out):
        flow = np.clip(np.tanh(0.03 * (3 * u_in - 130)) + 1, 0, 1.72)
        flow = np.clip(15 * flow, 0, 2)
        if before > 5 and u_out > 0:
            flow -= 0.05 * before
        volume += flow * dt
        return volume, pressure(volume)

    volume, p = lung(1.5, -1.0, 0.0, 0.0)
    assert_close(p, 0.054874, rtol=1e-4)
    state, target, total, time = (pid.init(), pid.init()), 5.0, 0.0, 0.0
    for _ in range(10):
        y = jnp.array([p - target])
        controls, states = zip(*(pid(time, y, s) for s in state), strict=True)
        state = states
        target = np.interp(time, [0, 1e-8, 1, 1.5, 3], [5, 35, 35, 5, 5])
        total -= abs(target - p)
        volume, p = lung(volume, p, float(controls[0][0]), float(controls[1][0]))
        time += dt
    assert_close(total, -170.7004493227582, rtol=tolerance(1e-6, 1e-12))


@once
@pytest.mark.parametrize("kind", [PID, LeakyPID])
def test_wrong_arguments(kind):
    with user_error(match="one entry per loop; got kp of size 2, kd of size 3"):
        kind(jnp.ones(2), 0.0, jnp.ones(3), dt=DT)
    with user_error(match="one entry per loop.*output of size 1"):
        kind(jnp.ones(2), dt=DT, output=0)
    with user_error(match="kp must be a number or a vector"):
        kind(jnp.ones((2, 2)), dt=DT)
    with user_error(match="kp must be finite"):
        kind(np.nan, dt=DT)
    with user_error(match="dt must be positive"):
        kind(1.0, dt=0.0)
    with user_error(match="bounds must have low <= high"):
        kind(1.0, dt=DT, bounds=(1.0, -1.0))
    with user_error(match="bounds must be a pair"):
        kind(1.0, dt=DT, bounds=2.0)
    with user_error(match="bounds must be numbers or vectors of the same size"):
        kind(1.0, dt=DT, bounds=(jnp.zeros(2), jnp.ones(3)))
    with user_error(match="output must be an index from 0.*got .-1,"):
        kind(1.0, dt=DT, output=-1)
    y = jnp.zeros(2)
    with user_error(match=r"outputs must be 1.*observation has shape \(2,\).*output=0"):
        pid = kind(1.0, dt=DT)
        pid(0.0, y, pid.init())
    with user_error(match="selects component 2, but the observation has size 2"):
        pid = kind(1.0, dt=DT, output=2)
        pid(0.0, y, pid.init())
    with user_error(match="observation must have size 3, got size 2"):
        pid = kind(1.0, dt=DT, output=jnp.ones((1, 3)))
        pid(0.0, y, pid.init())
    with user_error(match=r"reference must have an entry for each of 1 loops.*\(2,\)"):
        pid = kind(1.0, dt=DT, output=0, reference=lambda t: jnp.zeros(2))
        pid(0.0, y, pid.init())


@once
def test_wrong_times():
    with user_error(match="derivative_time_constant must be at least 0, got -1"):
        PID(1.0, dt=DT, derivative_time_constant=-1.0)
    with user_error(match="anti_windup_time must be at least 0.1.*, got 0.01"):
        PID(1.0, 1.0, dt=DT, anti_windup_time=0.01)
    with user_error(match="derivative_on must be .* got 'state'"):
        PID(1.0, dt=DT, derivative_on="state")
    with user_error(match="time_constant must be positive"):
        LeakyPID(dt=DT, time_constant=0.0)


def test_made_inside_jit():
    @eqx.filter_jit
    @jax.vmap
    def first(kp):
        pid = PID(kp, 1.0, dt=DT, output=0)
        return pid(0.0, jnp.array([1.0, 0.0]), pid.init())[0]

    assert_close(first(jnp.array([1.0, 2.0])), [[-1.0], [-2.0]])
