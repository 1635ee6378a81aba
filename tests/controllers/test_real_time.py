"""The real-time iteration of model predictive control."""

import jax
import jax.numpy as jnp
import numpy as np
from helpers import assert_close, needs_x64, once, tolerance, user_error

import delucax as dlx


MPC, SQP = dlx.controllers.MPC, dlx.planning.SQP
COST = dlx.costs.Quadratic([1.0, 0.1], [0.1], final=[20.0, 5.0])
SLOW = dlx.planning.Constraints(states=([-9.0, -1.0], [9.0, 1.0]))
X0 = jnp.array([0.3, 0.0])


def pendulum(dt=0.05):
    return dlx.make("pendulum", dt=dt)


def controller(dynamics=None, **options):
    dynamics = pendulum().dynamics if dynamics is None else dynamics
    given = dict(bounds=(-8.0, 8.0), constraints=SLOW, real_time=True)
    return MPC(dynamics, COST, 20, **(given | options))


def ran(mpc, x0=X0, horizon=30):
    return dlx.rollout(pendulum(), mpc, key=jax.random.key(0), x0=x0, horizon=horizon)


def test_it_is_exact_for_a_linear_plant():
    A, B = jnp.array([[1.0, 0.1], [0.2, 1.0]]), jnp.array([[0.0], [0.1]])
    plant = dlx.LinearDynamics(A, B, dt=0.1)
    x0 = jnp.array([1.5, 0.0])
    u, state = (mpc := controller(plant))(0.0, x0, mpc.init())
    plan = SQP()(plant, COST, x0, 20, bounds=(-8.0, 8.0), constraints=SLOW)
    assert_close(u, plan.controls[0], atol=tolerance(1e-3, 1e-7))
    assert state.result == dlx.RESULTS.successful


@needs_x64
def test_it_follows_the_converged_plans():
    one, whole = ran(controller()), ran(controller(real_time=False, planner=SQP()))
    assert_close(one.total_cost, whole.total_cost, rtol=1e-3)
    assert jnp.min(one.states[:, 1]) > -1
    assert not one.incident_counts["failed_plan"]


@needs_x64
def test_a_call_is_preparation_and_feedback():
    mpc = controller()
    state = mpc.prepare(0.0, mpc.init())
    u, state = mpc.feedback(0.0, X0, state)
    v, other = mpc(0.0, X0, mpc.init())
    assert_close(u, v, atol=tolerance(1e-5, 1e-9))
    assert 1 <= state.iterations == other.iterations <= 50


@needs_x64
def test_its_derivative():
    def cost(weight):
        other = dlx.costs.Quadratic([1.0, 0.1], weight, final=[20.0, 5.0])
        mpc = MPC(
            pendulum().dynamics,
            other,
            10,
            bounds=(-8.0, 8.0),
            constraints=SLOW,
            real_time=True,
        )
        return ran(mpc, horizon=4).total_cost

    at, eps = jnp.array([0.1]), 1e-5
    central = (cost(at + eps) - cost(at - eps)) / (2 * eps)
    assert_close(jax.grad(cost)(at)[0], central, rtol=1e-5)


@needs_x64
def test_a_batch():
    mpc = controller()
    starts = jnp.array([[0.3, 0.0], [-0.2, 0.1]])
    act = lambda x: mpc(0.0, x, mpc.init())[0]
    each = jnp.stack([act(x) for x in starts])
    assert_close(jax.vmap(act)(starts), each, atol=tolerance(1e-4, 1e-9))


# The second state is at most 1, and no control brings it from 9 to that in a step.
FAST = jnp.array([0.3, 9.0])


@needs_x64
def test_without_a_solution():
    u, state = (mpc := controller(throw=False))(0.0, FAST, mpc.init())
    # The last plan under its gains, within the bounds.
    assert jnp.isfinite(u).all() and jnp.abs(u) <= 8
    assert state.result == dlx.RESULTS.no_feasible_point and state.failures.count == 1
    u, state = mpc(0.05, X0, state)
    assert state.result == dlx.RESULTS.successful
    words = "MPC: The constraints cannot all hold.* there is no usable plan"
    with user_error(RuntimeError, match=f"^{words}"):
        (mpc := controller())(0.0, FAST, mpc.init())
    # A rollout is one program, and says the same without the lines of its compilation.
    with user_error(RuntimeError, match=f"^rollout: {words}.*incident_times"):
        dlx.rollout(pendulum(), controller(), key=jax.random.key(0), x0=FAST, horizon=3)


@once
def test_a_constraint_that_is_not_a_number():
    log = dlx.planning.Constraints({"log": lambda t, x, u: jnp.log(-1 + 0 * x[0])})
    mpc = controller(constraints=log, throw=False)
    _, state = mpc(0.0, X0, mpc.init())
    assert state.result == dlx.RESULTS.diverged and state.failures.count == 1


@needs_x64
def test_a_fallback():
    damper = dlx.controllers.Linear(jnp.array([[0.0, 0.5]]))
    mpc = controller(fallback=damper)
    u, state = mpc(0.0, FAST, mpc.init())
    assert state.failures.count == 1
    v, _ = damper(0.0, FAST, damper.init())
    assert_close(u, v)


@once
def test_wrong_use():
    with user_error(match="planner must be a `delucax.planning.SQP`"):
        controller(planner=dlx.planning.ILQR())
    with user_error(match="real_time must be True"):
        (mpc := controller(real_time=False, planner=dlx.planning.SQP())).prepare(
            0.0, mpc.init()
        )
    with user_error(match="state must be one that MPC.prepare returned"):
        (mpc := controller()).feedback(0.0, X0, mpc.init())
    with user_error(match="fallback"):
        controller(fallback=3.0)
    with user_error(match="max_qp_steps"):
        controller(max_qp_steps=0)


@once
def test_it_starts_from_the_multipliers_of_a_plan():
    plant, limits = pendulum().dynamics, dict(bounds=(-8.0, 8.0), constraints=SLOW)
    plan = SQP()(plant, COST, jnp.array([1.0, 0.0]), 20, throw=False, **limits)
    assert jnp.max(jnp.stack(plan.multipliers.states)) > 0
    mpc = controller(start=plan)
    for name in "states", "controls", "costates":
        given, kept = (
            getattr(m, name) for m in (plan.multipliers, mpc.init().last.multipliers)
        )
        jax.tree.map(assert_close, kept, given)
    # Those of another planner do not fit.
    slow = dlx.planning.Constraints({"slow": lambda t, x, u: x[1] - 1.0})
    other = dlx.planning.ILQR()(plant, COST, X0, 20, constraints=slow, throw=False)
    first = controller(start=other).init().last.multipliers
    assert all(not np.any(leaf) for leaf in jax.tree.leaves(first))
    own = MPC(plant, COST, 20, constraints=slow, start=other, throw=False)
    u, _ = own(0.0, X0, own.init())
    assert np.all(np.isfinite(u))
