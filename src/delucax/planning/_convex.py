"""A convex cost with the same minimum along linear dynamics.

A quadratic program needs a convex cost, but the Hessian of the Lagrangian may not be
convex. The cost-to-go of the Riccati recursion is therefore subtracted from each stage
and added to the stage before. This does not change the cost of any trajectory. The cost
of each stage is then convex if the problem is convex along its dynamics.
"""

from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import lax

from .._typing import Array
from ._lq import apply, product
from ._transcription import Limits, Model


STIFF = 10.0
"""The weight of active rows, relative to the largest entry of H and h."""
FIRM = 1e6
"""The weight of rows that the feedback must keep, relative to the same entry."""
_TRIES = 20
"""The most tries to make the cost convex."""


class Convex(NamedTuple):
    """The convex cost: the squared distance from the feedback `u = -k - K x`, weighted
    by the Hessian of the controls. Its costates differ from the true ones by `P x + s`.
    """

    H: Array
    h: Array
    P: Array  # (T+1, n, n)
    s: Array  # (T+1, n)
    K: Array  # (T, m, n)
    shift: Array  # the largest number that was added to a pivot


class Held(NamedTuple):
    """The active rows, according to their multipliers."""

    rows: Array
    """Whether each row is active."""
    target: Array
    """The change of each active row that moves it to its bound."""
    price: Array | float = 0.0
    """The price of the squared distance from the target, as part of the cost."""


class Weights(NamedTuple):
    """The weights of the squares that are added to the cost: of the active rows, of all
    variables, and of the controls."""

    rows: Array
    variables: Array
    controls: Array


def held_rows(limits: Limits, sides: Array, low: Array, high: Array) -> Held:
    """The active rows. `low` and `high` are the bounds of their changes."""
    upper, lower = sides
    at_high, at_low = upper > jnp.abs(high), lower > jnp.abs(low)
    # A violated soft row is not active: it is part of the cost.
    v = jnp.where(limits.hard, jnp.inf, limits.linear)
    held = (at_high | (low == high)) & (upper < v) | at_low & (lower < v)
    held = held & (jnp.abs(upper - lower) < v)
    target = jnp.where(at_low, low, high)
    return Held(held, jnp.where(held, target, 0))


def convexified(
    limits: Limits,
    model: Model,
    held: Held,
    last: Array,
    controls: Array,
    is_firm: Array | bool = False,
) -> tuple[Convex, Weights]:
    """The convex cost, and the weights of the squares that were added.

    If the cost is not convex along the dynamics, the squares of the active rows are
    added, as in an augmented Lagrangian, and then a multiple of the identity. If
    `is_firm`, only the squares of the active rows are added, with a weight that makes
    the feedback keep these rows.

    Source: Waechter and Biegler, 2006 (the multiple, which starts from the `last` one).
    """
    # With h, because a linear cost has no Hessian before there are multipliers.
    largest = jnp.maximum(jnp.max(jnp.abs(model.H)), jnp.max(jnp.abs(model.h)))
    least = 1e-4 * largest
    firm = jnp.where(is_firm, FIRM * largest, 0)

    def again(carry):
        k, weights, _ = carry
        stiff = jnp.where(k > 0, STIFF * largest, firm)
        weights = weights._replace(rows=stiff)
        convex = made_convex(limits, model, held, weights)
        wanted = jnp.where(last > 0, jnp.maximum(1e-6 * least, last / 3), least)
        delta = weights.variables
        more = jnp.where(k == 0, 0, jnp.where(delta > 0, 8 * delta, wanted))
        delta = jnp.where(convex.shift > 0, more, delta)
        return k + 1, weights._replace(variables=delta), convex

    def going(carry):
        k, _, convex = carry
        return (k == 0) | ((k < _TRIES) & (convex.shift > 0) & ~jnp.asarray(is_firm))

    plain = Weights(jnp.zeros_like(least), jnp.zeros_like(least), controls)
    (T, n, N), dtype = model.F.shape, model.h.dtype
    zeros = lambda *shape: jnp.zeros(shape, dtype)
    empty = Convex(
        zeros(T + 1, N, N),
        zeros(T + 1, N),
        zeros(T + 1, n, n),
        zeros(T + 1, n),
        zeros(T, N - n, n),
        zeros(),
    )
    _, weights, convex = lax.while_loop(
        going, again, (jnp.zeros((), int), plain, empty)
    )
    return convex, weights


def weight_of(limits: Limits, model: Model, held: Held, weights: Weights) -> Array:
    """The weight of the squared distance of each row from its target."""
    norm = jnp.sum(model.G**2, axis=2)
    norm = jnp.pad(norm, ((0, 0), (limits.own, 0)), constant_values=1)
    weight = weights.rows * held.rows / jnp.where(norm > 0, norm, 1) + held.price
    return weight.astype(model.h.dtype)


