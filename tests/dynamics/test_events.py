"""Hybrid systems: events are found, have exact derivatives, and never pass unseen."""

import dataclasses
import functools

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import assert_close, needs_x64, once, tolerance
from jaxtyping import Array
from scipy.integrate import solve_ivp

import delucax as dlx


s = dlx.systems
Q = dlx.RESULTS
NONE = jnp.zeros(1)


class Switch(s.AbstractHybridSystem):
    """`dx/dt = 1` until x, or the time, reaches `limit`; then as `after` says."""

    limit: Array = dlx.parameter(0.7)
    by_time: bool = False
    resets_state: bool = True

    state_names, control_names = ("x", "mode"), ("u",)
    event_names, event_directions = ("switch",), (1,)
    mode_names = ("before", "after")

    def vector_field(self, t, x, u, w):
        moving = (x[1] == 0) | self.resets_state
        return jnp.stack([jnp.where(moving, 1.0, 0.0), 0 * x[1]])

    def guards(self, t, x, u):
        return ((t if self.by_time else x[0]) - self.limit,)

    def enabled(self, t, x, u):
        return (x[1] == 0,)

    def resets(self, t, x, u):
        return (jnp.stack([0 * x[0] if self.resets_state else x[0], x[1] + 1]),)


class Ends(s.AbstractHybridSystem):
    """A point between two walls, and two guards that fire together at the right one."""

    state_names, control_names = ("x", "v"), ("u",)
    event_names = ("right", "also right", "left")

    def vector_field(self, t, x, u, w):
        return jnp.stack([x[1], u[0]])

    def guards(self, t, x, u):
        return 1 - x[0], 1 - x[0], x[0]

    def resets(self, t, x, u):
        return jnp.stack([x[0], -x[1]]), x + 100, jnp.stack([x[0], -0.5 * x[1]])


def final(system, x0, steps, dt, **options):
    dynamics = dlx.Discretized(system, dt=dt, **options)
    return dlx.open_loop(dynamics, x0, jnp.zeros((steps, 1)))[-1]


def ball(p, **fields):
    return s.BouncingBall(restitution=p[1], gravity=p[2], **fields)


def fall(p, *, count=10, steps=63, **options):
    """The last state after bounces, from (height, restitution, gravity)."""
    dt = end_of(count) / steps
    return final(ball(p), jnp.stack([p[0], 0 * p[0]]), steps, dt, **options)


def end_of(count):
    """A time between two bounces."""
    first = np.sqrt(2 * 1.0 / 9.81)
    flights = 2 * first * 0.85 ** np.arange(1, count + 1)
    return first + np.sum(flights[:-1]) + 0.4 * flights[-1]


def bounces(p, count):
    """The times of the bounces, in closed form."""
    first = jnp.sqrt(2 * p[0] / p[2])
    flights = 2 * first * p[1] ** jnp.arange(1, count)
    return first + jnp.concatenate([jnp.zeros(1), jnp.cumsum(flights)])


def fallen(p, count=10):
    """The same in closed form."""
    left, v = (
        end_of(count) - bounces(p, count)[-1],
        p[1] ** count * jnp.sqrt(2 * p[0] * p[2]),
    )
    return jnp.stack([v * left - p[2] * left**2 / 2, v - p[2] * left])


P = jnp.array([1.0, 0.85, 9.81])


@needs_x64
@pytest.mark.parametrize("substeps", [1, 3])
def test_ten_bounces_are_the_closed_form(substeps):
    run = functools.partial(fall, substeps=substeps)
    assert_close(run(P), fallen(P), atol=1e-12)
    expected = jax.jacfwd(fallen)(P)
    assert_close(jax.jit(jax.jacfwd(run))(P), expected, rtol=1e-8)
    assert_close(jax.jit(jax.jacrev(run))(P), expected, rtol=1e-8)


