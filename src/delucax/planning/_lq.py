r"""The linear-quadratic model of a problem about a trajectory, and its solution.

Each iteration of a planner minimises

$$\sum_k \left(\tfrac12 z_k' H_k z_k + h_k' z_k\right)
+ \tfrac12 x_T' V x_T + v' x_T, \qquad z_k = (x_k, u_k),$$

along $x_{k+1} = F_k z_k + d_k$, in sequence or in parallel over time.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.lax as lax
import jax.numpy as jnp
from jaxtyping import Array

from .._jax import (
    by_components,
    first_possible,
    join_state,
    split_state,
    with_stores,
)
from ..math import matvec
from ..math._linear_solve import full_precision, is_definite, solve, symmetric
from ..math._small import products_whole
from ..riccati import dre
from ._problem import Problem, Values


_SMALL_INNER = 16
"""Matrix products with an inner dimension up to this are computed as sums."""
_ELIMINATED = 5
"""Linear systems up to this size are solved entry by entry."""


class Stages(NamedTuple):
    """The linear-quadratic problem; `d` is `None` if all defects are zero."""

    F: Array  # (T, n, n + m)
    H: Array  # (T, n + m, n + m)
    h: Array  # (T, n + m)
    d: Array | None  # (T, n)
    V: Array  # (n, n)
    v: Array  # (n,)


class Policy(NamedTuple):
    """The changes `-k - K dx` of the controls. For a step of length `alpha`, the model
    predicts that the cost changes by `alpha slope + alpha^2 curvature / 2`.
    """

    K: Array
    k: Array
    gradient: Array  # of the cost-to-go with respect to each control, (T, m)
    scale: Array  # the size of the two terms that cancel in the gradient
    slope: Array
    curvature: Array
    ok: Array


@products_whole()
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

    With `second_order` it has the second derivatives of dynamics and constraints,
    unless the traced flag `use_exact` is false. With a `spacing`, the dynamics are
    linearised by central differences.
    """
    size, times = states.shape[1], problem.times(controls.shape[0])
    t, end = times[:-1], times[-1]
    has_events = bool(problem.dynamics.event_names)
    # One vector of state and control gives the cross terms in the same derivative.
    z = jnp.concatenate([states[:-1], controls], axis=1)
    like = jax.tree.map(
        lambda a: jax.ShapeDtypeStruct(a.shape[1:], a.dtype), (z, t, problem.w)
    )

    @by_components
    def advance(parts, t, w):
        z = join_state(parts)
        return problem.step(t, z[:size], z[size:], w)

    step = with_stores(lambda z, t, w: advance(split_state(z), t, w), *like)
    cost = lambda z, t: problem.cost(t, z[:size], z[size:])
    final_cost = lambda x: problem.cost.final(end, x)
    constraints = lambda z, t: problem.stage_constraints(t, z[:size], z[size:])
    final_constraints = lambda x: problem.final_constraints(end, x)
    y = end_y = rho = None
    if problem.multipliers is not None:
        y, end_y, rho = problem.multipliers
    if spacing is None:
        # Reverse mode if possible, because a step has fewer outputs than inputs. But
        # the loops of events take twice as long to compile in reverse mode.
        modes = jax.jacrev(step), jax.jacfwd(step)
        slopes = first_possible(*(modes[::-1] if has_events else modes))
    else:
        slopes = central(step, spacing, problem.deviation)
    F = jax.vmap(slopes)(z, t, problem.w)
    each = lambda z, t, y: expanded(cost, constraints, y, rho, z, t)
    h, H, push = jax.vmap(each)(z, t, y)
    v, V, end_push = expanded(final_cost, final_constraints, end_y, rho, states[-1])
    if second_order:
        # The Hessian of the Hamiltonian weights the curvature of the dynamics by the
        # costates, and the curvature of the constraints by the multipliers.
        def lagrangian(z, t, w, costate, push):
            value = costate @ step(z, t, w)
            return value if push is None else value + push @ constraints(z, t)[0]

        # Forward over reverse is cheapest, but an implicit solver inside may only have
        # one mode.
        slope = jax.grad(lagrangian)
        ways = jax.jacfwd(slope), jax.jacrev(slope), jax.jacfwd(jax.jacfwd(lagrangian))
        ways = ways[::-1] if has_events else ways
        given = z, t, problem.w, costates_of(F, h, v), push
        # The flag is traced, so the second derivatives are computed in any case.
        used = lambda M: M if use_exact is None else jnp.where(use_exact, M, 0)
        H = H + used(jax.vmap(first_possible(*ways))(*given))
        if end_push is not None:
            at_end = lambda x: end_push @ final_constraints(x)[0]
            V = V + used(jax.hessian(at_end)(states[-1]))
    # The backward pass relies on symmetry, which rounding breaks.
    stages = Stages(F, symmetric(H), h, defects, symmetric(V), v)
    return jax.tree.map(lambda a: a.astype(states.dtype), stages)