def with_squares(
    limits: Limits,
    model: Model,
    held: Held,
    weights: Weights,
    sides: Array,
    change: Array,
) -> Array:
    """The multipliers of the rows in the problem without added squares. A square acts
    like a part of the multiplier if the `change` of its row misses the target."""
    weight = weight_of(limits, model, held, weights)
    push = sides[0] - sides[1]
    total = push + weight * (change - held.target)
    # The multiplier of an inequality must keep its sign.
    free = (limits.low == limits.high) | (held.price > 0)
    total = jnp.where(free | (push * total > 0), total, 0)
    return jnp.where(weight > 0, jnp.maximum(jnp.stack([total, -total]), 0), sides)


def made_convex(limits: Limits, model: Model, held: Held, weights: Weights) -> Convex:
    """The convex cost. If the Hessian of the controls is not positive definite, its
    pivots are changed so that it is.

    Source: Verschueren et al., 2017 (the idea); Gill and Murray, 1974 (the pivots).
    """
    (_, n, N), dtype = model.F.shape, model.h.dtype
    first, last = limits.bounded
    eye = jnp.eye(N, dtype=dtype)
    weight = weight_of(limits, model, held, weights)
    own, general = jnp.split(weight, [limits.own], axis=1)
    at_own, at_general = jnp.split(held.target, [limits.own], axis=1)
    own, at_own = (jnp.pad(a, ((0, 0), (first, N - last))) for a in (own, at_own))
    over = weights.variables + weights.controls * (jnp.arange(N) >= n)
    H = model.H + (own + over)[:, :, None] * eye
    weighted = general[:, :, None] * model.G
    H = H + jnp.sum(weighted[:, :, :, None] * model.G[:, :, None], axis=1)
    h = model.h - own * at_own - jnp.sum(weighted * at_general[:, :, None], axis=1)

    def back(carry, here):
        P, s = carry
        F, H, h, d = here
        M = H + product(F.T, product(P, F))
        (P, s), cost, K, added = _chosen(M, h + apply(F.T, s + apply(P, d)), n)
        return (P, s), (*cost, P, s, K, added)

    end = H[-1, :n, :n], h[-1, :n]
    xs = model.F, H[:-1], h[:-1], model.values.defects[1:]
    at_start, (H, h, Ps, ss, K, shift) = lax.scan(back, end, xs, reverse=True)
    if limits.free:
        # The free part of the first state is also chosen, to minimise the cost-to-go.
        order = np.array([i for i in range(n) if i not in limits.free])
        given, order = len(order), np.array([*order, *limits.free], int)
        P, s = at_start[0][order][:, order], at_start[1][order]
        (P0, s0), (H0, h0), _, added = _chosen(P, s, given)
        at = order[:given]
        H = H.at[0, order[:, None], order].add(H0)
        h = h.at[0, order].add(h0)
        Ps = Ps.at[0].set(0).at[0, at[:, None], at].set(P0)
        ss = ss.at[0].set(0).at[0, at].set(s0)
        shift = jnp.maximum(jnp.max(shift), added)
    stack = lambda a, b: jnp.concatenate([a, b[None]])
    ends = stack(H, jnp.zeros((N, N), dtype)), stack(h, jnp.zeros(N, dtype))
    return Convex(*ends, stack(Ps, end[0]), stack(ss, end[1]), K, jnp.max(shift))


def _chosen(M: Array, g: Array, n: int) -> tuple[Any, Any, Array, Array]:
    """Minimise the cost `1/2 z'M z + g'z` over all but the first `n` entries of `z`.

    Returns the minimum as a cost of the first `n` entries; the convex cost of other
    choices; the gain; and the largest number that was added to a pivot.
    """
    Quu, Qux, Qu = M[n:, n:], M[n:, :n], g[n:]
    solved, added = _definite(Quu, jnp.concatenate([Qux, Qu[:, None]], axis=1))
    K, k = solved[:, :n], solved[:, n]
    P, s = M[:n, :n] - product(Qux.T, K), g[:n] - apply(Qux.T, k)
    whole = jnp.concatenate([K, jnp.eye(len(Quu), dtype=M.dtype)], axis=1)
    weighted = product(Quu + jnp.diag(added), whole)
    cost = product(whole.T, weighted), apply(weighted.T, k)
    return ((P + P.T) / 2, s), cost, K, jnp.max(added, initial=0)


def _definite(matrix: Array, right: Array) -> tuple[Array, Array]:
    """`(matrix + diag(added))^-1 right` and `added`. Each pivot becomes its absolute
    value, and at least a small positive number."""
    m = matrix.shape[0]
    largest = jnp.max(jnp.abs(matrix), initial=0)
    least = jnp.finfo(matrix.dtype).eps ** 0.5 * jnp.where(largest > 0, largest, 1)
    if m == 0:
        return right, jnp.zeros(0, matrix.dtype)
    rows = list(jnp.concatenate([matrix, right], axis=1))
    added = []
    for i in range(m):
        pivot = rows[i][i]
        wanted = jnp.maximum(jnp.abs(pivot), least)
        added.append(wanted - pivot)
        rows[i] = rows[i].at[i].set(wanted) / wanted
        for j in range(i + 1, m):
            rows[j] = rows[j] - rows[j][i] * rows[i]
    for i in reversed(range(m)):
        for j in range(i + 1, m):
            rows[i] = rows[i] - rows[i][j] * rows[j]
    return jnp.stack(rows)[:, m:], jnp.stack(added)
