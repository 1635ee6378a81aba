"""Lagrange multipliers of plans: sensitivities of the cost, and warm starts."""

import equinox as eqx
import jax
import jax.numpy as jnp
import pytest
from helpers import assert_close, needs_x64, user_error

import delucax as dlx


SQP, ILQR = dlx.planning.SQP, dlx.planning.ILQR
X0 = jnp.array([1.0, 0.0])


class Slow(eqx.Module):
    limit: jax.Array = dlx.parameter(0.8)

    def __call__(self, t, x, u):
        return -x[1] - self.limit


class Near(eqx.Module):
    goal: jax.Array = dlx.parameter(0.1)

    def __call__(self, t, x):
        return x[0] - self.goal


SLOW, NEAR = Slow(), Near()


def planned(planner, slow=SLOW, near=NEAR, x0=X0, start=20):
    dynamics = dlx.Discretized(dlx.systems.Pendulum(), dt=0.1)
    cost = dlx.costs.Quadratic([1.0, 0.1], [0.1], final=[20.0, 2.0])
    is_sqp = isinstance(planner, SQP)
    bounds = dict(states=(-4.0, 4.0), controls=(-6.0, 6.0)) if is_sqp else {}
    constraints = dlx.planning.Constraints(
        {"slow": slow}, final_equality={"near": near}, **bounds
    )
    given = dict(bounds=None if is_sqp else (-6.0, 6.0), constraints=constraints)
    return planner(dynamics, cost, x0, start, **given)


PRECISE = ILQR(tolerance=1e-11, constraint_tolerance=1e-10)


@needs_x64
@pytest.mark.parametrize("planner", [SQP(), PRECISE], ids=["sqp", "ilqr"])
def test_they_are_sensitivities_of_the_cost(planner):
    cost = lambda given: planned(planner, *given).cost
    by_limit, by_goal, by_start = eqx.filter_grad(cost)((Slow(), Near(), X0))
    multipliers = planned(planner).multipliers
    # The limit loosens the constraint, and so does a larger goal.
    assert_close(-jnp.sum(multipliers.stage["slow"]), by_limit.limit, rtol=1e-5)
    assert_close(-multipliers.final["near"][0], by_goal.goal, rtol=1e-5)
    assert jnp.min(multipliers.stage["slow"]) >= 0
    if isinstance(planner, SQP):
        assert_close(multipliers.costates[0], -by_start, rtol=1e-6)


@needs_x64
def test_those_of_bounds():
    plan = planned(SQP())
    lower, upper = plan.multipliers.controls
    assert lower.shape == upper.shape == (20, 1)
    assert jnp.min(lower) >= 0 and jnp.min(upper) >= 0 and jnp.max(lower) > 0
    assert jnp.all((plan.controls < -6 + 1e-3) | (lower < 1e-3))
    assert all(side.shape == (21, 2) for side in plan.multipliers.states)


@needs_x64
@pytest.mark.parametrize("planner", [SQP(), PRECISE], ids=["sqp", "ilqr"])
def test_their_derivative(planner):
    value = lambda a: planned(planner, Slow(a)).multipliers.final["near"][0]
    at, eps = jnp.asarray(0.8), 1e-4
    central = (value(at + eps) - value(at - eps)) / (2 * eps)
    assert_close(jax.grad(value)(at), central, rtol=1e-4)


@needs_x64
@pytest.mark.parametrize("planner", [SQP(), ILQR()], ids=["sqp", "ilqr"])
def test_a_plan_gives_its_multipliers_to_the_next(planner):
    plan, near = planned(planner), X0 + 1e-4
    without = dlx.planning.Start(plan.controls, plan.states, plan.gains)
    cold, warm = (planned(planner, x0=near, start=s) for s in (without, plan))
    assert warm.iterations <= cold.iterations and warm.iterations <= 3
    assert_close(warm.cost, cold.cost, rtol=1e-5)
    if isinstance(planner, ILQR):
        assert 3 * warm.iterations < cold.iterations


@needs_x64
def test_those_of_other_constraints_start_from_zero():
    plan = planned(SQP())
    other = lambda t, x, u: jnp.stack([-x[1] - 1.0, x[1] - 5.0])
    again = planned(SQP(), slow=other, start=plan)
    assert again.multipliers.stage["slow"].shape == (20, 2)


def test_a_name_stands_for_one_constraint():
    slow = {"slow": Slow()}
    with user_error(match=r"inequality and equality .* different names.*slow"):
        dlx.planning.Constraints(slow, slow)


@needs_x64
def test_weights_fit_their_constraint():
    soft = dlx.planning.SoftConstraint(Slow(), linear=jnp.ones(3))
    with user_error(
        match=r"slow must be numbers or have shape \(1,\), got shape \(3,\)"
    ):
        planned(SQP(), slow=soft)