@needs_x64
def test_times_of_events_and_their_gradients():
    def recorded(p):
        dynamics = dlx.Discretized(ball(p), dt=end_of(10) / 8)
        env = dlx.Environment(dynamics, dlx.costs.Quadratic(jnp.eye(2), jnp.eye(1)))
        start = dict(x0=jnp.stack([p[0], 0 * p[0]]), horizon=8, keep="events")
        zero = dlx.controllers.Zero(1)
        return dlx.rollout(env, zero, key=jax.random.key(0), throw=False, **start)

    trajectory = recorded(P)
    listed = trajectory.event_list()
    assert {name for _, name in listed} == {"bounce"}
    times = np.array([time for time, _ in listed])
    assert len(times) == 10
    assert_close(times, bounces(P, 10), rtol=1e-12)
    rows, columns = np.nonzero(np.asarray(trajectory.events.kinds) == 0)
    J = jax.jacrev(lambda p: recorded(p).events.times[rows, columns])(P)
    assert_close(J, jax.jacfwd(lambda p: bounces(p, 10))(P), rtol=1e-8, atol=1e-10)
    falls = P[1] ** jnp.arange(10) * jnp.sqrt(2 * P[0] * P[2])
    before, after = (
        states[rows, columns]
        for states in (trajectory.events.before, trajectory.events.after)
    )
    expected = (
        jnp.stack([0 * falls, -falls], 1),
        jnp.stack([0 * falls, P[1] * falls], 1),
    )
    assert_close((before, after), expected, atol=1e-12)
    assert np.sum(np.isfinite(trajectory.events.before)) == 20
    with pytest.raises(ValueError, match="keep must hold .events."):
        _ = dataclasses.replace(trajectory, recorded_events=None).events


@needs_x64
def test_second_derivatives_are_those_of_the_closed_form():
    run, closed = (functools.partial(f, count=4) for f in (fall, fallen))
    H = jax.jit(jax.jacfwd(jax.jacrev(run)))(P)
    assert_close(H, jax.hessian(closed)(P), rtol=1e-8, atol=1e-8)


@needs_x64
def test_an_adaptive_solver_meets_its_tolerance():
    control = diffrax.PIDController(rtol=1e-9, atol=1e-11)
    options = dict(solver=diffrax.Tsit5(), stepsize_controller=control)
    run = functools.partial(fall, count=4, steps=3, **options)
    closed = functools.partial(fallen, count=4)
    assert_close(run(P), closed(P), atol=1e-8)
    J = jax.jit(jax.jacrev(run))(P)
    assert_close(J, jax.jacfwd(closed)(P), rtol=1e-6, atol=1e-6)


@needs_x64
def test_with_drag_a_step_has_its_order():
    """States and times of the third bounce converge with order 4, to another solver."""
    system = s.BouncingBall(drag=0.5, gravity=10.0)
    x, t, times = np.array([3.0, 0.0]), 0.0, []
    while t < 2.1:
        hits = lambda t, x: x[0] if t > 0 or x[1] < 0 else 1.0
        hits.terminal, hits.direction = True, -1
        field = lambda t, x: np.array([x[1], -10.0 - 0.5 * x[1] * abs(x[1])])
        solved = solve_ivp(field, (0, 2.1 - t), x, events=hits, rtol=1e-12, atol=1e-13)
        t, x = t + solved.t[-1], solved.y[:, -1]
        if solved.status == 1:
            times, x = [*times, t], np.array([0.0, -0.8 * x[1]])
    assert len(times) == 3
    errors = []
    for steps in (21, 42, 84):
        dynamics = dlx.Discretized(system, dt=2.1, substeps=steps)
        advance = eqx.filter_jit(dynamics.advance_with_events)
        x_next, result, events = advance(0.0, jnp.array([3.0, 0.0]), NONE, None)
        assert result == Q.successful
        errors.append([abs(events.times[2] - times[2]), np.abs(x_next - x).max()])
    orders = np.log2(np.array(errors[:-1]) / np.array(errors[1:]))
    assert np.all(orders[-1] > 3.5), errors


