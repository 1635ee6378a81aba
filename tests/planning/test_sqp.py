"""Sequential quadratic programming: optima of others, the optimality conditions, hard
and soft limits, derivatives, and what must not go wrong."""

import re

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import assert_close, needs_x64, once, tolerance, user_error
from hypothesis import given, settings, strategies as st

import delucax as dlx


SQP, Constraints = dlx.planning.SQP, dlx.planning.Constraints
SoftConstraint = dlx.planning.SoftConstraint
GOAL = jnp.array([1.0, 0.0, 0.0, 0.0])


def steered(scale=1.0):
    """A point of unit mass in the plane."""
    dt = 0.2
    A = jnp.eye(4).at[0, 2].set(dt).at[1, 3].set(dt)
    B = jnp.zeros((4, 2)).at[2, 0].set(dt).at[3, 1].set(dt)
    cost = dlx.costs.Quadratic(0.01 * jnp.ones(4), 0.1 * jnp.ones(2))
    x0 = jnp.array([-1.0, 0.05, 0.0, 0.0])
    names = ("east", "north", "eastward", "northward")
    dynamics = dlx.LinearDynamics(A, scale * B, dt=dt, state_names=names)
    return dynamics, cost, x0, jnp.zeros((15, 2))


class Clear(eqx.Module):
    radius: jax.Array = dlx.parameter(0.4)

    def __call__(self, t, x, u):
        return self.radius**2 - x[0] ** 2 - x[1] ** 2


def arrived(t, x):
    return x - GOAL


def pendulum(horizon=20):
    dynamics = dlx.Discretized(dlx.systems.Pendulum(), dt=0.1)
    cost = dlx.costs.Quadratic([1.0, 0.1], [0.1], final=[20.0, 2.0])
    return dynamics, cost, jnp.array([1.0, 0.0]), jnp.zeros((horizon, 1))


@needs_x64
def test_past_an_obstacle_to_an_end():
    dynamics, cost, x0, U = steered()
    constraints = Constraints({"disc": Clear()}, final_equality=arrived)
    given = dict(bounds=(-2.5, 2.5), constraints=constraints)
    plan = SQP()(dynamics, cost, x0, U, **given)
    # SciPy's SLSQP is the reference of `ilqr` on this problem (test_constraints).
    other = dlx.planning.ilqr(dynamics, cost, x0, U, **given)
    assert_close(plan.cost, other.cost, rtol=1e-7)
    assert_close(plan.controls, other.controls, atol=1e-4)
    inside = jax.vmap(lambda x: Clear()(0.0, x, None))(plan.states[:-1])
    assert (
        jnp.max(inside) <= 1e-8 and jnp.max(jnp.abs(arrived(0, plan.states[-1]))) < 1e-8
    )
    assert_close(plan.states, dlx.open_loop(dynamics, x0, plan.controls), atol=1e-7)
    assert plan.violation < 1e-8 and plan.residual < 1e-6


@needs_x64
def test_without_constraints_it_is_ilqr():
    problem = pendulum()
    plan = SQP()(*problem)
    other = dlx.planning.ILQR(tolerance=1e-9, second_order=True)(*problem)
    assert_close(plan.cost, other.cost, rtol=1e-9)
    assert_close(plan.controls, other.controls, atol=1e-5)
    assert_close(plan.gains, other.gains, atol=1e-4)
    gauss = SQP(second_order=False)(*problem)
    assert_close(gauss.controls, other.controls, atol=1e-5)


@needs_x64
def test_limits_that_vary_in_time_and_the_feedback_about_them():
    dynamics, cost, x0, U = pendulum(10)
    slow = jnp.stack([jnp.full(11, jnp.inf), jnp.linspace(1.5, 0.5, 11)], axis=1)
    weak = jnp.linspace(6.0, 5.0, 10)[:, None]
    limits = Constraints(states=(-slow, jnp.inf), controls=(-weak, weak))
    solve = lambda x0: SQP()(dynamics, cost, x0, U, constraints=limits)
    plan = solve(x0)
    low = plan.states[1:, 1] + slow[1:, 1]
    assert jnp.min(low) > -1e-8 and jnp.min(low) < 1e-8
    assert jnp.all(jnp.abs(plan.controls) <= weak + 1e-8)
    free = SQP()(dynamics, cost, x0, U)
    assert jnp.min(free.states[1:, 1] + slow[1:, 1]) < -0.1
    # The gains are the derivative of the solution as long as the same limits hold.
    moved = jax.jacfwd(lambda x: solve(x).controls[0])(x0)
    assert_close(plan.gains[0], -moved, atol=1e-4)


