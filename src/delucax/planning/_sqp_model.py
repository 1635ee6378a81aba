"""The quadratic program of a constrained problem about a trajectory.

Its unknowns are the changes of states and controls. Where the Hessian of the Lagrangian
is not convex, it is replaced by one that has the same minimum along the linear dynamics.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax

from .._jax import by_components, join_state, split_state, with_stores
from .._typing import Array
from ..math import matvec
from ..math._linear_solve import full_precision, symmetric
from ..math._small import products_whole
from ..qp._staged import StagedForm
from ._lq import apply, product
from ._problem import Problem


_STIFF = 10.0


class Iterate(NamedTuple):
    """A trajectory, which need not follow the dynamics, and its multipliers."""

    states: Array  # (T+1, n)
    controls: Array  # (T, m)
    costates: Array  # (T+1, n), of x_0 = start and x_{k+1} = F(x_k, u_k)
    sides: Array  # (2, T+1, rows), of the upper and the lower sides, not negative


class Values(NamedTuple):
    """The problem at a trajectory."""

    cost: Array
    defects: Array  # (T+1, n), by how much each step misses the next state
    c: Array  # (T+1, p), of the constraints, zero where there is none


class Model(NamedTuple):
    """The problem and its derivatives, `z = (x, u)`."""

    values: Values
    h: Array  # (T+1, N)
    F: Array  # (T, n, N)
    G: Array  # (T+1, p, N)
    H: Array  # (T+1, N, N), of the Lagrangian
    H_cost: Array  # that of the cost


class Shape(NamedTuple):
    """What is static: how many stage and final constraints there are, which of them are
    equalities, and which variables have bounds."""

    equal: Array  # (T+1, p)
    given: Array  # (T+1, p)
    bounded: tuple[int, int]


def shape_of(problem: Problem, horizon: int) -> Shape:
    """The constraints of a problem."""
    n, m = problem.dynamics.state_size, problem.dynamics.control_size
    bounded = (n, n + m) if problem.bounds is not None else (n, n)
    if problem.constraints is None:
        none = jnp.zeros((horizon + 1, 0), bool)
        return Shape(none, none, bounded)
    x, u, t = problem.x0, jnp.zeros(m, problem.x0.dtype), problem.t0
    sizes = jax.eval_shape(problem.stage_constraints, t, x, u)[0].shape[0]
    end = jax.eval_shape(problem.final_constraints, t, x)[0].shape[0]
    size = max(sizes, end)
    stage = problem.stage_constraints(t, x, u)[1]
    final = problem.final_constraints(t, x)[1]
    pad = lambda a: jnp.pad(a, (0, size - a.shape[0]))
    stack = lambda a, b: jnp.concatenate([jnp.tile(pad(a), (horizon, 1)), pad(b)[None]])
    given = stack(jnp.ones(sizes, bool), jnp.ones(end, bool))
    return Shape(stack(stage, final), given, bounded)


def evaluated(problem: Problem, shape: Shape, states: Array, controls: Array) -> Values:
    """The problem at a trajectory."""
    times = problem.times(controls.shape[0])
    reached = jax.vmap(problem.step)(times[:-1], states[:-1], controls, problem.w)
    defects = jax.vmap(problem.deviation)(reached, states[1:])
    defects = jnp.concatenate([problem.deviation(problem.x0, states[0])[None], defects])
    cost = problem.total(states, controls)
    size = shape.equal.shape[1]
    if problem.constraints is None:
        return Values(cost, defects, jnp.zeros_like(states[:, :0]))
    (stage, _), (final, _) = problem.constraints_along(states, controls)
    pad = lambda a: jnp.pad(a, ((0, 0), (0, size - a.shape[1])))
    c = jnp.concatenate([pad(stage), pad(final[None])])
    return Values(cost, defects, c)


@full_precision
@products_whole()
def expanded(problem: Problem, shape: Shape, at: Iterate, second_order: bool) -> Model:
    """The problem and its derivatives at an iterate; the Hessian is that of the
    Lagrangian if `second_order`, else that of the cost."""
    states, controls, costates, sides = at
    n, (T, m) = states.shape[1], controls.shape
    times, size = problem.times(T), shape.equal.shape[1]
    y = (sides[0] - sides[1])[:, sides.shape[2] - size :]
    z = jnp.concatenate([states[:-1], controls], axis=1)
    none = jnp.zeros(0, z.dtype)

    def constraints(z, t):
        if problem.constraints is None:
            return none
        return problem.stage_constraints(t, z[:n], z[n:])[0]

    def final_constraints(x):
        if problem.constraints is None:
            return none
        return problem.final_constraints(times[-1], x)[0]

    like = jax.tree.map(
        lambda a: jax.ShapeDtypeStruct(a.shape[1:], a.dtype), (z, times[:-1], problem.w)
    )

    @by_components
    def advance(parts, t, w):
        z = join_state(parts)
        return problem.step(t, z[:n], z[n:], w)

    stored = with_stores(lambda z, t, w: advance(split_state(z), t, w), *like)

    def stage(z, t, w, p, y):
        step = lambda z: stored(z, t, w)
        cost = lambda z: problem.cost(t, z[:n], z[n:]) + 0.0

        def lagrangian(z):
            c = constraints(z, t)
            return cost(z) - p @ step(z) + y[: c.size] @ c

        def terms(z):
            h, c, after = jax.grad(cost)(z), constraints(z, t), step(z)
            slope = jax.grad(lagrangian)(z) if second_order else h
            return (after, c, slope, h), (after, c, h, cost(z))

        (F, G, *H), (after, c, h, value) = jax.jacfwd(terms, has_aux=True)(z)
        return F, G, H, after, c, h, value

    F, G, H, reached, c, h, cost = jax.vmap(stage)(
        z, times[:-1], problem.w, costates[1:], y[:-1]
    )

    def final(x):
        cost = lambda x: problem.cost.final(times[-1], x) + 0.0
        c = final_constraints(x)
        push = y[-1, : c.size]
        lagrangian = lambda x: cost(x) + push @ final_constraints(x)
        h = jax.grad(cost)(x)
        slope = jax.grad(lagrangian)(x) if second_order else h
        return (c, slope, h), (c, h, cost(x))

    (G_end, *V), (c_end, v, last) = jax.jacfwd(final, has_aux=True)(states[-1])
    defects = jax.vmap(problem.deviation)(reached, states[1:])
    defects = jnp.concatenate([problem.deviation(problem.x0, states[0])[None], defects])
    stack = lambda a, b: jnp.concatenate([a, b[None]])
    pad = lambda a, *sizes: jnp.pad(
        a, [(0, s - k) for s, k in zip(sizes, a.shape, strict=True)]
    )
    values = Values(
        jnp.sum(cost) + last,
        defects,
        stack(pad(c, T, size), pad(c_end, size)),
    )
    N = n + m
    model = Model(
        values,
        stack(h, pad(v, N)),
        F,
        stack(pad(G, T, size, N), pad(G_end, size, N)),
        *(symmetric(stack(a, pad(b, N, N))) for a, b in zip(H, V, strict=True)),
    )
    return jax.tree.map(lambda a: a.astype(states.dtype), model)


class Convex(NamedTuple):
    """A convex cost with the same minimum along the linear dynamics: that of the
    distance from the feedback `u = -k - K x`, weighted by its control Hessian. The
    multipliers of the equations differ by `P x + s`."""

    H: Array
    h: Array
    P: Array  # (T+1, n, n)
    s: Array  # (T+1, n)
    K: Array
    shift: Array  # the largest that was added to a pivot


def convex_cost(
    problem: Problem, shape: Shape, at: Iterate, model: Model, mu: Array, last: Array
):
    """The convex cost of the Lagrangian; with the squares of the constraints that hold
    with equality where it is not convex along the dynamics alone; and with a multiple
    of the identity where it is not convex along both.

    Source: Waechter and Biegler, 2006 (how the multiple is found).
    """
    held, target = _held(problem, shape, at, model)
    N = model.h.shape[1]
    eye = jnp.eye(N, dtype=model.h.dtype)
    rows, size = held.shape[1], shape.equal.shape[1]
    first, _ = shape.bounded
    own, general = held[:, : rows - size], held[:, rows - size :]
    norm = jnp.sum(model.G**2, axis=2)
    general = general / jnp.where(norm > 0, norm, 1)
    pad = (0, 0), (first, N - first - own.shape[1])
    added = jnp.pad(own, pad)[:, :, None] * eye
    added = added + jnp.einsum("tpi,tp,tpj->tij", model.G, general, model.G)
    pulled = jnp.pad(own * target[:, : rows - size], pad)
    pulled = pulled + jnp.einsum(
        "tpi,tp->ti", model.G, general * target[:, rows - size :]
    )
    largest = jnp.max(jnp.abs(model.H))
    least = 1e-4 * largest

    def again(carry):
        k, delta, _ = carry
        sigma = jnp.where(k > 0, _STIFF * largest, 0)
        stiff = model._replace(
            H=model.H + sigma * added + delta * eye, h=model.h - sigma * pulled
        )
        found = made_convex(stiff, mu)
        wanted = jnp.where(last > 0, jnp.maximum(least, last / 3), least)
        more = jnp.where(k == 0, 0, jnp.where(delta > 0, 8 * delta, wanted))
        delta = jnp.where(found.shift > 0, more, delta)
        return k + 1, delta, found

    def going(carry):
        k, _, found = carry
        return (k == 0) | ((k < 20) & (found.shift > 0))

    like = jax.eval_shape(made_convex, model, mu)
    nothing = jax.tree.map(lambda a: jnp.zeros(a.shape, a.dtype), like)
    begin = jnp.zeros((), int), jnp.zeros_like(mu), nothing
    return lax.while_loop(going, again, begin)


def _held(problem, shape: Shape, at: Iterate, model: Model):
    """Which rows hold with equality, by their multipliers, and where."""
    low, high = limits_of(problem, shape, at, model.values.c)
    upper, lower = at.sides
    at_high = upper > jnp.abs(high)
    at_low = lower > jnp.abs(low)
    held = (at_high | at_low | (low == high)).astype(low.dtype)
    target = jnp.where(at_low, low, high)
    return held, jnp.where(held > 0, target, 0)


def made_convex(model: Model, mu: Array) -> Convex:
    """The convex cost. The control Hessian is made definite, at the expense of its
    directions of negative curvature.

    Source: Verschueren et al., 2017 (the idea); Gill and Murray, 1974 (the pivots).
    """
    n = model.F.shape[1]
    dtype = model.h.dtype
    N = model.h.shape[1]
    add = mu * (jnp.arange(N) >= n).astype(dtype)

    def back(carry, here):
        P, s = carry
        F, H, h, d = here
        M = H + jnp.diag(add) + product(F.T, product(P, F))
        g = h + apply(F.T, s + apply(P, d))
        Quu, Qux, Qu = M[n:, n:], M[n:, :n], g[n:]
        solved, added = _definite(Quu, jnp.concatenate([Qux, Qu[:, None]], axis=1))
        K, k = solved[:, :n], solved[:, n]
        before = M[:n, :n] - product(Qux.T, K)
        s = g[:n] - apply(Qux.T, k)
        pivot = Quu + jnp.diag(added)
        whole = jnp.concatenate([K, jnp.eye(K.shape[0], dtype=dtype)], axis=1)
        weighted = product(pivot, whole)
        out = product(whole.T, weighted), apply(weighted.T, k)
        before = (before + before.T) / 2
        return (before, s), (*out, before, s, K, jnp.max(added))

    P, s = model.H[-1, :n, :n], model.h[-1, :n]
    xs = model.F, model.H[:-1], model.h[:-1], model.values.defects[1:]
    _, (H, h, Ps, ss, K, shift) = lax.scan(back, (P, s), xs, reverse=True)
    stack = lambda a, b: jnp.concatenate([a, b[None]])
    zero_H, zero_h = jnp.zeros((N, N), dtype), jnp.zeros(N, dtype)
    return Convex(
        stack(H, zero_H), stack(h, zero_h), stack(Ps, P), stack(ss, s), K, jnp.max(shift)
    )


def _definite(matrix: Array, right: Array) -> tuple[Array, Array]:
    """`(matrix + diag(added))^-1 right` and `added`: each pivot is as large as its
    magnitude, and well positive."""
    m = matrix.shape[0]
    largest = jnp.max(jnp.abs(matrix))
    least = jnp.finfo(matrix.dtype).eps ** 0.5 * jnp.where(largest > 0, largest, 1)
    rows = list(jnp.concatenate([matrix, right], axis=1))
    added = []
    for i in range(m):
        pivot = rows[i][i]
        # An uncoupled pivot that is barely positive is left as it is.
        wanted = jnp.maximum(jnp.abs(pivot), least)
        added.append(wanted - pivot)
        row = (rows[i].at[i].set(wanted)) / wanted
        rows[i] = row
        for j in range(m):
            if j > i:
                rows[j] = rows[j] - rows[j][i] * row
    for i in reversed(range(m)):
        for j in range(i + 1, m):
            rows[i] = rows[i] - rows[i][j] * rows[j]
    return jnp.stack(rows)[:, m:], jnp.stack(added)


def limits_of(problem: Problem, shape: Shape, at: Iterate, c: Array):
    """The bounds of the changes: lower and upper ones, shape `(T+1, rows)`."""
    low = jnp.where(shape.given & shape.equal, -c, -jnp.inf)
    high = jnp.where(shape.given, -c, jnp.inf)
    if problem.bounds is not None:
        box = problem.room(at.controls)
        assert box is not None
        ends = (-jnp.inf, jnp.inf)
        own = [
            jnp.pad(jnp.broadcast_to(b, at.controls.shape), ((0, 1), (0, 0)),
                    constant_values=end)
            for b, end in zip(box, ends, strict=True)
        ]
        low = jnp.concatenate([own[0], low], axis=1)
        high = jnp.concatenate([own[1], high], axis=1)
    return low, high


def form_of(problem, shape: Shape, at: Iterate, model: Model, convex: Convex, elastic):
    """The program. Constraints may be violated at the weight `elastic` if that is
    finite; bounds of the controls may not."""
    low, high = limits_of(problem, shape, at, model.values.c)
    rows, size = low.shape[1], shape.equal.shape[1]
    soft = None
    if size:
        v = jnp.full(low.shape, jnp.inf, low.dtype).at[:, rows - size :].set(elastic)
        W = jnp.where(jnp.isfinite(v), 0, jnp.inf).astype(low.dtype)
        soft = jnp.stack([v, v]), jnp.stack([W, W])
    given: Any = convex.H, convex.h, model.F, model.values.defects, model.G
    return StagedForm(*given, low, high, soft, shape.bounded, False)
