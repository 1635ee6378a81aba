"""Model predictive control over every planner; learning online around a plan."""

import functools

import diffrax
import equinox as eqx
import hypothesis
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import assert_close, needs_x64, once, user_error
from hypothesis import settings, strategies as st

import delucax as dlx


MPC = dlx.controllers.MPC
KEY = jax.random.key(0)
A, B = jnp.array([[1.0, 0.1], [0.3, 0.98]]), jnp.array([[0.0], [0.1]])


def regulated(**options):
    dynamics = dlx.LinearDynamics(A, B, dt=0.1)
    Q, R = jnp.eye(2), 0.1 * jnp.eye(1)
    lqr = dlx.controllers.LQR(dynamics, Q, R)
    X = dlx.riccati.dare(A, B, Q, R).X
    cost = dlx.costs.Quadratic(Q, R, final=X)
    start = dict(initial_state=jnp.array([0.5, -0.3]), horizon=12)
    return dlx.Environment(dynamics, cost, **start, **options), lqr


@needs_x64
@pytest.mark.parametrize(
    "options",
    [
        {},
        {"planner": dlx.planning.ILQR(finite_difference=1e-2)},
    ],
)
def test_without_bounds_it_is_the_regulator(options):
    env, lqr = regulated(disturbance=dlx.disturbances.Gaussian(0.05, size=2))
    mpc = MPC(env.dynamics, env.cost, 5, **options)
    run, known = (dlx.rollout(env, c, key=KEY) for c in (mpc, lqr))
    assert_close(run.controls, known.controls, rtol=1e-3, atol=1e-5)


@needs_x64
def test_a_plan_starts_from_the_last_one():
    env, _ = regulated()
    mpc = MPC(env.dynamics, env.cost, 6, bounds=(-2.0, 2.0))
    step = jax.jit(lambda t, y, state: mpc(t, y, state))
    x, state = env.initial_state, mpc.init()
    for k in range(3):
        last = state.last
        plan = dlx.planning.ilqr(env.dynamics, env.cost, x, last, bounds=(-2.0, 2.0))
        u, state = step(0.1 * k, x, state)
        assert_close(u, plan.controls[0], atol=1e-9)
        later = jnp.concatenate([plan.controls[1:], plan.controls[-1:]])
        assert_close(state.last.controls, later, atol=1e-9)
        assert_close(state.last.states[:-1], plan.states[1:], atol=1e-9)
        assert_close(state.last.gains[:-1], plan.gains[1:], atol=1e-9)
        assert state.iterations <= plan.iterations and state.failures.count == 0
        x = env.dynamics(0.1 * k, x, u)
    # Where the model is right it does what it planned, and finds nothing to change.
    assert state.iterations <= 2


@once
@pytest.mark.parametrize(
    "kind, options",
    [
        ("ILQR", dict(max_iterations=5)),
        ("MPPI", dict(iterations=2, samples=64, temperature=0.1)),
        ("CEM", dict(iterations=3, samples=32, elites=8)),
    ],
)
def test_every_planner_balances(kind, options):
    env, _ = regulated()
    planner = getattr(dlx.planning, kind)(**options)
    mpc = MPC(env.dynamics, env.cost, 12, planner=planner, bounds=(-2.0, 2.0))
    held = dlx.rollout(env, mpc, key=KEY, horizon=40)
    fallen, x = 0.0, np.array([0.5, -0.3])
    for _ in range(40):
        fallen, x = fallen + x @ x, np.asarray(A) @ x
    assert held.total_cost < 0.2 * fallen
    assert np.all(np.abs(held.controls) <= 2)


class Tracked(dlx.AbstractCost):
    def __call__(self, t, x, u):
        return (x[0] - 0.1 * t) ** 2 + 1e-4 * u @ u


