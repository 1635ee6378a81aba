"""Derivatives at the active set."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import assert_close, central_difference, in_both_modes, needs_x64
from jax.flatten_util import ravel_pytree

import delucax as dlx


def staged(parts):
    """A number of a staged solution, with active, soft and equal bounds."""
    p = parts
    rows = dlx.qp.Rows(
        p["C"], lower=p["lower"], upper=p["upper"], linear=p["v"], quadratic=p["W"]
    )
    problem = dlx.qp.Staged(
        p["A"],
        p["B"],
        p["Q"] @ p["Q"].T,
        p["R"] @ p["R"].T,
        d=p["d"],
        q=p["q"],
        r=p["r"],
        final=p["Q"] @ p["Q"].T,
        start=p["start"],
        horizon=5,
        controls=(p["low"], p["high"]),
        rows=rows,
        final_rows=dlx.qp.Rows(p["C"], lower=p["end"], upper=p["end"]),
    )
    s = dlx.qp.solve(problem, rtol=1e-10, atol=1e-10, throw=False)
    weigh = lambda a: jnp.sum(
        a * jnp.cos(jnp.arange(a.size, dtype=a.dtype)).reshape(a.shape)
    )
    y = s.multipliers
    found = s.x, s.u, y.costates, *y.controls, *y.rows
    return sum(map(weigh, found)) + s.cost


def parts():
    rng = np.random.default_rng(5)
    draw = rng.standard_normal
    return dict(
        A=np.eye(2) + 0.2 * draw((2, 2)),
        B=draw((2, 2)),
        Q=draw((2, 2)),
        R=np.eye(2) + 0.1 * draw((2, 2)),
        d=0.3 * draw(2),
        q=draw(2),
        r=draw(2),
        start=np.array([1.5, -1.0]),
        low=np.array([-0.6, -0.7]),
        high=np.array([0.5, 0.4]),
        C=np.array([[1.0, 0.5]]),
        lower=np.array([-0.4]),
        upper=np.array([0.3]),
        v=np.array([0.1]),
        W=np.array([2.0]),
        end=np.array([0.1]),
    )


@needs_x64
def test_gradients_are_central_differences_in_every_array():
    flat, apart = ravel_pytree(parts())
    value = jax.jit(jax.value_and_grad(lambda flat: staged(apart(flat))))
    _, gradient = value(flat)
    expected = central_difference(lambda x: value(x)[0], flat, 1e-5)
    assert_close(gradient, expected, rtol=1e-5, atol=1e-5)
    forward = jax.jit(
        lambda t: jax.jvp(lambda flat: staged(apart(flat)), (flat,), (t,))
    )
    direction = np.cos(np.arange(len(flat)))
    assert_close(forward(direction)[1], gradient @ direction, rtol=1e-8)


def dense(P, q, **options):
    return dlx.qp.solve(dlx.qp.Dense(P, q, **options), throw=False).x


@needs_x64
def test_dense_derivatives_in_both_modes():
    rng = np.random.default_rng(2)
    root, q, G = (rng.standard_normal(shape) for shape in ((5, 5), 5, (4, 5)))
    E, b = rng.standard_normal((1, 5)), np.ones(1)

    def solution(upper):
        rows = dlx.qp.Rows(G, upper=upper)
        options = dict(rows=rows, equalities=(E, b), bounds=(-1.0, np.inf))
        return dense(root @ root.T, 3 * q, **options)

    upper = 0.1 * rng.standard_normal(4)
    both = jax.jit(in_both_modes(solution))
    _, forward, backward = both(upper)
    assert_close(backward, forward, atol=1e-9)
    expected = [
        np.asarray(both(upper + h)[0] - both(upper - h)[0]) / 2e-5
        for h in 1e-5 * np.eye(4)
    ]
    assert np.abs(forward).max() > 0.1
    assert_close(forward, np.array(expected).T, atol=2e-5)


@needs_x64
def test_second_derivatives():
    def value(q):
        return jnp.sum(dense(jnp.diag(1 + q**2), q, bounds=(0.0, 10.0)) ** 3)

    def slope(q):
        gradient = jax.grad(value)(q)
        return gradient, gradient

    q = np.array([-1.0, -2.0])
    both = jax.jit(jax.jacfwd(slope, has_aux=True))
    hessian, _ = both(q)
    gradient = lambda q: np.asarray(both(q)[1])
    expected = [(gradient(q + h) - gradient(q - h)) / 2e-4 for h in 1e-4 * np.eye(2)]
    assert_close(hessian, np.array(expected), atol=1e-3)


@jax.jit
def slopes_within_bounds(P, q):
    return in_both_modes(lambda q: dense(P, q, bounds=(0.0, 1.0)))(q)[1:]


@needs_x64
@pytest.mark.parametrize(
    "P, q",
    [
        (np.eye(2), np.array([0.0, -0.5])),  # at its bound with a multiplier of zero
        (np.diag([1.0, 0.0]), np.array([-0.5, 0.0])),  # not unique
    ],
)
def test_no_derivative_is_nan(P, q):
    for slopes in slopes_within_bounds(P, q):
        assert np.isnan(slopes).any()


@needs_x64
def test_a_failed_solve_has_nan_and_infinite_bounds_have_none():
    f = lambda high: dense(np.eye(2), np.zeros(2), bounds=(1.0, high))
    assert np.isnan(jax.jit(jax.jacrev(f))(jnp.array([0.0, 2.0]))).any()
    g = lambda q: dense(np.eye(2), q, bounds=(-np.inf, np.array([np.inf, 1.0])))
    slopes = jax.jit(jax.jacrev(g))(np.array([-2.0, -2.0]))
    assert_close(slopes, np.diag([-1.0, 0.0]), atol=1e-3)


@needs_x64
def test_a_solution_of_the_interior_point_method_is_that_of_its_active_sides():
    """Guesses of the active sides do not solve this one of the bounded problems of
    Frey et al., and the last iterate of the method alone leaves a side in doubt."""
    rng = np.random.RandomState(42)
    A, B = np.eye(8) + 0.2 * rng.randn(8, 8), rng.randn(8, 4)
    d, start = rng.randn(8), rng.randn(128, 8)[75]

    @jax.jit
    def solved(d):
        weights = 2 * np.eye(8), 2 * np.eye(4)
        options = dict(d=d, final=weights[0], start=start, horizon=20)
        problem = dlx.qp.Staged(A, B, *weights, controls=(-1.0, 1.0), **options)
        return dlx.qp.solve(problem, throw=False)

    solution = solved(d)
    assert solution.iterations > 10
    assert solution.complementarity < 1e-11 * solution.cost
    first = jax.jit(jax.grad(lambda d: jnp.sum(solved(d).u[0])))
    expected = central_difference(lambda d: jnp.sum(solved(d).u[0]), d, 1e-5)
    assert_close(first(d), expected, rtol=1e-6, atol=1e-6)
