"""Evaluations of the dynamics, counted; and linearisation by differences."""

import diffrax
import jax
import jax.numpy as jnp
from helpers import assert_close, needs_x64, once, user_error

import delucax as dlx
from delucax.planning import count_evaluations, Problem
from delucax.planning._lq import model


T = 30


def pendulum():
    dynamics = dlx.Discretized(dlx.systems.Pendulum(), 0.05, diffrax.Euler())
    cost = dlx.costs.Quadratic([1.0, 0.1], [0.1], final=[10.0, 1.0])
    return dynamics, cost, jnp.array([0.5, 0.0]), jnp.zeros((T, 1))


@needs_x64
def test_a_linearisation():
    """6 calls a knot by central differences; one, and a product for each state, by
    reverse mode."""
    dynamics, cost, x0, U = pendulum()
    X = dlx.open_loop(dynamics, x0, U)

    def slopes(spacing):
        def of(dynamics):
            nothing = (None,) * 5
            problem = Problem(dynamics, cost, x0, jnp.zeros(()), *nothing)
            return jax.jit(model, static_argnums=(4, 6))(
                problem, X, U, None, False, None, spacing
            ).F

        return of

    exact, by_autodiff = count_evaluations(slopes(None), dynamics)
    near, by_differences = count_evaluations(slopes(1e-2), dynamics)
    assert by_autodiff == (T, 0, 2 * T)
    assert by_differences == (6 * T, 0, 0)
    assert_close(near, exact, atol=1e-4)


@needs_x64
def test_a_whole_plan():
    """What the planner says of itself is what it did: each roll-out is T calls, and
    each iteration, and the last look, one linearisation."""
    dynamics, *rest = pendulum()
    solve = lambda **options: lambda d: dlx.planning.ILQR(**options)(d, *rest)
    exact, found = count_evaluations(solve(), dynamics)
    looks = int(exact.iterations) + 1
    assert found.primal == T * (int(exact.rollouts) + looks)
    assert found.tangent == 0 and found.cotangent == 2 * T * looks
    near, found = count_evaluations(solve(finite_difference=1e-2), dynamics)
    looks = int(near.iterations) + 1
    assert found == (T * (int(near.rollouts) + 6 * looks), 0, 0)
    assert near.result == dlx.RESULTS.successful
    assert_close(near.cost, exact.cost, rtol=1e-6)
    assert_close(near.controls, exact.controls, atol=1e-3)


@needs_x64
def test_modes_and_batches():
    dynamics = dlx.Discretized(dlx.systems.Pendulum(), 0.1, diffrax.Euler())
    x, u = jnp.ones(2), jnp.zeros(1)
    count = lambda f: count_evaluations(f, dynamics)[1]
    step = lambda d: lambda x: d.advance(0.0, x, u, None)[0]
    ways = jnp.eye(3, 2)
    assert count(lambda d: jax.jit(step(d))(x)) == (1, 0, 0)
    assert count(lambda d: jax.vmap(step(d))(ways)) == (3, 0, 0)
    assert count(lambda d: jax.jacfwd(step(d))(x)) == (1, 2, 0)
    assert count(lambda d: jax.jit(jax.jacrev(step(d)))(x)) == (1, 0, 2)
    assert count(lambda d: jax.vmap(jax.jacrev(step(d)))(ways)) == (3, 0, 6)
    assert count(lambda d: dlx.open_loop(d, x, jnp.zeros((5, 1)))) == (5, 0, 0)
    # What is counted is otherwise as it was.
    value, _ = count_evaluations(lambda d: d(0.0, x, u), dynamics)
    assert_close(value, dynamics(0.0, x, u))
    with user_error(match="dynamics must be an AbstractDynamics"):
        count_evaluations(lambda d: d, 3)
    with user_error(match="function must be a function"):
        count_evaluations(3, dynamics)


@needs_x64
def test_differences_and_second_order():
    with user_error(match="finite_difference is incompatible with second_order"):
        dlx.planning.ILQR(finite_difference=1e-2, second_order=True)
    with user_error(match="finite_difference must be positive"):
        dlx.planning.ILQR(finite_difference=0.0)


@once
def test_another_precision_than_that_of_the_session():
    with jax.enable_x64(True):
        spring = dlx.LinearDynamics(jnp.eye(2), jnp.ones((2, 1)))
        step = lambda dynamics: dynamics(0.0, jnp.full(2, 0.1), jnp.ones(1))
        found, evaluations = count_evaluations(step, spring)
        assert found.dtype == jnp.float64
        assert_close(found, [1.1, 1.1], rtol=1e-15)
    assert evaluations == (1, 0, 0)
