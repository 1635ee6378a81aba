r"""Derivatives of an iLQR plan, by the implicit function theorem.

The gradient of the Lagrangian is zero at the solution $z$ of a problem with parameters
$p$. From these conditions, $g(z, p) = 0$, follows

$$\mathrm{d}z = -\left(\frac{\partial g}{\partial z}\right)^{-1}
\frac{\partial g}{\partial p}\, \mathrm{d}p.$$

The matrix $\partial g / \partial z$ is that of a linear-quadratic problem with exact
second derivatives, so one such problem gives the derivative. The iteration is not
differentiated: the derivative does not depend on the number of iterations or the start.
"""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.lax as lax
import jax.numpy as jnp
from jaxtyping import Array

from .._jax import deferred, nan_tangent
from .._results import RESULTS
from ..math import matvec
from ..math._linear_solve import full_precision
from ..math._small import products_whole
from ._augmented import with_constraints
from ._descent import Outcome
from ._implicit_rule import implicit
from ._lq import (
    apply,
    costates_of,
    in_parallel,
    in_sequence,
    model,
    product,
    solve_free,
    Stages,
)
from ._problem import Augmentation, Problem
from ._start import controls_of


REFINEMENTS = 20
"""The refinements of the constrained linear solve. Each adds more than one digit."""
STIFFER = 10.0
"""The weight of the constraints in this solve, relative to the last penalty weight."""


def _tangents(
    out: Outcome, primals: Any, varied: Any, rest: Any, change: Any
) -> dict[str, Array]:
    """The tangents of the trajectory, its cost, the gains and the multipliers."""
    problem, start, options = primals
    solved = out.result == RESULTS.successful
    # The derivatives of a failed plan are NaN. They are computed at the start, because
    # NaN inside would spoil the other members of a batch.
    x0 = jnp.where(jnp.isfinite(problem.x0), problem.x0, 0)
    X = jnp.where(solved, out.states, x0)
    U = jnp.where(solved, out.controls, controls_of(start))
    y = out.multipliers
    given = lambda varied: eqx.combine(varied, rest)
    dX, dU, dy, free, definite = _change(X, U, y, problem, given, varied, change)
    cost = lambda varied, X, U: given(varied).total(X, U)

    @full_precision
    @products_whole()
    def gains(given, tangents):
        """The tangent of the gains. The gains of the last backward pass only depend on
        the problem and the solution."""
        varied, rest, X, U, y, mu, free = given

        def after(varied, X, U, y):
            problem = eqx.combine(varied, rest).with_multipliers(y)
            stages = model(problem, X, U, None, options.second_order)
            if options.parallel:
                return in_parallel(stages, mu).K
            on_state = options.regularise == "state"
            return in_sequence(stages, mu, on_state, None, free).K

        return jax.jvp(after, (varied, X, U, y), tangents)[1]

    _, dJ = jax.jvp(cost, (varied, X, U), (change, dX, dU))
    # Deferred, because it needs the third derivatives of the problem and is rarely
    # used.
    about = varied, rest, X, U, y, out.regularisation, free
    dK = deferred(gains, out.gains, about, (change, dX, dU, dy))
    ok = solved & definite
    changes = dict(states=dX, controls=dU, gains=dK, cost=dJ, multipliers=dy)
    return jax.tree.map(lambda d: nan_tangent(d, ok), changes)


def _change(
    X: Array, U: Array, y: Augmentation | None, problem: Problem, given, varied, change
):
    """The tangents of states, controls and multipliers; which controls are free; and
    whether the solution is a strict minimum."""
    n, T = X.shape[1], U.shape[0]
    # With a weight of zero, the augmented Lagrangian is the Lagrangian.
    plain = None if y is None else y._replace(rho=jnp.zeros_like(y.rho))
    # The Hessian of the Lagrangian, with exact second derivatives.
    stages = model(problem.with_multipliers(plain), X, U, None, True)
    costates = costates_of(stages.F, stages.h, stages.v)
    z = jnp.concatenate([X[:-1], U], axis=1)

    def conditions(varied):
        """The optimality conditions at the fixed solution. Their tangents are the right
        side of the linear problem."""
        problem = given(varied).with_multipliers(plain)
        times = problem.times(T)

        def lagrangian(z, t, w, y, costate):
            after = problem.step(t, z[:n], z[n:], w)
            cost = problem.stage_cost(t, z[:n], z[n:], y)
            return cost + costate @ after, after

        each = jax.vmap(jax.grad(lagrangian, has_aux=True))
        h, after = each(z, times[:-1], problem.w, problem.stage_multipliers, costates)
        v = jax.grad(lambda x: problem.final_cost(times[-1], x))(X[-1])
        c = None
        if problem.constraints is not None:
            c = [c for c, _ in problem.constraints_along(X, U)]
        return (h, after, v), problem.x0, problem.bounds, c

    # One product with the tangent, even if many parameters vary.
    at, linear = jax.jvp(conditions, (varied,), (change,))
    ((slope, *_), *_), ((h, d, v), dx0, ends, dc) = at, linear
    free, fixed = jnp.ones_like(U, bool), jnp.zeros_like(U)
    if problem.bounds is not None:
        # A control that is held at a bound moves with the bound. A control at a bound
        # with a slope of zero is about to leave it, and counts as free.
        low, high = problem.bounds
        at_low = (U <= low) & (slope[:, n:] > 0)
        at_high = (U >= high) & (slope[:, n:] < 0)
        free = ~(at_low | at_high)
        fixed = jnp.where(at_low, ends[0], jnp.where(at_high, ends[1], fixed))
    # The linear problem: the quadratic terms of the model, with the tangents as linear
    # terms.
    stages = stages._replace(h=h, d=d, v=v)
    if y is None:
        factors = factorise(stages, free)
        dX, dU = substitute(stages, factors, dx0, fixed, free)
        return dX, dU, None, free, jnp.all(factors.ok)
    # The Jacobians of the active constraints; zero for the others.
    times = problem.times(T)
    stage = lambda z, t: problem.stage_constraints(t, z[:n], z[n:])
    final = lambda x: problem.final_constraints(times[-1], x)
    G, equal = jax.vmap(jax.jacfwd(stage, has_aux=True))(z, times[:-1])
    end, equal_at_end = jax.jacfwd(final, has_aux=True)(X[-1])
    on, at_end = equal | (y.stage > 0), equal_at_end | (y.final > 0)
    G, end = jnp.where(on[..., None], G, 0), jnp.where(at_end[:, None], end, 0)
    active = (G, on), (end, at_end)
    dX, dU, dy, ok = _with_constraints(stages, active, dc, y, dx0, fixed, free)
    return dX, dU, dy, free, ok