@full_precision
def expanded(
    cost: Callable[..., Array],
    constraints: Callable[..., Values],
    y: Array | None,
    rho: Array | None,
    z: Array,
    *rest: Array,
) -> tuple[Array, Array, Array | None]:
    """The expansion of the augmented Lagrangian of constraints with multipliers `y`:
    its gradient, its Gauss-Newton Hessian (that of the cost plus `rho J'J` of the
    active constraints), and the force `y + rho c` of each constraint."""

    def slope(z):
        # `+ 0.0`, because an integer cost has no gradient.
        h = jax.grad(lambda z: cost(z, *rest) + 0.0)(z)
        return h, h

    def values(z):
        c, equal = constraints(z, *rest)
        return c, (c, equal)

    H, h = jax.jacfwd(slope, has_aux=True)(z)
    if y is None or rho is None:
        return h, H, None
    J, (c, equal) = jax.jacfwd(values, has_aux=True)(z)
    force = y + rho * c
    active = equal | (force > 0)
    force, J = jnp.where(active, force, 0), jnp.where(active[:, None], J, 0)
    return h + force @ J, H + rho * J.T @ J, force


def costates_of(F: Array, h: Array, v: Array) -> Array:
    """The gradient of the cost with respect to each next state, shape `(T, n)`.

    It solves the adjoint equation `p_k = h_x + A'p_{k+1}` from `p_T = v`.
    """
    size = v.shape[0]

    def back(costate, here):
        F, h = here
        return h[:size] + matvec(F[:, :size].T, costate), costate

    return lax.scan(back, v.astype(h.dtype), (F, h), reverse=True)[1]


def central(f: Any, spacing: float, deviation: Any) -> Any:
    """The Jacobian with respect to the first argument, by central differences: two
    calls for each of its entries."""

    def evaluate(z, *args):
        # `deviation`, because a wrapped angle may jump between the two sides.
        def along(way):
            change = spacing * way
            return deviation(f(z + change, *args), f(z - change, *args))

        ways = jnp.eye(z.shape[0], dtype=z.dtype)
        return jax.vmap(along)(ways).T / (2 * spacing)

    return evaluate


def product(a: Array, b: Array) -> Array:
    """`a @ b`, as a sum of outer products if the matrices are small.

    XLA on CPU turns the sum into one vectorised loop and fuses it with the operations
    around it. A matrix product would be a separate call.
    """
    if a.shape[1] > _SMALL_INNER:
        return a @ b
    return jnp.sum(a[:, :, None] * b, axis=1)


def apply(matrix: Array, vector: Array) -> Array:
    """`matrix @ vector`, computed as in `product`."""
    return product(matrix, vector[:, None])[:, 0]


def solve_definite(matrix: Array, right: Array) -> tuple[Array, Array]:
    """`matrix^-1 right` for a symmetric matrix, and whether the matrix is positive
    definite.

    If it is not, the solution is meaningless, but finite if the arguments are.
    """
    m = matrix.shape[0]
    if m > _ELIMINATED:
        ok = is_definite(matrix)
        safe = jnp.where(ok, matrix, jnp.eye(m, dtype=matrix.dtype))
        return solve(safe, right), ok
    # A definite matrix needs no pivoting. By symmetry, only the entries from the
    # diagonal on are kept. They are separate from the right sides, in which the
    # solution is linear.
    rows = [matrix[i, i:] for i in range(m)]
    sides = [right[i] for i in range(m)]
    # A pivot below this share of its diagonal entry may be only rounding.
    least = m * jnp.finfo(matrix.dtype).eps
    pivots, ok = [], jnp.asarray(True)
    for i in range(m):
        good = rows[i][0] > least * jnp.abs(matrix[i, i])
        ok = ok & good
        pivots.append(jnp.where(good, rows[i][0], 1))
        for j in range(i + 1, m):
            factor = rows[i][j - i] / pivots[i]
            rows[j] = rows[j] - factor * rows[i][j - i :]
            sides[j] = sides[j] - factor * sides[i]
    solved: list[Any] = [None] * m
    for i in reversed(range(m)):
        total = sides[i]
        for j in range(i + 1, m):
            total = total - rows[i][j - i] * solved[j]
        solved[i] = total / pivots[i]
    return jnp.stack(solved), ok