@needs_x64
def test_derivatives_that_other_libraries_were_reported_to_miss():
    # x runs at speed 1 and starts anew at the limit: x(1) = 1 - limit.
    x0 = jnp.zeros(2)
    anew = lambda limit: final(Switch(limit), x0, 4, 0.25)[0]
    assert_close(anew(0.7), 0.3, atol=1e-14)
    assert_close(jax.grad(anew)(0.7), -1.0, atol=1e-12)
    # x stops at a time: x(2) is that time, wherever it falls among the steps.
    stop = lambda limit: final(
        Switch(limit, by_time=True, resets_state=False), x0, 8, 0.25
    )[0]
    for limit in (0.98, 1.0):
        assert_close(stop(limit), limit, atol=1e-12)
        assert_close(jax.grad(stop)(limit), 1.0, atol=1e-12)
    # Without gravity a ball at -5 m/s bounces off without loss: 5 - height after 1 s.
    free = s.BouncingBall(gravity=0.0, restitution=1.0)
    height = lambda h: final(free, jnp.stack([h, -5.0 + 0 * h]), 20, 0.05)[0]
    h = jnp.linspace(2.9, 3.0, 41)
    assert_close(jax.vmap(height)(h), 5 - h, atol=1e-12)
    assert_close(jax.vmap(jax.grad(height))(h), -1.0, atol=1e-10)


@needs_x64
def test_modes_of_differentiation_agree():
    x0 = jnp.array([0.4, -1.0])
    system = s.BouncingBall(drag=0.3)
    run = lambda x: jnp.sum(final(system, x, 8, 0.1) ** 2)
    value, slope = jax.jit(jax.value_and_grad(run))(x0)
    along = jnp.array([0.3, -0.7])
    _, change = jax.jvp(run, (x0,), (along,))
    assert_close(change, slope @ along, rtol=1e-12)
    h = 1e-6
    apart = (run(x0 + h * along) - run(x0 - h * along)) / (2 * h)
    assert np.isfinite(value)
    assert_close(change, apart, rtol=1e-7)


def test_a_batch_is_a_loop():
    """Members with no event, one, and several, in values and gradients."""
    starts = jnp.array([[5.0, 0.0], [0.2, 0.0], [0.02, 0.1], [0.0, -3.0]])
    run = lambda x: final(s.BouncingBall(), x, 3, 0.15)
    both = jax.jit(lambda x: (run(x), jax.jacrev(run)(x)))
    each = [both(x) for x in starts]
    together = jax.jit(jax.vmap(both))(starts)
    for i, one in enumerate(each):
        for a, b in zip(one, together, strict=True):
            assert_close(a, b[i], **tolerance(dict(atol=2e-4), dict(atol=1e-11)))


@eqx.filter_jit
def _step_of(dynamics, x):
    return dynamics.advance_with_events(0.0, x, NONE, None)


def step_of(system, x, dt=0.1, **options):
    return _step_of(dlx.Discretized(system, dt=dt, **options), jnp.array(x))


def test_a_crossing_there_and_back_within_a_step_is_seen():
    x, result, events = step_of(s.BouncingBall(gravity=-10.0), [0.1, -1.5], dt=0.2)
    assert result == Q.successful
    assert_close(events.times[0], 0.1, atol=1e-6)
    assert_close(x[0], 0.09, atol=1e-6)


def test_guards_that_fire_together():
    """The first of the names fires, and the others are judged after its reset."""
    x, result, events = step_of(Ends(), [0.9, 2.0])
    assert result == Q.successful and list(events.kinds[:2]) == [0, -1]
    assert_close(x, [0.95 - 0.05 + 0.0, -2.0], atol=1e-6)


def test_a_state_on_a_guard_fires_at_once():
    x, result, events = step_of(s.BouncingBall(), [0.0, -2.0])
    assert result == Q.successful and float(events.times[0]) == 0.0
    assert x[0] > 0 and events.kinds[1] == -1


def test_a_state_beyond_a_guard_is_a_fault():
    _, result, events = step_of(s.BouncingBall(), [-0.1, -1.0])
    assert result == Q.beyond_guard
    assert events.fault_kind == 0 and events.fault_time == 0
    # Behind a guard that is not enabled there is none.
    _, result, _ = step_of(Switch(), [2.0, 1.0])
    assert result == Q.successful


def test_events_that_accumulate_leave_the_ball_on_the_floor():
    env = dlx.Environment(
        dlx.Discretized(s.BouncingBall(restitution=0.5), dt=0.5),
        dlx.costs.Quadratic(jnp.eye(2), jnp.eye(1)),
        horizon=4,
    )
    options = dict(key=jax.random.key(0), x0=[1.0, 0.0])
    options["keep"] = ("states", "costs", "events")
    zero = dlx.controllers.Zero(1)
    trajectory = dlx.rollout(env, zero, throw=False, **options)
    assert trajectory.result == Q.too_many_events
    assert_close(trajectory.states[3:], 0.0, atol=1e-3)
    with pytest.raises(RuntimeError, match=r"event bounce at t = 1\.35"):
        dlx.rollout(env, zero, **options)


