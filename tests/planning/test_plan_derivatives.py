"""Derivatives of plans against finite differences, and what has none."""

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import (
    assert_close,
    assert_gradient,
    central_difference,
    ilqr,
    in_both_modes,
    needs_x64,
)
from jaxtyping import Array

import delucax as dlx


pytestmark = needs_x64
AT = jnp.array([1.0, 1.0, 1.3])


class Limit(eqx.Module):
    speed: Array

    def __call__(self, t, x, u):
        return jnp.stack([x[1] - self.speed, -x[1] - self.speed])


def outcomes(theta, horizon=12, speed=None, **options):
    """Of a pendulum of a mass, a cost weight and a first angle: the optimal cost, the
    first control, a gain and a state."""
    pendulum = dlx.systems.Pendulum(mass=theta[0])
    dynamics = dlx.Discretized(pendulum, dt=0.1, solver=diffrax.Euler())
    weights = jnp.stack([theta[1], jnp.array(0.1)]), jnp.array([0.1])
    cost = dlx.costs.Quadratic(*weights, final=jnp.array([20.0, 2.0]))
    x0 = jnp.stack([theta[2], 0 * theta[2]])
    if speed is not None:
        upright = lambda t, x: x[:1]
        options["constraints"] = dlx.planning.Constraints(
            Limit(speed), final_equality=upright
        )
        options["constraint_tolerance"] = 1e-10
    start = jnp.zeros((horizon, 1))
    options = dict(tolerance=1e-11, line_search="backtracking") | options
    plan = ilqr(dynamics, cost, x0, start, **options)
    found = plan.cost, plan.controls[0, 0], plan.gains[1, 0, 1], plan.states[-2, 0]
    return jnp.stack(found)


def check(f, at):
    both = jax.jit(in_both_modes(f))
    _, forward, reverse = both(at)
    for i, row in enumerate(reverse):
        expected = central_difference(lambda a, i=i: both(a)[0][i], at, step=1e-5)
        assert_close(row, expected, rtol=1e-5, atol=1e-6)
    assert_close(forward, reverse, rtol=1e-9, atol=1e-9)
    return reverse


def test_against_finite_differences():
    check(lambda theta: outcomes(theta, bounds=(-4.0, 4.0)), AT)


def check_gradient(f, at):
    """Of a number that all outcomes have a part in, backwards alone."""
    weights = jnp.array([1.0, -0.7, 0.4, 1.3])
    number = lambda a: weights @ f(a)
    return assert_gradient(number, at, step=1e-5, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize(
    "options",
    [
        dict(),
        dict(second_order=True),
        dict(parallel=True, horizon=2),
    ],
)
def test_gradients_of_other_ways(options):
    check_gradient(lambda theta: outcomes(theta, **options), AT)


def test_with_active_constraints():
    at = jnp.array([1.0, 1.0, 1.3, 1.6])
    gradient = check_gradient(lambda a: outcomes(a[:3], speed=a[3]), at)
    # The limit on the speed is felt.
    assert abs(gradient[3]) > 1


def test_of_bounds_disturbances_and_time_twice():
    dynamics = dlx.Discretized(dlx.systems.Pendulum(), 0.1, diffrax.Euler())
    reference = lambda t: jnp.stack([jnp.sin(t), jnp.cos(t)])
    cost = dlx.costs.Tracking([1.0, 0.1], [0.01], reference)

    def optimal(a):
        bounds, w = (-a[0], 2.0), a[1] * jnp.ones((10, 2))
        options = dict(t0=a[2], w=w, bounds=bounds, tolerance=1e-11)
        options["line_search"] = "backtracking"
        return ilqr(dynamics, cost, jnp.zeros(2), jnp.zeros((10, 1)), **options).cost

    at = jnp.array([2.5, 0.02, 1.5])

    way = np.array([1.0, -0.5, 0.7])
    both = jax.jit(lambda a: jax.jvp(jax.value_and_grad(optimal), (a,), (way,)))
    (_, gradient), (_, twice) = both(at)
    expected = central_difference(lambda a: both(a)[0][0], at, step=1e-5)
    assert_close(gradient, expected, rtol=1e-5, atol=1e-7)
    assert np.all(np.abs(expected) > 1e-3)
    high, low = (both(at + h * way)[0][1] for h in (1e-5, -1e-5))
    assert_close(twice, (high - low) / 2e-5, rtol=1e-5, atol=1e-5)


def test_it_does_not_depend_on_the_guess():
    dynamics = dlx.Discretized(dlx.systems.Pendulum(), 0.1, diffrax.Euler())
    cost = dlx.costs.Quadratic([1.0, 0.1], [0.1])

    def optimal(scale):
        start = scale * jnp.ones((8, 1))
        return ilqr(dynamics, cost, jnp.array([0.5, 0.0]), start).cost

    assert jax.jit(jax.grad(optimal))(1.0) == 0


def test_an_unconverged_plan_is_not_detached():
    def asked(theta, keep):
        options = dict(max_iterations=1, throw=False)
        found = outcomes(theta, **options)
        return jnp.sum(jnp.where(keep, found, 0)), found

    gradient = jax.jit(jax.grad(asked, has_aux=True))
    unknown, found = gradient(AT, True)
    assert jnp.all(jnp.isfinite(found)) and jnp.all(jnp.isnan(unknown))
    # What is masked is not asked for.
    masked, _ = gradient(AT, False)
    assert jnp.all(masked == 0)


def test_a_batch_with_a_failure():
    def total(mass, start, keep):
        theta = lambda angle: jnp.stack([mass, 0 * mass + 1, angle])
        plan = lambda angle: outcomes(theta(angle), throw=False)[0]
        return jnp.sum(jnp.where(keep, jax.vmap(plan)(start), 0))

    gradient = jax.jit(jax.grad(total))
    start, good = jnp.array([0.5, jnp.nan, 0.4]), jnp.array([True, False, True])
    expected = gradient(1.0, jnp.array([0.5, 0.5, 0.4]), good)
    assert_close(gradient(1.0, start, good), expected, rtol=1e-9)
    assert jnp.isnan(gradient(1.0, start, ~good))