@full_precision
def in_sequence(
    stages: Stages, mu: Array, on_state: bool, box: Any = None, free: Any = None
) -> Policy:
    r"""Solve the problem by the regularised Riccati recursion, backwards in time.

    The cost-to-go of the next state is $\tfrac12 x'V x + v'x$. Together with the cost
    of the stage it is $\tfrac12 z'M z + g'z$, with $M = H + F'V F$ and
    $g = h + F'(v + V d)$. With their blocks $Q_{uu}$, $Q_{ux}$ and $Q_u$, its minimum
    over the control is at $-k - K \delta x$, with $k = Q_{uu}^{-1} Q_u$ and
    $K = Q_{uu}^{-1} Q_{ux}$.

    `box` holds the bounds `(low, high)` of the changes of the controls, each of shape
    `(T, m)`. The boolean array `free`, shape `(T, m)`, says which controls may change.

    Source: Tassa, Erez and Todorov, 2012; Tassa, Mansard and Todorov, 2014 (bounds).
    """
    n = stages.V.shape[0]
    m = stages.F.shape[2] - n

    def back(carry, here):
        V, v = carry
        F, H, h, d, box, free = here
        M = H + product(F.T, product(V, F))
        pushed = apply(F.T, v if d is None else v + apply(V, d))
        g = h + pushed
        Quu, Qux, Qu = M[n:, n:], M[n:, :n], g[n:]
        # Add mu |dx_next|^2 / 2 or mu |du|^2 / 2 to what is minimised over the control.
        # The cost-to-go does not include it: it stays the true one of the policy.
        if on_state:
            extra = mu * product(F[:, n:].T, F)
        else:
            extra = mu * jnp.eye(m, n + m, n, dtype=M.dtype)
        pivot, cross = Quu + extra[:, n:], Qux + extra[:, :n]
        change = None
        if box is not None:
            change, free = solve_box_qp(pivot, Qu, *box)
        S, ok = solve_free(pivot, jnp.concatenate([cross, Qu[:, None]], 1), free)
        K, k = S[:, :n], S[:, n] if change is None else -change
        ok = ok & jnp.all(jnp.isfinite(k))
        K, k = jnp.where(ok, K, 0), jnp.where(ok, k, 0)
        # These formulas hold for any K and k. The shorter ones hold only at the
        # minimum, from which bounds and regularisation lead away.
        Quu_k = apply(Quu, k)
        D = product(K.T, product(Quu, K) - Qux)
        V = M[:n, :n] + D - product(Qux.T, K)
        v = g[:n] + apply(K.T, Quu_k - Qu) - apply(Qux.T, k)
        # Symmetrise, because V would lose its symmetry over a long horizon by rounding.
        return ((V + V.T) / 2, v), (K, k, Qu, pushed[n:], Quu_k, ok)

    xs = (stages.F, stages.H, stages.h, stages.d, box, free)
    _, kept = lax.scan(back, (stages.V, stages.v), xs, reverse=True)
    K, k, Qu, pushed, Quu_k, ok = kept
    # A step -a k changes the cost by the sum of -a k'Qu + a^2 k'Quu k / 2.
    slope, curvature = -jnp.sum(k * Qu), jnp.sum(k * Quu_k)
    scale = jnp.max(jnp.abs(pushed))
    return Policy(K, k, Qu, scale, slope, curvature, jnp.all(ok))


def solve_free(matrix: Array, right: Array, free: Array | None) -> tuple[Array, Array]:
    """Like `solve_definite`, but only for the `free` entries; the others are zero."""
    if free is None:
        return solve_definite(matrix, right)
    # The other rows and columns become those of the identity, so that the shape stays.
    both = free[:, None] & free[None]
    matrix = jnp.where(both, matrix, jnp.eye(free.shape[0], dtype=matrix.dtype))
    return solve_definite(matrix, jnp.where(free[:, None], right, 0))