def _with_constraints(stages, active, dc, y, dx0, fixed, free):
    """Solve the linear problem under the constraints `G dz + dc = 0`, by the method of
    multipliers."""
    (G, on), (end, at_end) = active
    # All refinements have the same quadratic part, so it is factorised once.
    rho = STIFFER * y.rho
    dc = jnp.where(on, dc[0], 0), jnp.where(at_end, dc[1], 0)
    H = stages.H + rho * jnp.einsum("tpi,tpj->tij", G, G)
    V = stages.V + rho * end.T @ end
    factors = factorise(stages._replace(H=H, V=V), free)

    def minimum(dy):
        push = rho * dc[0] + dy[0], rho * dc[1] + dy[1]
        h = stages.h + jnp.einsum("tpi,tp->ti", G, push[0])
        pushed = stages._replace(H=H, V=V, h=h, v=stages.v + end.T @ push[1])
        dX, dU = substitute(pushed, factors, dx0, fixed, free)
        # The first-order update of the multipliers, dy + rho (G dz + dc).
        dz = jnp.concatenate([dX[:-1], dU], axis=1)
        moved = jnp.einsum("tpi,ti->tp", G, dz) + dc[0], end @ dX[-1] + dc[1]
        return dX, dU, (dy[0] + rho * moved[0], dy[1] + rho * moved[1])

    # Each pass divides the error of the multipliers by about rho.
    refine = lambda dy, _: (minimum(dy)[2], None)

    nothing = jnp.zeros_like(y.stage), jnp.zeros_like(y.final)
    dy, _ = lax.scan(refine, nothing, None, length=REFINEMENTS)
    dX, dU, dy = minimum(dy)
    change = Augmentation(dy[0], dy[1], jnp.zeros_like(y.rho))
    return dX, dU, change, jnp.all(factors.ok)


class Factors(NamedTuple):
    """The factorised quadratic part of a linear-quadratic problem."""

    K: Array
    V: Array  # of the next state
    M: Array  # the rows of the control
    ok: Array


def factorise(stages: Stages, free: Array) -> Factors:
    """Factorise the quadratic part. Controls that are not `free` are held."""
    n = stages.V.shape[0]

    # Like `in_sequence`, but without regularisation: if the problem is not convex, the
    # solution is not a strict minimum and has no derivative.
    def back(V, here):
        F, H, free = here
        M = H + product(F.T, product(V, F))
        K, ok = solve_free(M[n:, n:], M[n:, :n], free)
        K = jnp.where(ok, K, 0)
        before = M[:n, :n] - product(M[:n, n:], K)
        return (before + before.T) / 2, Factors(K, V, M[n:], ok)

    return lax.scan(back, stages.V, (stages.F, stages.H, free), reverse=True)[1]


def substitute(
    stages: Stages, factors: Factors, dx0: Array, fixed: Array, free: Array
) -> tuple[Array, Array]:
    """The minimum of the linear-quadratic problem with factorised quadratic part.

    It is linear in `h`, `d`, `v`, `dx0` and the changes `fixed` of the controls that
    are not free, and JAX can transpose it.
    """
    n = dx0.shape[0]

    def back(v, here):
        # The change is -Quu^-1 (Qu + Quu fixed) for free controls, `fixed` for others.
        F, h, d, V, M, free, fixed = here
        g = h + apply(F.T, v + apply(V, d))
        push = (g[n:] + apply(M[:, n:], fixed))[:, None]
        change = fixed - solve_free(M[:, n:], push, free)[0][:, 0]
        return g[:n] + apply(M[:, :n].T, change), change

    xs = (stages.F, stages.h, stages.d, factors.V, factors.M, free, fixed)
    _, change = lax.scan(back, stages.v, xs, reverse=True)

    def forward(dx, here):
        F, K, change, d = here
        du = change - matvec(K, dx)
        return apply(F, jnp.concatenate([dx, du])) + d, (dx, du)

    last, (dX, dU) = lax.scan(forward, dx0, (stages.F, factors.K, change, stages.d))
    return jnp.concatenate([dX, last[None]]), dU


solution = implicit("ILQR", with_constraints, _tangents)
"""The outcome of the iteration, differentiable with respect to the problem."""