@needs_x64
def test_a_soft_limit_costs_its_weights():
    dynamics, cost, x0, U = pendulum(10)
    fast = lambda t, x, u: -x[1] - 1.2
    soft = lambda *weights: Constraints({"speed": SoftConstraint(fast, *weights)})
    solve = lambda c: SQP()(dynamics, cost, x0, U, constraints=c)
    over = lambda plan: jax.vmap(lambda x: fast(0, x, 0))(plan.states[:-1])
    hard = solve(Constraints({"speed": fast}))
    # Above the multiplier of the hard limit the solution meets it, exactly.
    exact = solve(soft(1e3))
    assert_close(exact.controls, hard.controls, atol=1e-6)
    assert jnp.max(over(exact)) < 1e-8
    cheap = solve(soft(0.1, 0.5))
    t = jnp.maximum(over(cheap), 0)
    assert jnp.max(t) > 1e-2
    plain = lambda x, u: (
        jnp.sum(jax.vmap(cost)(jnp.zeros(10), x[:-1], u)) + cost.final(0, x[-1])
    )
    # The cost of the plan is that of the trajectory; the price is the user's to know.
    assert_close(cheap.cost, plain(cheap.states, cheap.controls), rtol=1e-12)

    def priced(u):
        x = dlx.open_loop(dynamics, x0, u)
        t = jnp.maximum(jax.vmap(lambda x: fast(0, x, 0))(x[:-1]), 0)
        return plain(x, u) + jnp.sum(0.1 * t + 0.25 * t**2)

    # Smooth there: some are well violated, the others well met.
    assert jnp.min(jnp.abs(over(cheap))) > 1e-3
    assert jnp.max(jnp.abs(jax.grad(priced)(cheap.controls))) < 1e-5


@needs_x64
def test_soft_bounds_of_states():
    dynamics, cost, x0, U = pendulum(10)
    limit = dlx.qp.Soft([-jnp.inf, -1.0], [jnp.inf, jnp.inf], 0.0, 1e6)
    plan = SQP()(dynamics, cost, x0, U, constraints=Constraints(states=limit))
    hard = Constraints(states=([-jnp.inf, -1.0], [jnp.inf, jnp.inf]))
    exact = SQP()(dynamics, cost, x0, U, constraints=hard)
    assert_close(plan.controls, exact.controls, atol=1e-3)
    assert -1.0 - 1e-3 < jnp.min(plan.states[:, 1]) < -1.0


@needs_x64
def test_hard_bounds_stay_hard_next_to_soft_limits():
    dynamics = dlx.LinearDynamics([[1.0, 1.0], [0.0, 1.0]], [[0.0], [1.0]])
    cost, x0 = dlx.costs.Quadratic([1.0, 1.0], [0.01]), jnp.array([10.0, 0.0])
    weights = jnp.linspace(0.01, 0.02, 20)[:, None]
    soft = Constraints(controls=dlx.qp.Soft(-0.5, 0.5, quadratic=weights))

    def solve(high):
        plan = SQP()(dynamics, cost, x0, 20, bounds=(-1.0, high), constraints=soft)
        return plan.cost, plan

    solved = jax.jit(jax.value_and_grad(solve, has_aux=True))
    (_, plan), slope = solved(1.0)
    u = plan.controls
    assert_close((jnp.min(u), jnp.max(u)), (-1.0, 1.0), atol=1e-8)

    def total(u):
        x, over = dlx.open_loop(dynamics, x0, u), jnp.maximum(jnp.abs(u) - 0.5, 0)
        each = jax.vmap(cost)(jnp.zeros(20), x[:-1], u)
        return jnp.sum(each) + cost.final(0, x[-1]) + jnp.sum(weights / 2 * over**2)

    # A step against the gradient leads nowhere within the bounds: the plan is optimal.
    step = jnp.clip(u - 0.1 * jax.grad(total)(u), -1.0, 1.0)
    assert_close(step, u, atol=1e-6)
    lower, upper = plan.multipliers.controls
    assert jnp.max(lower) > 1e-3 and jnp.max(upper) > 1e-3
    difference = (solved(1.0 + 1e-5)[0][0] - solved(1.0 - 1e-5)[0][0]) / 2e-5
    assert_close(slope, difference, rtol=1e-5)
    # The program of a real-time iteration is the whole problem, because it is linear.
    options = dict(bounds=(-1.0, 1.0), constraints=soft, real_time=True)
    mpc = dlx.controllers.MPC(dynamics, cost, 20, **options)
    assert_close(mpc(0.0, x0, mpc.init())[0], u[0], atol=1e-6)