@needs_x64
def test_a_cost_that_depends_on_time():
    env, _ = regulated()
    env = dlx.Environment(env.dynamics, Tracked(), initial_state=jnp.zeros(2))
    run = dlx.rollout(env, MPC(env.dynamics, Tracked(), 8), key=KEY, horizon=40)
    assert_close(run.states[20:, 0], 0.1 * run.times[20:], atol=0.02)


def explosive():
    field = lambda t, x, u, w: jnp.stack([x[0] ** 3 + u[0]])
    system = dlx.system(field, states=("x",), controls=("u",))
    dynamics = dlx.Discretized(system, dt=0.5)
    return dynamics, dlx.costs.Quadratic([1.0], [1.0])


@needs_x64
def test_a_plan_that_fails_is_seen():
    dynamics, cost = explosive()
    mpc = MPC(dynamics, cost, 12, bounds=(-1.0, 1.0), throw=False)
    step = jax.jit(lambda y, state: mpc(0.0, y, state))
    u, state = step(jnp.array([0.1]), mpc.init())
    assert state.failures.count == 0 and state.result == dlx.RESULTS.successful
    last = state.last
    u, state = step(jnp.array([9.0]), state)
    assert state.failures.count == 1 and state.result == dlx.RESULTS.diverged
    # The last plan is followed, under its gains; after that the regulator.
    followed = last.controls[0] - last.gains[0] @ (9.0 - last.states[0])
    assert followed < -1
    assert_close(u, [-1.0])
    assert_close(state.last.controls, mpc.start.controls[0])
    assert jnp.all(state.last.gains == mpc.start.gains[0])
    assert jnp.all(state.last.gains > 0)
    u, state = step(jnp.array([4.0]), state)
    assert state.failures.count == 2 and u == -1
    u, state = step(jnp.array([jnp.nan]), state)
    assert state.failures.count == 3 and u == 0
    u, state = step(jnp.array([0.1]), state)
    assert state.failures.count == 3 and state.result == dlx.RESULTS.successful


@needs_x64
def test_a_plan_that_fails_is_an_error():
    dynamics, cost = explosive()
    mpc = MPC(dynamics, cost, 12, bounds=(-1.0, 1.0))
    with pytest.raises(Exception, match="NaN or infinite"):
        jax.block_until_ready(mpc(0.0, jnp.array([9.0]), mpc.init())[0])
    # Too few iterations are no failure of that kind, but are seen.
    short = MPC(dynamics, cost, 12, planner=dlx.planning.ILQR(1))
    _, state = short(0.0, jnp.array([0.2]), short.init())
    assert state.failures.count == 1 and state.result == dlx.RESULTS.not_converged


@once
def test_a_fallback_hears_what_was_applied():
    env, _ = regulated()
    pid = dlx.controllers.PID(1.0, 2.0, dt=0.1, output=0)
    mpc = MPC(env.dynamics, env.cost, 4, fallback=pid)
    y, u, cost = env.initial_state, jnp.array([0.2]), jnp.zeros(())
    (_, state), (_, alone) = (c(0.0, y, c.init()) for c in (mpc, pid))
    state, alone = mpc.applied(u, cost, state), pid.applied(u, cost, alone)
    assert_close(state.fallback.integral, alone.integral, rtol=1e-6)


def reactor():
    """A task, its LQR, and its cost with the LQR's cost to go."""
    env = dlx.make("cstr")
    x, u = env.dynamics.equilibrium()
    Q, R = jnp.diag(jnp.array([10.0, 0.01])), jnp.array([[0.01]])
    lqr = dlx.controllers.LQR(dlx.linearize(env.dynamics), Q, R)
    cost = dlx.costs.Quadratic(Q, R, final=lqr.P, state_target=x, control_target=u)
    return env, lqr, cost


