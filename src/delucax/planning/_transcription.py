"""A planning problem as a nonlinear program, by multiple shooting.

Its variables are the states and the controls, its equations the steps of the dynamics.
Its rows are the bounds and the constraints.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from .._jax import by_components, join_state, split_state, with_stores
from .._typing import Array
from ..math._linear_solve import full_precision, symmetric
from ..math._small import products_whole
from ..qp import Soft
from ._constraints import Row, rows_of
from ._multipliers import by_name, in_order, Multipliers
from ._problem import Problem


class Iterate(NamedTuple):
    """A trajectory, which need not follow the dynamics, with multipliers."""

    states: Array  # (T+1, n)
    controls: Array  # (T, m)
    costates: Array  # (T+1, n), multipliers of x_0 = start and x_{k+1} = F(x_k, u_k)
    sides: Array  # (2, T+1, rows), multipliers >= 0 of the upper and the lower sides


class Limits(NamedTuple):
    """The bounds and the weights of the rows.

    The rows of a stage are some of its variables `(x, u)`, followed by the values of
    the constraints. An equality has two equal bounds. All stages have the same number
    of rows: a row that a stage does not need has infinite bounds.
    """

    low: Array  # (T+1, rows)
    high: Array
    linear: Array  # the weights of violations; infinite for hard rows
    quadratic: Array
    bounded: tuple[int, int]
    """The variables that have rows, as a range: first, and last plus one."""
    is_soft: bool
    states: int
    """The number of rows that are bounds of states."""
    free: tuple[int, ...] = ()
    """The unknown entries of the first state."""
    again: int = 0
    """The number of last rows, which bound the controls a second time."""

    @property
    def own(self) -> int:
        """The number of rows that are bounds of variables."""
        first, last = self.bounded
        return last - first

    @property
    def hard(self) -> Array:
        """Whether each row is hard."""
        return ~(jnp.isfinite(self.linear) & jnp.isfinite(self.quadratic))

    def over(self, rows: Array) -> Array:
        """By how much each row is violated."""
        return jnp.maximum(jnp.maximum(rows - self.high, self.low - rows), 0)

    def broken(self, rows: Array) -> Array:
        """By how much each hard row is violated."""
        return jnp.where(self.hard, self.over(rows), 0)

    def penalty(self, rows: Array) -> Array:
        """The cost of the violated soft rows."""
        t, hard = self.over(rows), self.hard
        v, W = (jnp.where(hard, 0, a) for a in (self.linear, self.quadratic))
        return jnp.sum(t * (v + W * t / 2))

    def ends(self) -> tuple[Array, Array] | None:
        """The hard bounds of the controls, each of shape `(T, m)`; `None` without."""
        if self.own == self.states:
            return None
        controls = slice(self.states, self.own)
        hard = self.hard[:-1, controls]
        low = jnp.where(hard, self.low[:-1, controls], -jnp.inf)
        return low, jnp.where(hard, self.high[:-1, controls], jnp.inf)


class Values(NamedTuple):
    """The values of the problem at a trajectory."""

    cost: Array  # without the penalty of violated soft rows
    defects: Array  # (T+1, n), by how much each step misses the next state
    rows: Array  # (T+1, rows)


class Model(NamedTuple):
    """The values of the problem, and its derivatives with respect to `z = (x, u)`."""

    values: Values
    h: Array  # (T+1, N), the gradient of the cost
    F: Array  # (T, n, N), the Jacobian of the dynamics
    G: Array  # (T+1, p, N), the Jacobian of the constraints given by functions
    H: Array  # (T+1, N, N), the Hessian of the Lagrangian, or of the cost


def limits_of(problem: Problem, horizon: int) -> Limits:
    """The bounds and the weights of the rows of a problem."""
    n, m = problem.dynamics.state_size, problem.dynamics.control_size
    dtype, T, given = problem.x0.dtype, horizon, problem.constraints
    parts: list[tuple[Array, ...]] = []
    own = given and given.states, given and given.controls
    has_states, has_controls = own[0] is not None, own[1] is not None
    has_controls = has_controls or problem.bounds is not None
    # A row is either hard or soft, so soft limits next to hard bounds have own rows.
    again = m if problem.bounds is not None and isinstance(own[1], Soft) else 0
    free = () if problem.free is None else problem.free.entries
    begin = 0 if has_states else min(free, default=n)
    if begin < n:
        ends = _bounds(own[0], "states", T, n, dtype)
        parts.append(tuple(a[:, begin:] for a in _from_start(problem, ends)))
    if has_controls:
        value = None if again else own[1]
        low, high, *weights = _bounds(value, "controls", T, m, dtype)
        if problem.bounds is not None:
            always = tuple(jnp.broadcast_to(b, (T, m)) for b in problem.bounds)
            always = (
                jnp.pad(always[0], ((0, 1), (0, 0)), constant_values=-jnp.inf),
                (jnp.pad(always[1], ((0, 1), (0, 0)), constant_values=jnp.inf)),
            )
            low, high = jnp.maximum(low, always[0]), jnp.minimum(high, always[1])
        parts.append((low, high, *weights))
    soft = isinstance(own[0], Soft) or isinstance(own[1], Soft)
    if given is not None:
        args = problem.t0, problem.x0, jnp.zeros(m, dtype)
        rows = rows_of(given, False, args), rows_of(given, True, args[:2])
        soft = soft or any(row.weights is not None for row in sum(rows, []))
        stage, final = (_functions(part, dtype) for part in rows)
        size = max(stage.shape[1], final.shape[1])
        empty = jnp.array([-jnp.inf, jnp.inf, jnp.inf, jnp.inf], dtype)
        pad = lambda a: jnp.concatenate(
            [a, jnp.tile(empty[:, None], (1, size - a.shape[1]))], axis=1
        )
        each = jnp.tile(pad(stage)[:, None], (1, T, 1))
        parts.append(tuple(jnp.concatenate([each, pad(final)[:, None]], axis=1)))
    if again:
        parts.append(_bounds(own[1], "controls", T, m, dtype))
    blank = jnp.zeros((4, T + 1, 0), dtype)
    joined = [jnp.concatenate(a, axis=1) for a in zip(blank, *parts, strict=True)]
    return Limits(
        *joined,
        bounded=(begin, n + m if has_controls else n),
        is_soft=soft,
        states=n - begin,
        free=free,
        again=again,
    )


def _from_start(problem: Problem, ends: tuple[Array, ...]) -> tuple[Array, ...]:
    """The bounds of the states. At the first stage only unknown entries have bounds,
    which are hard."""
    none = -jnp.inf, jnp.inf, jnp.inf, jnp.inf
    if problem.free is None:
        return tuple(a.at[0].set(end) for a, end in zip(ends, none, strict=True))
    free, at = problem.free, np.array(problem.free.entries)
    low, high = jnp.maximum(ends[0][0, at], free.low), ends[1][0, at]
    first = low, jnp.minimum(high, free.high), jnp.inf, jnp.inf
    return tuple(
        a.at[0].set(end).at[0, at].set(own)
        for a, end, own in zip(ends, none, first, strict=True)
    )


def _functions(rows: list[Row], dtype: Any) -> Array:
    """The bounds and the weights of the values of functions, shape `(4, size)`."""
    columns = [jnp.zeros((4, 0), dtype)]
    for row in rows:
        weights = row.weights or (jnp.inf, jnp.inf)
        numbers = (0 if row.is_equality else -jnp.inf), 0, *weights
        fill = lambda a, k=row.size: jnp.broadcast_to(jnp.asarray(a, dtype), (k,))
        columns.append(jnp.stack([fill(a) for a in numbers]))
    return jnp.concatenate(columns, axis=1)


def _bounds(value: Any, name: str, T: int, size: int, dtype: Any) -> tuple[Array, ...]:
    """The bounds and weights of the states or the controls, each `(T+1, size)`."""
    points = T + 1 if name == "states" else T
    soft = isinstance(value, Soft)
    if value is None:
        value = -jnp.inf, jnp.inf
    given = (value.low, value.high, value.linear, value.quadratic) if soft else value
    shapes = (), (size,), (points, size)
    arrays = [jnp.asarray(a, dtype) for a in given]
    for array in arrays:
        if array.shape not in shapes:
            raise ValueError(
                f"Constraints: the bounds (and weights) of {name} must be numbers or "
                f"have shape {shapes[1]} or {shapes[2]}, got shape {array.shape}."
            )
    arrays = [jnp.broadcast_to(a, (points, size)) for a in arrays]
    if not soft:
        arrays += [jnp.full((points, size), jnp.inf, dtype)] * 2
    ends = -jnp.inf, jnp.inf, jnp.inf, jnp.inf
    if name == "states":
        return tuple(arrays)
    pad = ((0, 1), (0, 0))
    return tuple(
        jnp.pad(a, pad, constant_values=end)
        for a, end in zip(arrays, ends, strict=True)
    )


def _joined(problem: Problem, limits: Limits, z: Array, stage: Array, final: Array):
    """The rows along a trajectory `z`, shape `(T+1, N)`, with values of constraints."""
    first, last = limits.bounded
    size = limits.low.shape[1] - limits.own - limits.again
    pad = lambda c: jnp.pad(c, ((0, 0), (0, size - c.shape[1])))
    c = jnp.concatenate([pad(stage), pad(final[None])])
    again = [z[:, -limits.again :]] if limits.again else []
    return jnp.concatenate([z[:, first:last], c, *again], axis=1)


def _stacked(states: Array, controls: Array) -> Array:
    """States and controls as one array, shape `(T+1, N)`; the last control is zero."""
    return jnp.concatenate([states, jnp.pad(controls, ((0, 1), (0, 0)))], axis=1)


def measured(problem: Problem, limits: Limits, states: Array, controls: Array):
    """The values of the problem at a trajectory."""
    times = problem.times(controls.shape[0])
    reached = jax.vmap(problem.step)(times[:-1], states[:-1], controls, problem.w)
    defects = jax.vmap(problem.deviation)(reached, states[1:])
    defects = jnp.concatenate([problem.missed_start(states[0])[None], defects])
    stage, final = jnp.zeros_like(states[:-1, :0]), jnp.zeros_like(states[0, :0])
    if problem.constraints is not None:
        (stage, _), (final, _) = problem.constraints_along(states, controls)
    rows = _joined(problem, limits, _stacked(states, controls), stage, final)
    return Values(problem.total(states, controls), defects, rows)


@full_precision
@products_whole()
def expanded(
    problem: Problem,
    limits: Limits,
    at: Iterate,
    second_order: bool,
    share: Array | float = 1.0,
):
    """The values and the derivatives of the problem at an iterate.

    If `second_order`, the Hessian is that of the Lagrangian, with the multipliers times
    `share`. If not, it is that of the cost.
    """
    states, controls, costates, sides = at
    costates, sides = share * costates, share * sides
    n, T = states.shape[1], controls.shape[0]
    times, y = problem.times(T), (sides[0] - sides[1])[:, limits.own :]
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
        cost = lambda z: problem.cost(t, z[:n], z[n:]) + 0.0

        def values(z):
            values = stored(z, t, w), constraints(z, t)
            return values, values

        # One forward pass differentiates everything: the Jacobian of the gradient is
        # the Hessian.
        def terms(z):
            h = slope = jax.grad(cost)(z)
            if not second_order:
                after, c = values(z)[0]
                return (after, c, slope), (after, c, h, cost(z))
            after, pull = jax.vjp(lambda z: stored(z, t, w), z)
            c, push = jax.vjp(lambda z: constraints(z, t), z)
            slope = h - pull(p)[0] + push(y[: c.size])[0]
            return (after, c, slope), (after, c, h, cost(z))

        # The same without reverse mode, in which the loops of events take long to
        # compile.
        def gradient(z):
            h = jax.grad(cost)(z)
            (F, G), (after, c) = jax.jacfwd(values, has_aux=True)(z)
            return h - p @ F + y[: c.size] @ G, (F, G, after, c, h, cost(z))

        if second_order and problem.dynamics.event_names:
            H, (F, G, *rest) = jax.jacfwd(gradient, has_aux=True)(z)
            return F, G, H, *rest
        (F, G, H), rest = jax.jacfwd(terms, has_aux=True)(z)
        return F, G, H, *rest

    each = z, times[:-1], problem.w, costates[1:], y[:-1]
    F, G, H, reached, c, h, cost = jax.vmap(stage)(*each)

    def final(x):
        cost = lambda x: problem.cost.final(times[-1], x) + 0.0
        h = slope = jax.grad(cost)(x)
        c, push = jax.vjp(final_constraints, x)
        if second_order:
            slope = h + push(y[-1, : c.size])[0]
        return (c, slope), (c, h, cost(x))

    (G_end, V), (c_end, v, last) = jax.jacfwd(final, has_aux=True)(states[-1])
    defects = jax.vmap(problem.deviation)(reached, states[1:])
    defects = jnp.concatenate([problem.missed_start(states[0])[None], defects])
    rows = _joined(problem, limits, _stacked(states, controls), c, c_end)
    values = Values(jnp.sum(cost) + last, defects, rows)
    N, size = z.shape[1], rows.shape[1] - limits.own - limits.again
    pad = lambda a, *sizes: jnp.pad(
        a, [(0, s - k) for s, k in zip(sizes, a.shape, strict=True)]
    )
    stack = lambda a, b: jnp.concatenate([a, b[None]])
    G = stack(pad(G, T, size, N), pad(G_end, size, N))
    if limits.again:
        picks = jnp.tile(jnp.eye(N, dtype=z.dtype)[-limits.again :], (T + 1, 1, 1))
        G = jnp.concatenate([G, picks], axis=1)
    model = Model(
        values,
        stack(h, pad(v, N)),
        F,
        G,
        symmetric(stack(H, pad(V, N, N))),
    )
    return jax.tree.map(lambda a: a.astype(states.dtype), model)


def slopes(problem: Problem, limits: Limits, at: Iterate) -> tuple[Array, Array, Array]:
    """The gradient of the part of the Lagrangian that depends on the problem, the
    defects and the rows, at fixed multipliers. They are to be differentiated with
    respect to the problem."""
    states, controls, costates, sides = at
    times = problem.times(controls.shape[0])
    y = (sides[0] - sides[1])[:, limits.own :]

    def lagrangian(states, controls):
        steps = jax.vmap(problem.step)(times[:-1], states[:-1], controls, problem.w)
        total = problem.total(states, controls) - jnp.sum(costates[1:] * steps)
        if problem.constraints is None:
            return total
        (stage, _), (final, _) = problem.constraints_along(states, controls)
        total = total + jnp.sum(y[:-1, : stage.shape[1]] * stage)
        return total + jnp.sum(y[-1, : final.size] * final)

    hx, hu = jax.grad(lagrangian, (0, 1))(states, controls)
    values = measured(problem, limits, states, controls)
    return _stacked(hx, hu), values.defects, values.rows


def multipliers_of(problem: Problem, limits: Limits, at: Iterate) -> Multipliers:
    """The multipliers of an iterate, by the names of the constraints."""
    upper, lower = at.sides
    n, own, args = limits.states, limits.own, (problem.t0, problem.x0, at.controls[0])
    z = (upper - lower)[:, own:]
    return Multipliers(
        by_name(problem.constraints, False, args, z[:-1]),
        by_name(problem.constraints, True, args[:2], z[-1]),
        (lower[:, :n], upper[:, :n]) if limits.bounded[0] == 0 else None,
        (lower[:-1, n:own], upper[:-1, n:own]) if own > n else None,
        at.costates,
    )


def with_multipliers(
    problem: Problem, limits: Limits, at: Iterate, given: Multipliers | None
) -> Iterate:
    """The iterate with the given multipliers. Those that do not fit become zero."""
    if given is None:
        return at
    blank = jnp.zeros_like(at.sides)
    n, own, args = limits.states, limits.own, (problem.t0, problem.x0, at.controls[0])
    c = blank[0, :, own:]
    stage = in_order(problem.constraints, False, args, given.stage, c[:-1])
    final = in_order(problem.constraints, True, args[:2], given.final, c[-1])
    z = c.at[:-1, : stage.shape[1]].set(stage).at[-1, : final.size].set(final)
    x, u = (
        pair if pair is not None and pair[0].shape == like.shape else (like, like)
        for pair, like in (
            (given.states, blank[0, :, :n]),
            (given.controls, blank[0, :-1, n:own]),
        )
    )
    sides = [
        jnp.concatenate([x, jnp.pad(u, ((0, 1), (0, 0))), jnp.maximum(y, 0)], axis=1)
        for x, u, y in zip(x, u, (-z, z), strict=True)
    ]
    costates = given.costates
    if costates is None or costates.shape != at.costates.shape:
        costates = jnp.zeros_like(at.costates)
    return at._replace(costates=costates, sides=jnp.stack(sides[::-1]))