@needs_x64
def test_a_grazing_has_a_status_and_no_derivative():
    # The top of a flight touches a ceiling.
    class Ceiling(Ends):
        def guards(self, t, x, u):
            return -x[0], 1 - x[0], 10 + x[0]

    given = jnp.array([-1.0])

    def run(x):
        dynamics = dlx.Discretized(Ceiling(), dt=0.5)
        return dynamics.advance(0.0, x, given, None)

    x = jnp.array([-0.03125 + 1.4e-17, 0.25])
    assert run(x)[1] == Q.grazing
    assert not np.any(np.isfinite(jax.jacfwd(lambda x: run(x)[0])(x)[0]))


def test_a_touch_in_single_precision_has_no_derivative():
    # A point that is thrown just up to a wall, which rounding puts it through or not.
    class Touch(Ends):
        def guards(self, t, x, u):
            return 1.25 - x[0], 10 + x[0], 10 + x[0]

        def resets(self, t, x, u):
            return (jnp.stack([x[0], -x[1]]),) * 3

    dynamics, push = dlx.Discretized(Touch(), dt=0.1), jnp.array([-10.0])

    def thrown(speed):
        def step(x, k):
            x, result, _ = dynamics.advance_with_events(0.1 * k, x, push, None)
            return x, result == Q.grazing

        x0 = jnp.stack([0 * speed, speed])
        x, grazes = jax.lax.scan(step, x0, jnp.arange(10))
        return x[0], jnp.any(grazes)

    speeds = jnp.sqrt(25 + 1e-6 * jnp.arange(-20.0, 21.0))
    slopes, grazes = jax.jit(jax.vmap(jax.grad(thrown, has_aux=True)))(speeds)
    assert np.all(np.isnan(slopes) == grazes)
    assert np.all(np.abs(slopes[~grazes]) < 1e4)
    assert np.any(grazes) or jax.config.jax_enable_x64


class Clock(s.AbstractHybridSystem):
    """It counts the upward crossings of a sine."""

    period: Array = dlx.parameter(0.3)

    state_names, control_names = ("count",), ("u",)
    event_names, event_directions = ("tick",), (1,)
    crossing_events = event_names

    def vector_field(self, t, x, u, w):
        return 0 * x

    def guards(self, t, x, u):
        return (jnp.sin(2 * jnp.pi * (t - 0.05) / self.period),)

    def resets(self, t, x, u):
        return (x + 1,)


@pytest.mark.parametrize(("period", "dt"), [(0.3, 0.1), (0.1, 0.05), (0.7, 0.02)])
def test_a_clock_ticks_once_a_period(period, dt):
    dynamics = dlx.Discretized(Clock(period=period), dt=dt)
    env = dlx.Environment(dynamics, dlx.costs.Quadratic([1.0], [1.0]))
    options = dict(key=jax.random.key(0), horizon=round(3 / dt), keep=("events",))
    run = dlx.rollout(env, dlx.controllers.Zero(1), x0=[0.0], **options)
    times = [time for time, _ in run.event_list()]
    assert_close(times, np.arange(0.05, 3.0, period), atol=tolerance(3e-6, 1e-12))


@once
def test_crossings_need_a_direction():
    class Both(Clock):
        event_directions = (0,)

    class Urgent(Clock):
        urgent_events = ("tick",)

    with pytest.raises(ValueError, match="crossing_events must be among .* direction"):
        Both()
    with pytest.raises(ValueError, match="'tick' must be in urgent_events or in"):
        Urgent()


def test_what_is_not_a_number_stays_one():
    x, result, _ = step_of(s.BouncingBall(), [np.nan, -1.0])
    assert np.isnan(x[0]) and result == Q.successful


@once
def test_modes():
    switch = Switch()
    assert switch.mode(jnp.array([0.3, 0.9999])) == 1
    assert step_of(switch, [0.0, 2.0])[1] == Q.unknown_mode
    with pytest.raises(ValueError, match="mode needs a system with mode_names"):
        s.BouncingBall().mode(jnp.zeros(2))