@functools.cache
def first_costs():
    """Of a plan of MPC, and of a run of the LQR, from a state and after a last plan."""
    env, lqr, cost = reactor()
    mpc = MPC(env.dynamics, cost, 30, bounds=(280.0, 320.0))
    short = dlx.Environment(
        env.dynamics, cost, control_bounds=(280.0, 320.0), horizon=30
    )

    @jax.jit
    def costs(x0, controls):
        state = mpc.init()
        last = dlx.replace(state.last, {"controls": state.last.controls + controls})
        u, state = mpc(0.0, x0, state._replace(last=last))
        U = jnp.concatenate([u[None], state.last.controls[:-1]])
        followed = dlx.controllers.OpenLoop(U)
        run = lambda c: dlx.rollout(short, c, key=KEY, x0=x0).total_cost
        return run(followed), run(lqr), state.failures.count

    return costs


@once
def test_a_stall_at_rounding_is_no_failed_plan():
    """In single precision the temperatures are rounded to 3e-5 K. A stall at the kink
    of a cost, with more to gain than rounding, is a failed plan."""
    env, _, cost = reactor()
    env = dlx.Environment(env.dynamics, cost, control_bounds=(280.0, 320.0))
    mpc = MPC(env.dynamics, cost, 30, bounds=env.control_bounds, planner=LONG)
    run = dlx.rollout(env, mpc, key=KEY, x0=jnp.array([0.6495, 346.71]), horizon=20)
    assert run.states.dtype == jnp.float32
    assert run.incident_counts["failed_plan"] == 0
    kinked = dlx.make("pendulum")
    given = kinked.dynamics, kinked.cost, 30
    mpc = MPC(*given, bounds=kinked.control_bounds, planner=LONG)
    _, state = eqx.filter_jit(mpc)(0.0, jnp.array([1.0, 0.0]), mpc.init())
    assert state.failures.count == 1


LONG = dlx.planning.ILQR(50)


@needs_x64
@settings(max_examples=100, deadline=None)
@hypothesis.given(
    c=st.floats(0.3, 0.7),
    T=st.floats(342.0, 352.0),
    seed=st.integers(0, 2**31),
    scale=st.floats(0.0, 30.0),
)
def test_a_plan_costs_at_most_the_regulator(c, T, seed, scale):
    """From any state on an unstable plant, and after any last plan."""
    controls = scale * jax.random.normal(jax.random.key(seed), (30, 1))
    plan, regulated, _ = first_costs()(jnp.array([c, T]), controls)
    # An open loop of 30 steps adds to the rounding of the plan.
    assert plan <= regulated * (1 + 1e-9) + 1e-9


@needs_x64
def test_the_first_plan_on_an_unstable_plant():
    starts = (0.6495, 346.71), (0.6408, 349.82), (0.6035, 351.85)
    # IPOPT's optima, of `python -m benchmarks.reactor`.
    optima = 5.210338665957, 10.028732157678, 11.955587196360
    for x0, optimum in zip(starts, optima, strict=True):
        cost, _, failures = first_costs()(jnp.array(x0), jnp.zeros((30, 1)))
        assert_close(cost, optimum, atol=1e-8)
        assert failures == 0


@needs_x64
def test_a_start_of_ones_own():
    env, lqr, cost = reactor()
    given = env.dynamics, cost, 30
    x0 = jnp.array([0.6495, 346.71])
    held = jnp.tile(lqr.u_ref, (30, 1))
    law = dlx.planning.Start(
        held, jnp.tile(lqr.x_ref, (31, 1)), jnp.tile(lqr.K, (30, 1, 1))
    )
    act = eqx.filter_jit(lambda mpc: mpc(0.0, x0, mpc.init())[0])
    controls = {}
    for name, options in {
        "default": {},
        "other controls": dict(start=held + 5.0),
        "a law": dict(start=law),
        "alone": dict(start=dlx.planning.Start(held)),
    }.items():
        mpc = MPC(*given, bounds=(280.0, 320.0), throw=False, **options)
        controls[name] = np.asarray(act(mpc))
    for name in ("other controls", "a law"):
        assert_close(controls[name], controls["default"], atol=0.02)
    assert np.abs(controls["alone"] - controls["default"]) > 1
    assert MPC(*given, start=held + 5.0).start.controls[1, 0, 0] == held[0, 0] + 5


