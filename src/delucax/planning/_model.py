"""The linear-quadratic model of a problem about a trajectory."""

from collections.abc import Callable
from typing import Any

import jax
import jax.lax as lax
import jax.numpy as jnp
from jaxtyping import Array

from .._jax import first_possible
from ..math import matvec
from ..math._linear_solve import symmetric
from ._lq import Stages
from ._problem import Problem, Values


def model(
    problem: Problem,
    states: Array,
    controls: Array,
    defects: Array | None,
    second_order: bool,
    use_exact: Array | None = None,
    spacing: float | None = None,
) -> Stages:
    """The linear-quadratic model of the problem about a trajectory.

    The second derivatives of dynamics and constraints are left out where `use_exact` is
    false. With a `spacing` the dynamics are linearised by central differences.
    """
    size, times = states.shape[1], problem.times(controls.shape[0])
    t, end = times[:-1], times[-1]
    z = jnp.concatenate([states[:-1], controls], axis=1)
    step = lambda z, t, w: problem.step(t, z[:size], z[size:], w)
    stage_cost = lambda z, t, y: problem.stage_cost(t, z[:size], z[size:], y)
    final_cost = lambda x: problem.final_cost(end, x)

    def stage_hessian(z, t, y):
        """The Hessian of the cost and of the constraints' squared linear parts."""
        if problem.multipliers is None:
            return jax.hessian(stage_cost)(z, t, y)
        c = lambda z: problem.stage_constraints(t, z[:size], z[size:])
        cost = jax.hessian(lambda z: problem.cost(t, z[:size], z[size:]))(z)
        return cost + squared(c, z, y, problem.multipliers.rho)

    y = problem.stage_multipliers
    v = jax.grad(final_cost)(states[-1])
    if spacing is None:
        # In reverse mode if possible, because a step has fewer outputs than inputs.
        slopes = first_possible(jax.jacrev(step), jax.jacfwd(step))
    else:
        slopes = central(step, spacing, problem.deviation)
    F = jax.vmap(slopes)(z, t, problem.w)
    h = jax.vmap(jax.grad(stage_cost))(z, t, y)
    H = jax.vmap(stage_hessian)(z, t, y)
    V = jax.hessian(lambda x: problem.cost.final(end, x))(states[-1])
    if problem.multipliers is not None:
        c = lambda x: problem.final_constraints(end, x)
        V = V + squared(c, states[-1], *problem.multipliers[1:])
    if second_order:
        # The Hessian of the Hamiltonian, cost + costate' F: the curvature of the
        # dynamics is weighted by the costates.
        def hamiltonian(z, t, w, y, costate):
            return stage_cost(z, t, y) + costate @ step(z, t, w)

        slope = jax.grad(hamiltonian)
        ways = jax.jacfwd(slope), jax.jacrev(slope), jax.jacfwd(jax.jacfwd(hamiltonian))
        each = z, t, problem.w, y, costates_of(F, h, v)
        exact = jax.vmap(first_possible(*ways))(*each)
        at_end = jax.hessian(final_cost)(states[-1])
        if use_exact is None:
            H, V = exact, at_end
        else:
            H, V = jnp.where(use_exact, exact, H), jnp.where(use_exact, at_end, V)
    # Rounding leaves Hessians not quite symmetric, which the pass back relies on.
    stages = Stages(F, symmetric(H), h, defects, symmetric(V), v)
    return jax.tree.map(lambda a: a.astype(states.dtype), stages)


def squared(c: Callable[[Array], Values], z: Array, y: Array, rho: Array) -> Array:
    """The Hessian of the active constraints' squares, without second derivatives: that
    of `rho c'c / 2` by Gauss and Newton, `rho J'J`."""
    slope = jax.jacfwd(lambda z: c(z)[0])(z)
    value, equal = c(z)
    active = equal | (y + rho * value > 0)
    return rho * slope.T @ jnp.where(active[:, None], slope, 0)


def costates_of(F: Array, h: Array, v: Array) -> Array:
    """The gradient of the cost with respect to each next state, shape `(T, n)`, by the
    adjoint equation `p_k = h_x + A'p_{k+1}` with the last one `v`."""
    size = v.shape[0]

    def back(costate, here):
        F, h = here
        return h[:size] + matvec(F[:, :size].T, costate), costate

    return lax.scan(back, v.astype(h.dtype), (F, h), reverse=True)[1]


def central(f: Any, spacing: float, deviation: Any) -> Any:
    """The Jacobian in the first argument by central differences: two calls for each
    of its entries."""

    def evaluate(z, *args):
        # By the deviation, because a wrapped angle may jump between the two sides.
        def along(way):
            change = spacing * way
            return deviation(f(z + change, *args), f(z - change, *args))

        ways = jnp.eye(z.shape[0], dtype=z.dtype)
        return jax.vmap(along)(ways).T / (2 * spacing)

    return evaluate