@needs_x64
def test_derivatives_against_central_differences():
    def total(theta):
        scale, radius, bound, start = theta
        dynamics, cost, x0, U = steered(scale)
        plan = SQP(tolerance=1e-12)(
            dynamics,
            cost,
            start * x0,
            U,
            bounds=(-2.5 * bound, 2.5),
            constraints=Constraints({"disc": Clear(radius)}, final_equality=arrived),
        )
        weights = jnp.arange(4) + 1.0
        return plan.cost + jnp.sum(plan.states**2 * weights) + jnp.sum(plan.controls[3])

    theta = jnp.array([1.0, 0.4, 1.0, 1.0])
    slope = jax.grad(total)(theta)
    difference = lambda e: (total(theta + e) - total(theta - e)) / 2e-4
    found = jnp.stack([difference(e) for e in 1e-4 * jnp.eye(4)])
    assert_close(slope, found, rtol=3e-5, atol=1e-5)


@needs_x64
def test_the_first_state_and_the_bounds_of_states_are_differentiable():
    dynamics, cost, x0, U = pendulum(10)

    def last(x0, low):
        limits = Constraints(states=(jnp.array([-jnp.inf, low]), jnp.inf))
        return SQP()(dynamics, cost, x0, U, constraints=limits).states[-1]

    primal = x0, jnp.asarray(-1.2)
    change = jnp.array([0.3, -0.2]), jnp.asarray(0.5)
    moved = jax.jvp(last, primal, change)[1]
    at = lambda h: last(x0 + h * change[0], primal[1] + h * change[1])
    assert_close(moved, (at(1e-5) - at(-1e-5)) / 2e-5, rtol=1e-5, atol=1e-7)


@needs_x64
def test_what_cannot_hold_is_named():
    dynamics, cost, x0, U = steered()
    never = Constraints({"disc": Clear()}, final_equality={"goal": arrived})
    given = dict(bounds=(-0.1, 0.1), constraints=never)
    plan = SQP()(dynamics, cost, x0, U, throw=False, **given)
    assert plan.result == dlx.RESULTS.no_feasible_point and plan.violation > 1e-2
    with pytest.raises(RuntimeError, match=r"`goal` \(entry 0\) is violated by"):
        SQP()(dynamics, cost, x0, U, **given)
    # No derivative of what is no solution.
    f = lambda x0: SQP()(dynamics, cost, x0, U, throw=False, **given).cost
    assert jnp.all(jnp.isnan(jax.grad(f)(x0)))
    late = jnp.full((16, 4), jnp.inf).at[4:, 1].set(-2.0)
    for states, words in (
        (([0.5, -9, -9, -9], jnp.inf), r"lower bound of state 0 \(east\) .* stage 1"),
        ((-jnp.inf, late), r"upper bound of state 1 \(north\) .* at stage 4"),
    ):
        with pytest.raises(RuntimeError, match=f"The {words}"):
            limits = Constraints(states=states)
            SQP()(dynamics, cost, x0, U, bounds=(-1.0, 1.0), constraints=limits)


def test_what_cannot_hold_is_violated_as_little_as_possible():
    reactor = dlx.make("cstr", horizon=12)
    hot, low, high = jnp.array([0.6495, 352.0]), 280.0, 320.0
    limits = Constraints(states=(-jnp.inf, jnp.array([jnp.inf, 349.5])))
    given = dict(bounds=(low, high), constraints=limits, throw=False)
    plan = SQP()(reactor.dynamics, reactor.cost, hot, 12, **given)
    coldest = dlx.open_loop(reactor.dynamics, hot, jnp.full((12, 1), low))
    assert plan.result == dlx.RESULTS.no_feasible_point and plan.iterations < 25
    assert_close(plan.violation, jnp.max(coldest[1:, 1]) - 349.5, rtol=1e-3)


