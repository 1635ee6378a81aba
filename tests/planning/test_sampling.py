"""Planners that sample."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import assert_close, needs_x64, once, user_error

import delucax as dlx


KEY = jax.random.key(0)
X0 = jnp.array([0.5, -0.3])
MPPI, CEM = dlx.planning.MPPI, dlx.planning.CEM
PLANNERS = {"mppi": (MPPI, dict(temperature=0.01)), "cem": (CEM, dict())}


def planned(kind, *problem, key=KEY, bounds=None, throw=True, **options):
    return kind(**options)(*problem, bounds=bounds, key=key, throw=throw)


def linear():
    A, B = jnp.array([[1.0, 0.1], [0.3, 0.98]]), jnp.array([[0.0], [0.1]])
    cost = dlx.costs.Quadratic(jnp.eye(2), 0.1 * jnp.eye(1), final=jnp.eye(2))
    return dlx.LinearDynamics(A, B, dt=0.1), cost, X0, jnp.zeros((8, 1))


@needs_x64
@pytest.mark.parametrize(
    "planner, options",
    [PLANNERS["mppi"], PLANNERS["cem"]],
    ids=list(PLANNERS),
)
def test_the_minimum_of_a_linear_problem(planner, options):
    problem = linear()
    best = dlx.planning.ilqr(*problem)
    plan = planned(planner, *problem, iterations=20, **options)
    assert best.cost - 1e-5 <= plan.cost < 1.02 * best.cost < plan.trace[0]
    assert plan.result == dlx.RESULTS.successful and jnp.all(plan.gains == 0)
    assert plan.rollouts == 20 * 256 + 1 and plan.trace.shape == (21,)
    assert jnp.all(jnp.diff(plan.trace) <= 0) and plan.trace[-1] == plan.cost
    followed = dlx.open_loop(problem[0], X0, plan.controls)
    assert_close(followed, plan.states, atol=1e-12)
    # A warm start goes on; other keys draw others.
    options = options | dict(iterations=20)
    warm = planned(planner, *problem[:3], plan.controls, **options)
    assert_close(warm.trace[0], plan.cost, rtol=1e-14)
    assert warm.cost <= warm.trace[0]
    other = planned(planner, *problem, key=jax.random.key(1), **options)
    assert other.cost != plan.cost


class Cliff(dlx.AbstractCost):
    """Neither smooth nor finite everywhere."""

    def __call__(self, t, x, u):
        return jnp.where(u[0] > 0.5, jnp.nan, jnp.abs(jnp.round(4 * u[0]) - 1))


@once
@pytest.mark.parametrize(
    "planner, options",
    [PLANNERS["mppi"], PLANNERS["cem"]],
    ids=list(PLANNERS),
)
def test_what_diverges_has_no_part_in_it(planner, options):
    dynamics, _, x0, U = linear()
    plan = planned(planner, dynamics, Cliff(), x0, U, scale=0.2, **options)
    assert jnp.all(jnp.isfinite(plan.controls)) and jnp.all(plan.controls <= 0.5)
    assert 0 <= plan.cost < 8 == plan.trace[0]
    cost = lambda x: planned(planner, dynamics, Cliff(), x, U).cost
    assert jnp.all(jnp.isfinite(jax.jit(jax.grad(cost))(x0)))
    start = dict(scale=1e-3, **options)
    lost = planned(planner, dynamics, Cliff(), x0, U + 1, throw=False, **start)
    assert lost.result == dlx.RESULTS.diverged and jnp.isinf(lost.cost)
    assert_close(lost.controls, U + 1)
    spare = dlx.planning.Start(U, jnp.ones((9, 2)), jnp.ones((8, 1, 2)))
    held = planner(**start)(
        dynamics, Cliff(), x0, U + 1, key=KEY, fallback=spare, throw=False
    )
    assert held.result == dlx.RESULTS.diverged and not held.is_usable
    for name in ("states", "controls", "gains"):
        assert_close(getattr(held, name), getattr(spare, name))
    with pytest.raises(RuntimeError, match="NaN or infinite"):
        planned(planner, dynamics, Cliff(), x0, U + 1, **start)


@needs_x64
@pytest.mark.parametrize(
    "planner, options",
    [PLANNERS["mppi"], PLANNERS["cem"]],
    ids=list(PLANNERS),
)
def test_bounds_batches_and_derivatives(planner, options):
    dynamics, cost, _, U = linear()
    options = options | dict(bounds=(-0.2, [0.3]), correlation=0.5, samples=64)

    def optimal(x, key):
        plan = planned(planner, dynamics, cost, x, U, key=key, **options)
        return plan.cost, plan.controls

    keys = jax.random.split(KEY, 2)
    starts = jnp.stack([X0, -2 * X0])
    steps = 1e-6 * np.concatenate([np.eye(2), -np.eye(2)])
    starts = jnp.concatenate([starts, X0 + steps])
    keys = keys[jnp.array([0, 1, 0, 0, 0, 0])]
    both = jax.jit(jax.vmap(jax.value_and_grad(optimal, has_aux=True)))
    (costs, controls), slopes = both(starts, keys)
    assert jnp.all((controls >= -0.2) & (controls <= 0.3))
    assert jnp.min(controls) < -0.18 and jnp.max(controls) > 0.28
    if planner is MPPI:
        assert_close(costs[1], optimal(starts[1], keys[1])[0], rtol=1e-12)
    assert_close(slopes[0], (costs[2:4] - costs[4:]) / 2e-6, rtol=1e-8)


@once
def test_bad_arguments_are_named():
    problem = linear()
    for name, options in {
        "samples": dict(samples=1),
        "iterations": dict(iterations=0),
        "scale must be positive": dict(scale=0.0),
        "scale must be a number or have shape .1,": dict(scale=[1.0, 2.0]),
        "correlation": dict(correlation=1.5),
        "temperature": dict(temperature=0.0),
        "one random key": dict(key=3),
    }.items():
        with user_error(match=f"MPPI: .*{name}"):
            planned(MPPI, *problem, **options)
    for name, wrong in (("elites", 300), ("momentum", 2.0)):
        with user_error(match=f"CEM: {name}"):
            CEM(**{name: wrong})
    limit = dlx.planning.Constraints(lambda t, x, u: x[0])
    with user_error(match="CEM: constraints must be None"):
        CEM()(*problem, key=KEY, constraints=limit)


@once
def test_samples_that_diverge_leave_the_gradient_finite():
    def field(t, x, u, w):
        return x**3 + u

    plant = dlx.Discretized(dlx.system(field, states=("x",), controls=("u",)), dt=0.5)
    cost = dlx.costs.Quadratic([1.0], [1.0])
    planner = dlx.planning.MPPI(scale=3.0)

    def optimum(x0):
        given = plant, cost, x0, jnp.zeros((12, 1))
        return planner(*given, key=jax.random.key(0)).cost

    x0 = jnp.array([0.1])
    backward, forward = (jax.jit(d(optimum))(x0) for d in (jax.grad, jax.jacfwd))
    assert np.all(np.isfinite(backward))
    assert_close(backward, forward, rtol=1e-3)
