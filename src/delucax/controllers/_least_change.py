"""The smallest change of a control that satisfies affine conditions and bounds.

`minimise 1/2 sum_i weight_i (u_i - n_i)^2` such that `s + A (u - n) >= 0` and
`low <= u <= high`. With one active condition, the solution is the zero of an
increasing, piecewise linear function of one multiplier. Otherwise a small quadratic
program is solved.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax

from .. import qp
from .._jax import value_and_jacobians
from .._results import choose, Result, RESULTS
from .._typing import Array
from ..math._small import dot, matvec


_ELASTIC = 0.4
"""In the quadratic program, the linear price of a hard condition is the unit of
rounding to minus this power. That is above the multipliers of a feasible program,
unless two conditions are almost opposed."""


_LEAST, _MOST = 0.3, 30.0
"""Bounds of the estimated curvature of the Lagrangian, relative to that of the cost."""


class Task(NamedTuple):
    """A nominal control, its bounds, and what changes and missed conditions cost.

    A condition without a `price` is hard. A condition with a price may be missed by
    `d`, which costs `1/2 price d^2`.
    """

    nominal: Array
    low: Array | None
    high: Array | None
    weight: Array
    price: Array | None


def least_change(task: Task, s: Array, A: Array) -> Array:
    """The control under conditions whose values at the nominal control are `s`."""
    if len(s) == 1:
        price = None if task.price is None else task.price[0]
        return _for_one(task, s[0], A[0], price)
    return _for_several(task, s, A)


def missed(task: Task, s: Array, A: Array, u: Array) -> tuple[Array, Array]:
    """The amount by which each condition is missed, and the size of its terms."""
    n = task.nominal
    over = jnp.maximum(-(s + matvec(A, u - n)), 0)
    size = jnp.abs(s - matvec(A, n)) + matvec(jnp.abs(A), jnp.abs(u) + jnp.abs(n))
    return over, size


def judged(task: Task, over: Array, size: Array, converged: Any) -> Result:
    """The status of a control that misses conditions by `over`."""
    eps = float(jnp.finfo(over.dtype).eps)
    # `~(<=)` instead of `>`, so that a NaN is a failure.
    fails = ~(over <= eps**0.5 * size + 100 * eps)
    if task.price is not None:
        fails = fails & ~jnp.isfinite(task.price)
    result = choose(jnp.any(fails), RESULTS.no_feasible_point, RESULTS.successful)
    if converged is not True:
        result = choose(jnp.any(fails) & ~converged, RESULTS.not_converged, result)
    return choose(jnp.any(jnp.isnan(over)), RESULTS.ill_posed, result)


def _for_one(task: Task, s: Array, a: Array, price: Array | None) -> Array:
    """The control under one condition, in closed form."""
    n, low, high, weight, _ = task
    give = jnp.zeros((), s.dtype) if price is None else 1 / price
    way = a / weight
    if low is None or high is None:
        # The 0 is chosen only if s >= 0 is true, so that a NaN is passed on.
        push = jnp.where(s >= 0, 0, -s) / _unless_zero(dot(a, way) + give)
        return n + push * way
    # The multipliers at which each control enters and leaves its bounds.
    ahead, moves = jnp.where(way > 0, high, low), way != 0
    behind = jnp.where(way > 0, low, high)
    pace = jnp.where(moves, way, 1)
    enters, leaves = (jnp.maximum((end - n) / pace, 0) for end in (behind, ahead))
    rest = jnp.clip(n, low, high)
    # An infinite end is never held. In the branch that is not taken it would make the
    # derivative NaN.
    behind = jnp.where(moves & jnp.isfinite(behind), behind, rest)

    def is_short(push):
        """Whether the condition is not met yet at this multiplier."""
        value = s + dot(a, jnp.clip(n + push * way, low, high) - n) + push * give
        return ~(value >= 0)

    # Each control is classified by the sign at its own two multipliers. Sorting all
    # multipliers would be wrong if rounding differs between copies of one of them.
    finite = jnp.isfinite(leaves)
    has_entered = moves & jax.vmap(is_short)(enters)
    has_left = moves & finite & jax.vmap(is_short)(jnp.where(finite, leaves, 0))
    free = has_entered & ~has_left
    held = jnp.where(has_left, ahead, behind)
    level = s + dot(a, jnp.where(free, 0, held - n))
    slope = dot(a, jnp.where(free, way, 0)) + give
    push = jnp.maximum(-level / _unless_zero(slope), 0)
    at_rest = s + dot(a, rest - n)
    u = jnp.where(free, jnp.clip(n + push * way, low, high), held)
    return jnp.where(at_rest >= 0, rest, u + 0 * at_rest)


def _unless_zero(size: Array) -> Array:
    """`size`, or 1 if it is zero, as a divisor."""
    return jnp.where(size > jnp.finfo(size.dtype).tiny, size, 1)


def _for_several(task: Task, s: Array, A: Array) -> Array:
    """The control under several conditions.

    If the control for one of them meets the others, it is the solution. Otherwise a
    quadratic program is solved.
    """
    price = task.price
    one = lambda s, a, p: _for_one(task, s, a, p)
    tried = jax.vmap(one, in_axes=(0, 0, None if price is None else 0))(s, A, price)
    over, size = jax.vmap(lambda u: missed(task, s, A, u))(tried)
    met = over <= 16 * jnp.finfo(s.dtype).eps * size
    if price is not None:
        met = met | (jnp.eye(len(s), dtype=bool) & jnp.isfinite(price))
    optimal = jnp.all(met, 1)
    chosen = tried[jnp.argmax(optimal)]
    u = lax.cond(jnp.any(optimal), lambda: chosen, lambda: _by_program(task, s, A))
    return jnp.where(jnp.all(jnp.isfinite(s)), u, jnp.nan)


def _by_program(task: Task, s: Array, A: Array) -> Array:
    """The control from a quadratic program that always has a solution.

    A hard condition may be missed, but at a linear price so high that it is missed only
    if there is no other solution.
    """
    n, low, high, weight, price = task
    root = jnp.sqrt(weight)
    A = A / root
    size = jnp.sum(A * A, 1)
    is_seen = size > jnp.finfo(size.dtype).tiny
    length = jnp.sqrt(jnp.where(is_seen, size, 1))
    # The unit is the largest change that one condition needs. The solution does not
    # depend on it, so no derivative goes through it.
    far = lax.stop_gradient(jnp.max(jnp.where(is_seen, -s / length, 0)))
    far = jnp.where(far > 0, far, 1)
    lower = jnp.where(is_seen, -s / (length * far), -jnp.inf)
    linear: Any = jnp.full_like(s, jnp.finfo(s.dtype).eps ** -_ELASTIC)
    quadratic = jnp.zeros_like(s)
    if price is not None:
        soft = jnp.isfinite(price)
        linear = jnp.where(soft, 0, linear)
        quadratic = jnp.where(soft, jnp.where(soft, price, 0) * size, 0)
    rows = qp.Rows(A / length[:, None], lower=lower, linear=linear, quadratic=quadratic)

    def scaled(end):
        # An infinite end would make the derivative by the weights NaN.
        finite = jnp.isfinite(end)
        return jnp.where(finite, root * (jnp.where(finite, end, n) - n) / far, end)

    bounds = None
    if low is not None and high is not None:
        bounds = scaled(low), scaled(high)
    P, q = jnp.eye(len(n), dtype=s.dtype), jnp.zeros(len(n), s.dtype)
    # Tighter than the default, because bounds may be large in this unit.
    tol = float(jnp.finfo(s.dtype).eps) ** 0.625
    problem = qp.Dense(P, q, bounds=bounds, rows=rows)
    solution = qp.solve(problem, rtol=tol, atol=tol, throw=False)
    u = n + far * solution.x / root
    return u if low is None else jnp.clip(u, low, high)


def least_change_sequentially(
    task: Task, conditions: Callable[[Array], Array], most: int
) -> Any:
    """The control under conditions that are not affine in it.

    The conditions are linearised at a control and solved for the next one, until the
    control stays. The curvature of the Lagrangian is a multiple of the weights,
    estimated from the last two steps. A multiple of 1, for the cost alone, need not
    converge.
    """
    n, dtype = task.nominal, task.nominal.dtype
    close = jnp.finfo(dtype).eps ** 0.75

    def next_of(u, curvature):
        c, (A,) = value_and_jacobians(conditions, u)
        aim = u + (n - u) / curvature
        price = None if task.price is None else task.price / curvature
        now = task._replace(nominal=aim, price=price)
        return least_change(now, c + A @ (aim - u), A)

    def is_on(carry):
        u, step, _, _, count = carry
        moves = ~(jnp.max(jnp.abs(step)) <= close * (1 + jnp.max(jnp.abs(u))))
        return (count == 0) | (moves & (count < most) & jnp.all(jnp.isfinite(u)))

    def another(carry):
        u, last, curvature, pull, count = carry
        after = next_of(u, curvature)
        step = after - u
        # The curvature: the change of the pull to n along the last step.
        size = dot(last, last)
        estimate = dot(pull - curvature * step, last) / jnp.where(size > 0, size, 1)
        new = jnp.where(size > 0, jnp.clip(estimate, _LEAST, _MOST), 1)
        return after, step, new.astype(dtype), curvature * step, count + 1

    def iterated(_, start):
        none = jnp.zeros_like(start)
        first = start, none, jnp.ones((), dtype), none, jnp.zeros((), int)
        u, step, _, _, count = lax.while_loop(is_on, another, first)
        return u, (count, jnp.max(jnp.abs(step)))

    def tangent(linear, y):
        return jnp.linalg.solve(jax.jacfwd(linear)(jnp.zeros_like(y)), y)

    start = lax.stop_gradient(n)
    change = lambda u: next_of(u, 1.0) - u
    u, (count, step) = lax.custom_root(change, start, iterated, tangent, has_aux=True)
    converged = step <= jnp.sqrt(close) * (1 + jnp.max(jnp.abs(u)))
    c, (A,) = value_and_jacobians(conditions, u)
    size = jnp.abs(c) + jnp.abs(A) @ (jnp.abs(u) + jnp.abs(n))
    return u, jnp.maximum(-c, 0), size, count, converged