@needs_x64
def test_all_that_cannot_hold_together_is_named():
    dynamics, cost, x0, U = steered()

    def message(inequality=None, **given):
        limits = Constraints(inequality, **given)
        with pytest.raises(RuntimeError, match="constraints cannot all hold") as error:
            SQP()(dynamics, cost, x0, U, constraints=limits)
        return str(error.value)

    # No control changes the first position, and the bound of it takes others along.
    slow = {"up": lambda t, x, u: u[0] - 0.1, "down": lambda t, x, u: -u[0] - 0.1}
    given = dict(final_equality={"goal": arrived}, states=([-0.5, -9, -9, -9], 9.0))
    words = message(slow, **given)
    sizes = [float(size) for size in re.findall(r" by ([\d.]+) at ", words)]
    assert len(sizes) == 4 and sizes == sorted(sizes, reverse=True) and sizes[0] > 0.5
    assert "4 constraints are violated: the " in words
    assert "the lower bound of state 0 (east) by 0.5 at stage 1, the " in words
    # A soft constraint that is violated is not among them, and a single one is alone.
    slow = {name: SoftConstraint(limit, linear=1e-3) for name, limit in slow.items()}
    alone = "The lower bound of state 0 (east) is violated by 0.5 at stage 1. Pass"
    assert alone in message(slow, **given)
    # A long list is cut.
    equal = {f"c{i}": lambda t, x, u, i=i: u[0] - i for i in range(1, 8)}
    words = message(equality=equal)
    assert words.count("the constraint `c") == 4
    assert re.search(r", and \d more\. Any of them", words)


@needs_x64
def test_an_unstable_plant_from_controls_that_let_it_fall():
    env = dlx.make("cartpole", horizon=40)
    x0 = jnp.zeros(env.dynamics.state_size).at[0].set(0.5)
    limits = Constraints(states=(-2.0, 2.0))
    plan = SQP()(env.dynamics, env.cost, x0, jnp.full((40, 1), 0.3), constraints=limits)
    assert jnp.max(jnp.abs(plan.states[1:])) < 2 + 1e-8
    other = SQP()(env.dynamics, env.cost, x0, 40, constraints=limits)
    assert_close(plan.cost, other.cost, rtol=1e-8)


def test_jit_vmap_and_both_precisions():
    dynamics, cost, x0, U = pendulum(6)
    limits = Constraints(states=([-9.0, -1.5], [9.0, 9.0]))
    call = lambda x0: SQP()(dynamics, cost, x0, U, bounds=(-8, 8), constraints=limits)
    plan = call(x0)
    assert plan.controls.dtype == x0.dtype and plan.result == dlx.RESULTS.successful
    starts = jnp.stack([x0, 0.5 * x0])
    batch = eqx.filter_jit(eqx.filter_vmap(call))(starts)
    for start, row in zip(starts, batch.controls, strict=True):
        close = tolerance(2e-3, 1e-6)
        assert_close(call(start).controls, row, atol=close)


@jax.jit
def convex_plan(A, B, x0, low, directions):
    """The optimum, and the costs along directions inside the bounds."""
    steps, m = directions.shape[1:]
    dynamics = dlx.LinearDynamics(A, B, dt=0.1)
    cost = dlx.costs.Quadratic(jnp.ones(x0.size), jnp.full(m, 0.1))
    speed = SoftConstraint(lambda t, x, u: x[0] - 0.1, 0.2, 1.0)
    limits = dict(bounds=(low, 0.3), constraints=Constraints({"speed": speed}))
    plan = SQP()(dynamics, cost, x0, jnp.zeros((steps, m)), **limits)

    def total(u):
        x = dlx.open_loop(dynamics, x0, u)
        over = jnp.maximum(x[:-1, 0] - 0.1, 0)
        each = jax.vmap(cost)(jnp.zeros(steps), x[:-1], u)
        final = cost.final(0.0, x[-1])
        return jnp.sum(each) + final + jnp.sum(0.2 * over + 0.5 * over**2)

    moved = jnp.clip(plan.controls + 1e-3 * directions, low, 0.3)
    return total(plan.controls), jax.vmap(total)(moved)


