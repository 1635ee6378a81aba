"""Derivatives of the Riccati solvers to second order, in both modes."""

import jax
import jax.numpy as jnp
import pytest
from helpers import needs_x64
from jax.test_util import check_grads

import delucax as dlx


A, D_A = jnp.array([[0.6, 0.3], [-0.2, -0.9]]), jnp.array([[0.4, -1.0], [0.3, 0.7]])
B, D_B = jnp.array([[1.0], [0.5]]), jnp.array([[-0.3], [0.8]])
Q, D_Q = jnp.array([[2.0, 0.3], [0.3, 1.0]]), jnp.array([[0.5, -0.2], [-0.2, 0.9]])
S, D_S = jnp.array([[0.1], [-0.2]]), jnp.array([[0.6], [0.2]])


@needs_x64
@pytest.mark.parametrize("name", ["dare", "care", "filter_dare", "filter_care"])
def test_check_grads(name):
    solve = getattr(dlx.riccati, name)

    def line(e):
        # All arguments move at once.
        column = B + e * D_B
        column = column.T if name.startswith("filter") else column
        R = jnp.array([[1.0]]) + e
        solution = solve(A + e * D_A, column, Q + e * D_Q, R, S + e * D_S)
        return jnp.sum(jnp.sin(solution.X)) + jnp.sum(jnp.cos(solution.K))

    check_grads(jax.jit(line), (0.1,), 2, modes=("fwd", "rev"), rtol=1e-6, eps=1e-5)
