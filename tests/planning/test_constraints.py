"""State and general constraints, by the method of multipliers."""

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import assert_close, needs_x64, user_error

import delucax as dlx


pytestmark = needs_x64


ilqr = dlx.planning.ilqr
Constraints = dlx.planning.Constraints


def steered():
    """A point of unit mass in the plane, to be moved past an obstacle."""
    dt = 0.2
    A = jnp.eye(4).at[0, 2].set(dt).at[1, 3].set(dt)
    B = jnp.zeros((4, 2)).at[2, 0].set(dt).at[3, 1].set(dt)
    cost = dlx.costs.Quadratic(0.01 * jnp.ones(4), 0.1 * jnp.ones(2))
    x0 = jnp.array([-1.0, 0.05, 0.0, 0.0])
    return dlx.LinearDynamics(A, B, dt=dt), cost, x0, jnp.zeros((15, 2))


def clear(t, x, u):
    return 0.16 - x[0] ** 2 - x[1] ** 2


def arrived(t, x):
    return x - jnp.array([1.0, 0.0, 0.0, 0.0])


@needs_x64
def test_an_obstacle_and_an_end_against_scipy():
    optimize = pytest.importorskip("scipy.optimize")
    dynamics, cost, x0, U = steered()
    constraints = Constraints(clear, final_equality=arrived)
    plan = ilqr(dynamics, cost, x0, U, bounds=(-2.5, 2.5), constraints=constraints)
    inside = jax.vmap(lambda x: clear(0.0, x, None))(plan.states[:-1])
    assert jnp.max(inside) < 1e-6 and jnp.max(inside) > -1e-6
    assert jnp.max(jnp.abs(arrived(0.0, plan.states[-1]))) < 1e-6
    assert plan.residual < 1e-6 and plan.violation < 1e-6

    def terms(u):
        """The cost, how far the states are from the obstacle, and from the end."""
        x = dlx.open_loop(dynamics, x0, u.reshape(U.shape))
        total = jax.vmap(cost)(jnp.zeros(15), x[:-1], u.reshape(U.shape)).sum()
        away = -jax.vmap(lambda x: clear(0, x, 0))(x[:-1])
        found = jnp.concatenate([total[None], away, arrived(0, x[-1])])
        return found, found

    both = jax.jit(jax.jacfwd(terms, has_aux=True))
    values = lambda u, rows: np.asarray(both(u)[1])[rows]
    slopes = lambda u, rows: np.asarray(both(u)[0])[rows]
    away, end = dict(args=[slice(1, 16)]), dict(args=[slice(16, None)])
    near = np.asarray(plan.controls).ravel() + 0.01 * np.cos(np.arange(30.0))
    found = optimize.minimize(
        values,
        near,
        args=(0,),
        jac=slopes,
        bounds=[(-2.5, 2.5)] * 30,
        constraints=[
            dict(type="ineq", fun=values, jac=slopes, **away),
            dict(type="eq", fun=values, jac=slopes, **end),
        ],
        method="SLSQP",
        options=dict(ftol=1e-13, maxiter=500),
    )
    assert found.success
    assert_close(plan.cost, found.fun, rtol=1e-5)
    assert_close(plan.controls.ravel(), found.x, atol=1e-3)


def test_a_state_limit_costs_and_holds():
    dynamics = dlx.Discretized(dlx.systems.Pendulum(), 0.1, diffrax.Euler())
    cost = dlx.costs.Quadratic([1.0, 0.1], [0.1], final=[20.0, 2.0])
    start = jnp.array([1.3, 0.0]), jnp.zeros((12, 1))
    free = ilqr(dynamics, cost, *start)
    plan = ilqr(dynamics, cost, *start, constraints=slower_than(1.8))
    assert jnp.max(jnp.abs(free.states[:, 1])) > 1.9
    assert jnp.max(jnp.abs(plan.states[:-1, 1])) < 1.8 + 1e-6
    assert plan.cost > free.cost
    # A limit that is not met changes nothing.
    same = ilqr(dynamics, cost, *start, constraints=slower_than(1e3))
    assert_close(same.cost, free.cost, rtol=1e-12)


class Slower(eqx.Module):
    speed: jax.Array

    def __call__(self, t, x, u):
        return jnp.concatenate([x[1:] - self.speed, -x[1:] - self.speed])


def slower_than(speed):
    """And at the end below 100 rad."""
    return Constraints(Slower(jnp.asarray(speed)), final_inequality=_low)


def _low(t, x):
    return x[0] - 100.0


def test_the_first_penalty_changes_the_way_and_not_the_end():
    dynamics = dlx.Discretized(dlx.systems.Pendulum(), 0.1, diffrax.Euler())
    cost = dlx.costs.Quadratic([1.0, 0.1], [0.1], final=[20.0, 2.0])
    start = jnp.array([1.3, 0.0]), jnp.zeros((12, 1))
    plan = lambda **options: dlx.planning.ILQR(**options)(
        dynamics, cost, *start, constraints=slower_than(1.8)
    )
    usual, heavy = plan(), plan(penalty=1000.0)
    assert_close(heavy.cost, usual.cost, rtol=1e-6)
    assert heavy.iterations != usual.iterations
    with user_error(match="ILQR: penalty"):
        dlx.planning.ILQR(penalty=0.0)


def test_what_cannot_hold():
    dynamics, cost, x0, U = steered()
    never = Constraints(equality=lambda t, x, u: u[0] - 1, final_equality=arrived)
    plan = ilqr(dynamics, cost, x0, U, constraints=never, throw=False)
    assert plan.result == dlx.RESULTS.no_feasible_point and plan.violation > 1e-2
    assert all(jnp.all(jnp.isfinite(a)) for a in jax.tree.leaves(plan))
    with pytest.raises(RuntimeError, match="constraints cannot all hold"):
        ilqr(dynamics, cost, x0, U, constraints=never)


def test_bad_constraints_are_named():
    with user_error(match="at least one constraint"):
        Constraints()
    with user_error(match="inequality must be a function"):
        Constraints(3.0)
    short = lambda t, x: x[0]
    for wrong in (short, dlx.planning.SoftConstraint(short)):
        with user_error(match=r"inequality must be a function of \(t, x, u\), got"):
            Constraints(wrong)
    with user_error(match=r"final_equality must be a function of \(t, x\), got"):
        Constraints(final_equality=lambda t, x, u: x)