@needs_x64
@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 10**6))
def test_a_convex_plan_is_its_quadratic_program(seed):
    draw = np.random.default_rng(seed)
    A, B = draw.normal(size=(3, 3)) / 1.5, draw.normal(size=(3, 2))
    x0, low = draw.normal(size=3), -0.2 - 0.3 * draw.random(2)
    best, others = convex_plan(A, B, x0, low, draw.normal(size=(20, 6, 2)))
    # Optimal is where no direction inside the bounds improves.
    assert jnp.min(others) >= best - 1e-9


@once
def test_bad_input():
    dynamics, cost, x0, U = pendulum(4)
    solve = lambda c: SQP()(dynamics, cost, x0, U, constraints=c)
    with user_error(match="Constraints: at least one"):
        Constraints()
    with user_error(match="states must be a pair"):
        Constraints(states=3.0)
    with user_error(match="SoftConstraint: linear"):
        SoftConstraint(lambda t, x, u: u, -1.0)
    with user_error(match=r"states.*shape"):
        solve(Constraints(states=(jnp.zeros(3), 1.0)))
    with user_error(match=r"limit must return a number or a vector"):
        solve(Constraints({"limit": lambda t, x, u: (x, u)}))
    for wrong in (lambda t, x, u: x[0] > 1, lambda t, x, u: jnp.ones((2, 3))):
        with user_error(match=r"limit must return a number or a vector"):
            solve(Constraints({"limit": wrong}))
    with user_error(match="limit fails when it is called"):
        solve(Constraints({"limit": lambda t, x, u: len(t)}))
    with user_error(match="entry 0 at stage 0 must be at least 9.0 and at most 8.0"):
        far = Constraints(controls=(9.0, 10.0))
        SQP()(dynamics, cost, x0, U, bounds=(-8.0, 8.0), constraints=far)
    with user_error(match="states must have low <= high"):
        solve(Constraints(states=(1.0, -1.0)))
    with user_error(match="SQP: max_iterations"):
        SQP(max_iterations=0)
    with user_error(match="SQP: states"):
        SQP(states=jnp.zeros((3, 2)))(dynamics, cost, x0, U)
    with user_error(match="soft|bounds"):
        soft = Constraints({"limit": SoftConstraint(lambda t, x, u: u, 1.0)})
        dlx.planning.ilqr(dynamics, cost, x0, U, constraints=soft)
    with pytest.raises(RuntimeError, match="`log` .* at stage 0"):
        solve(Constraints({"log": lambda t, x, u: jnp.log(-1 - x[0] ** 2)}))


@once
def test_what_a_transformation_outside_traces_is_refused():
    dynamics, cost, x0, U = pendulum(4)

    def f(limit):
        slow = Constraints({"slow": lambda t, x, u: x[1] - limit})
        return SQP()(dynamics, cost, x0, U, constraints=slow).cost

    with pytest.raises(ValueError, match="closes over"):
        jax.grad(f)(jnp.asarray(2.0))


@once
def test_adaptive_steps_need_forward_mode():
    """The error comes before anything is compiled, and names what helps."""
    steps = diffrax.PIDController(rtol=1e-3, atol=1e-3)
    adaptive = dict(solver=diffrax.Tsit5(), stepsize_controller=steps)
    plant = dlx.Discretized(dlx.systems.Pendulum(), dt=0.05, **adaptive)
    env = dlx.Environment(plant, dlx.costs.Quadratic([1.0, 1.0], [1.0]))
    record = dlx.training.sysid.Record(np.eye(9)[:, :2], np.eye(8)[:, :1], dt=0.05)
    problem = plant, env.cost, [1.0, 0.0], jnp.zeros((3, 1))
    gain, key = dlx.controllers.Linear(jnp.zeros((1, 2))), jax.random.key(0)
    run = dlx.rollout(env, gain, key=key, x0=[0.1, 0.0], horizon=2)
    for call in (
        lambda: dlx.controllers.best_in_hindsight(env, gain, run),
        lambda: dlx.planning.SQP()(*problem),
        lambda: dlx.planning.ILQR(second_order=True)(*problem),
        lambda: dlx.training.sysid.validate(plant, record),
        lambda: dlx.training.sysid.physical(plant, record, parameters="system.mass"),
    ):
        with user_error(match="stepsize_controller must .*DirectAdjoint"):
            call()