@once
def test_bad_arguments_are_named():
    env, _ = regulated()
    given = env.dynamics, env.cost
    with user_error(match="dynamics must be an AbstractDynamics.*Environment"):
        MPC(env, env.cost, 5)
    with user_error(match="cost must be an AbstractCost"):
        MPC(env.dynamics, lambda t, x, u: 0.0, 5)
    with user_error(match="horizon must be a whole number"):
        MPC(*given, 0)
    with user_error(match="constraints must be a Constraints"):
        MPC(*given, 5, constraints=lambda t, x, u: x)
    limits = dlx.planning.Constraints(states=(-1.0, 1.0))
    with user_error(match="MPC: planner must be a .*SQP.* got an ILQR"):
        MPC(*given, 5, constraints=limits)
    with user_error(match="planner must be an AbstractPlanner"):
        MPC(*given, 5, planner=3)
    with user_error(match="bounds must be numbers or have shape"):
        MPC(*given, 5, bounds=(-jnp.ones(2), jnp.ones(2)))
    with user_error(match="low <= high"):
        MPC(*given, 5, bounds=(1.0, -1.0))
    with user_error(match=r"start must have shape \(5, 1\)"):
        MPC(*given, 5, start=jnp.zeros((4, 1)))
    with user_error(match="start must have 5 steps, the horizon, got 4"):
        MPC(*given, 5, start=dlx.planning.Start(jnp.zeros((4, 1))))
    with user_error(match=r"start.controls must have shape \(5, 1\)"):
        MPC(*given, 5, start=dlx.planning.Start(jnp.zeros((5, 2))))
    with user_error(match="one random key"):
        MPC(*given, 5, planner=dlx.planning.CEM()).init()


@needs_x64
def test_learning_online_around_a_plan():
    """The gradient perturbation controller whose base is a plan: better than the plan
    alone where the plant is pushed as the plan did not foresee."""
    dynamics = dlx.Discretized(dlx.systems.Pendulum(), 0.05, diffrax.Euler())
    cost = dlx.costs.Quadratic([1.0, 0.1], [0.1])
    x0 = jnp.array([1.0, 0.0])
    plan = dlx.planning.ilqr(dynamics, cost, x0, jnp.zeros((150, 1)))
    learner = dlx.controllers.gpc(dynamics, cost, base=plan, memory=5, horizon=15)
    times = jnp.arange(150.0)
    shock = 0.2 * jnp.sin(times / (2 * jnp.pi))
    w = jnp.stack([0 * shock, jnp.where(times > 50, shock, 0)], axis=1)
    env = dlx.Environment(dynamics, cost, horizon=150)
    run = eqx.filter_jit(lambda c, w: dlx.rollout(env, c, key=KEY, x0=x0, w=w))
    alone, around = run(plan, w), run(learner, w)
    assert around.total_cost < 0.9 * alone.total_cost
    still = run(learner, 0 * w)
    assert_close(still.controls, plan.controls, atol=1e-8)
    np.testing.assert_allclose(still.total_cost, plan.cost, rtol=1e-9)


@once
def test_nothing_is_compiled_again(caplog):
    """Neither for the next step nor for a plan of other numbers."""
    dynamics = dlx.LinearDynamics(A, B, dt=0.1)
    cost = dlx.costs.Quadratic([1.0, 0.1], [0.1])
    mpc = dlx.controllers.MPC(dynamics, cost, 5, bounds=(-2.0, 2.0))
    x, y = jnp.array([0.1, 0.0]), jnp.array([0.2, 0.1])
    _, state = mpc(jnp.asarray(0.0), x, mpc.init())
    dlx.planning.ilqr(dynamics, cost, x, 5)
    with jax.log_compiles():
        mpc(jnp.asarray(0.1), y, state)
        dlx.planning.ilqr(dynamics, cost, y, 5)
    assert not [r for r in caplog.records if "Compiling" in r.getMessage()]