@once
def test_a_linear_model_sees_the_bounce():
    dynamics = dlx.Discretized(s.BouncingBall(), dt=0.05)
    model = dlx.linearize(dynamics, 0.0, jnp.array([0.05, -2.0]), NONE)
    assert_close(jnp.linalg.det(model.A), 0.8**2, rtol=1e-3)


@once
def test_wrappers_report_events():
    dynamics = dlx.Discretized(s.BouncingBall(), dt=0.2)
    late = dlx.dynamics.Delayed(dynamics, controls=1)
    x = late.filled(jnp.array([0.1, -1.0]))
    assert late.event_names == ("bounce",)
    _, _, events = late.advance_with_events(0.0, x, NONE, None)
    assert events.kinds[0] == 0


class Gate(s.AbstractHybridSystem):
    """A point that passes a gate before it is closed, and then meets a wall."""

    state_names, control_names = ("x",), ("u",)
    event_names = ("gate", "wall")

    def vector_field(self, t, x, u, w):
        return jnp.ones(1)

    def guards(self, t, x, u):
        return 0.3 - x[0], 0.8 - x[0]

    def enabled(self, t, x, u):
        return x[0] > 0.6, True

    def resets(self, t, x, u):
        return x, x - 5


@once
def test_a_guard_that_is_not_enabled_leaves_no_row_empty():
    x, _, events = step_of(Gate(), [0.0], dt=1.0)
    assert list(events.kinds[:2]) == [1, -1]
    assert_close(jnp.concatenate([events.times[:1], x]), [0.8, -4.0], atol=1e-6)
    assert_close(
        jnp.stack([events.before[0], events.after[0]]), [[0.8], [-4.2]], atol=1e-6
    )
    over = events.unless(jnp.asarray(True))
    assert np.all(over.kinds == -1) and np.all(np.isnan(over.after))


@once
def test_events_of_an_interval_whose_control_switches():
    """Two bounces, before and after the switch, are those of the whole interval."""
    dynamics = dlx.Discretized(s.BouncingBall(), dt=0.6)
    late = dlx.dynamics.TransportDelay(dynamics, controls=0.2)
    x = jnp.array([0.05, -1.0])
    x_next, _, expected = dynamics.advance_with_events(0.0, x, NONE, None)
    after, _, events = late.advance_with_events(0.0, late.filled(x), NONE, None)
    assert_close(after[:2], x_next, atol=1e-5)
    assert_close(events.kinds, expected.kinds)
    assert np.sum(events.kinds == 0) >= 2
    assert_close(events.times, expected.times, atol=1e-5)
    assert_close(events.after, expected.after, atol=1e-5)


@once
def test_bad_input():
    with pytest.raises(ValueError, match="max_events needs a system with events"):
        dlx.Discretized(s.Pendulum(), dt=0.1, max_events=3)
    with pytest.raises(ValueError, match="max_events"):
        dlx.Discretized(s.BouncingBall(), dt=0.1, max_events=0)
    with pytest.raises(ValueError, match="BacksolveAdjoint"):
        dlx.Discretized(
            s.BouncingBall(),
            dt=0.1,
            solver=diffrax.Tsit5(),
            stepsize_controller=diffrax.PIDController(rtol=1e-6, atol=1e-6),
            adjoint=diffrax.BacksolveAdjoint(),
        )
    with pytest.raises(ValueError, match="has events"):
        dlx.simulate(s.BouncingBall(), jnp.zeros((4, 1)), 0.0, 1.0, [1.0, 0.0])

    class Wrong(s.BouncingBall):
        def guards(self, t, x, u):
            return x[0], x[1]

    with pytest.raises(ValueError, match="guards must return a scalar for each of 1"):
        Wrong()

    class Sideways(s.BouncingBall):
        event_directions = (2,)

    with pytest.raises(ValueError, match="event_directions must be -1, 0 or 1"):
        Sideways()
    env = dlx.make("pendulum")
    with pytest.raises(ValueError, match="keep must not hold 'events'"):
        dlx.rollout(
            env, dlx.controllers.Zero(1), key=jax.random.key(0), keep=("events",)
        )
