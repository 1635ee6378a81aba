"""The derivative of a plan: the size of its program, and what it refuses."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import once

import delucax as dlx


DYNAMICS = dlx.LinearDynamics(np.eye(2) + 0.1, np.ones((2, 1)), dt=0.1)
X0 = np.array([1.0, 0.0])


def operations(jaxpr):
    """The operations of a program, those of nested ones included."""
    inner = [
        getattr(leaf, "jaxpr", leaf)
        for equation in jaxpr.eqns
        for leaf in jax.tree.leaves(
            list(equation.params.values()), is_leaf=lambda v: hasattr(v, "eqns")
        )
    ]
    nested = sum(operations(program) for program in inner if hasattr(program, "eqns"))
    return len(jaxpr.eqns) + nested


def controls(Q):
    cost = dlx.costs.Quadratic(Q, jnp.eye(1))
    return dlx.planning.ilqr(DYNAMICS, cost, X0, np.zeros((5, 1))).controls


@once
def test_adjoint_stays_small():
    # A derivative of a plan is one linear-quadratic problem about the solution, with
    # products in one piece: 1.4 times the operations of the plan. Written out entry by
    # entry it would be several times as many, and the first gradient as much later.
    plan = operations(jax.make_jaxpr(controls)(jnp.eye(2)).jaxpr)
    total = lambda Q: jnp.sum(controls(Q))
    adjoint = operations(jax.make_jaxpr(jax.grad(total))(jnp.eye(2)).jaxpr)
    assert adjoint < 1.7 * plan


@once
@pytest.mark.parametrize("derivative", [jax.grad, jax.jacfwd])
def test_closing_over_what_is_differentiated_is_refused(derivative):
    def best(p):
        stage = lambda t, x, u: p * x @ x + u @ u
        cost = dlx.costs.Function(stage, lambda t, x: x @ x)
        return dlx.planning.ilqr(DYNAMICS, cost, X0, np.zeros((5, 1))).cost

    with pytest.raises(ValueError, match="closes over a number that is"):
        jax.jit(derivative(best))(2.0)


@once
def test_closing_over_what_is_traced_outside_is_refused_in_a_derivative():
    def best(x0, p):
        stage = lambda t, x, u: p * x @ x + u @ u
        cost = dlx.costs.Function(stage, lambda t, x: x @ x)
        return dlx.planning.ilqr(DYNAMICS, cost, x0, np.zeros((5, 1))).cost

    assert jax.jit(best)(X0, 2.0) > 0
    with pytest.raises(ValueError, match="that a transformation outside traces"):
        jax.jit(jax.grad(best))(X0, 2.0)