def solve_box_qp(H: Array, g: Array, low: Array, high: Array) -> tuple[Array, Array]:
    """The minimum of `1/2 u'H u + g'u` between bounds, and which entries are free.

    Projected Newton steps find the active bounds in a few iterations.

    Source: Bertsekas, 1982; Tassa, Mansard and Todorov, 2014.
    """
    m = g.shape[0]
    if m == 1:
        # For one control, the solution is the free minimum, clipped.
        ok = H[0] > 0
        u = jnp.clip(-g / jnp.where(ok, H[0], 1), low, high)
        return u, (u > low) & (u < high)
    slack = 10 * jnp.finfo(g.dtype).eps
    lengths = 0.5 ** jnp.arange(16.0, dtype=g.dtype)
    steep = jnp.diagonal(H)
    steep = jnp.where(steep > 0, steep, 1)
    gradient = lambda u: g + matvec(H, u)
    value = lambda u: jnp.sum(u * (g + gradient(u))) / 2

    def is_free(u, slope, near):
        held = (u <= low + near) & (slope > 0) | (u >= high - near) & (slope < 0)
        return ~held

    def body(state):
        u, _, count = state
        slope = gradient(u)
        # Entries that are near a bound and move towards it would shorten the Newton
        # step, so they are left out of it.
        plain = -slope / steep
        left = jnp.max(jnp.abs(jnp.clip(u + plain, low, high) - u))
        free = is_free(u, slope, jnp.minimum(left, 0.01 * (high - low)))
        newton, _ = solve_free(H, -slope[:, None], free)
        step = jnp.where(free, newton[:, 0], plain)
        # All step lengths at once, because they are few and cheap.
        tried = jnp.clip(u + lengths[:, None] * step, low, high)
        values = jax.vmap(value)(tried)
        best = tried[jnp.argmin(values)]
        lower = jnp.min(values) < value(u)
        after = jnp.where(lower, best, u)
        going = lower & (left > slack * (1 + jnp.max(jnp.abs(u))))
        return after, going, count + 1

    going = lambda state: state[1] & (state[2] < 10 * m)
    zero = jnp.clip(jnp.zeros_like(g), low, high)
    u, _, _ = lax.while_loop(going, body, (zero, jnp.asarray(True), 0))
    return u, is_free(u, gradient(u), 0.0)


@full_precision
def in_parallel(stages: Stages, mu: Array) -> Policy:
    """Solve the problem by associative scans, in logarithmic depth in the horizon.

    The regularisation adds `mu |du|^2 / 2` to the cost of each stage.

    Source: Sarkka and Garcia-Fernandez, 2023.
    """
    F, H, h, d, V, v = stages
    n = V.shape[0]
    A, B, q, r = F[..., :n], F[..., n:], h[:, :n], h[:, n:]
    Q, S, R = H[:, :n, :n], H[:, :n, n:], H[:, n:, n:]
    damped = R + mu * jnp.eye(B.shape[2], dtype=F.dtype)
    linear = dict(d=d, q=q, r=r, final_q=v)
    solution: Any = dre(
        A, B, Q, damped, S, final=V, **linear, parallel=True, throw=False
    )
    ok = jnp.all(jnp.isfinite(solution.K)) & jnp.all(jnp.isfinite(solution.k))
    parts = solution.X[1:], solution.p[1:], solution.K, solution.k
    X, p, K, k = (jnp.where(ok, part, 0) for part in parts)
    # The part of the gradient with respect to the control that comes from the
    # cost-to-go 1/2 x'X x + p'x of the next state.
    shift = 0 if d is None else jnp.einsum("tij,tj->ti", X, d)
    pushed = jnp.einsum("tji,tj->ti", B, p + shift)
    slope, curvature = predicted_change(stages, K, k)
    return Policy(K, k, r + pushed, jnp.max(jnp.abs(pushed)), slope, curvature, ok)


def predicted_change(stages: Stages, K: Array, k: Array) -> tuple[Array, Array]:
    """The slope and the curvature of the cost along the step, from the linear model."""
    F, H, h, d, V, v = stages

    def forward(dx, here):
        F, K, k, d = here
        # The linear model under du = -k - K dx, from dx = 0.
        z = jnp.concatenate([dx, -k - matvec(K, dx)])
        after = matvec(F, z)
        return after if d is None else after + d, z

    last, z = lax.scan(forward, jnp.zeros_like(v), (F, K, k, d))
    slope = jnp.sum(h * z) + v @ last
    curvature = jnp.einsum("ti,tij,tj->", z, H, z) + last @ V @ last
    return slope, curvature
