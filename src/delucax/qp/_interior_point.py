"""The interior-point method: one loop for every form of a program.

The conditions of optimality are embedded in a homogeneous system, whose solutions are
either a solution of the program (`tau > 0`) or a certificate that there is none
(`tau = 0`):

    H x + q tau + F'p + G'z = 0,   F x = f tau,   G x - t + s = h tau,
    W t + v tau = z + m,   kappa + q'x + v't + f'p + h'z + (x'H x + t'W t) / tau = 0,
    s z = 0,   t m = 0,   tau kappa = 0,   and s, z, t, m, tau, kappa >= 0.

The violation `t` of a soft side and its multiplier `m` are eliminated, so that a soft
side costs no more than a hard one: in a linear step it is a spring of compliance
`1 / (W + m / t)`, in series with `s / z`, that of the barrier.

Source: Mehrotra, 1992; Andersen and Ye, 1999 (the embedding); Goulart and Chen, 2024
(with a quadratic cost).
"""

import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax

from .._typing import Array, BoolScalar, Scalar
from ._form import AbstractForm, both, Scaling, Sides, signed


_TO_BOUNDARY = 0.99
"""The share of the step to the boundary that is taken."""
_NEGLIGIBLE = 1e-2
"""So much of the tolerance is no reason to refine a linear system."""
_PATIENCE = 5
"""It ends after so many steps without a better iterate: rounding is reached."""


class Iterate(NamedTuple):
    """A point of the embedding, or a direction. All vectors stand in one, so that what
    is done to each of their entries is one loop: `x, p, z, s`, and `t, m` if there are
    soft sides."""

    v: Array
    tau: Scalar
    kappa: Scalar


class Residuals(NamedTuple):
    """What is left of each line of the embedding, and how far it is from the ends."""

    x: Array
    p: Array
    z: Array
    t: Array
    tau: Scalar
    Hx: Array
    products: Scalar  # s'z + t'm + tau kappa
    linear: Scalar  # the worst of the lines `x` and `p`, over what is allowed, times tau
    measured: Array
    """Of the program in the units of the user: what is left of the primal and the dual,
    the complementarity, and the gap."""
    errors: Array
    """The worst of them over what is allowed; that of the certificate that the program
    is infeasible, and of the one that it is unbounded."""
    gains: Array
    """The support of the first certificate and the slope of the second, scaled."""


class Tolerances(NamedTuple):
    """Residuals may be `atol + rtol * scale`; those of a certificate `certificate`."""

    atol: Array
    rtol: Array
    certificate: Array


class Outcome(NamedTuple):
    """The best point in the units of the user, and what is known of it."""

    x: Array
    p: Array
    z: Array
    iterate: Iterate
    measured: Array
    errors: Array
    gains: Array
    iterations: Array


class Method(NamedTuple):
    """A program, the same one scaled, and its sides."""

    form: AbstractForm
    scaled: AbstractForm
    scaling: Scaling
    own_sides: Sides
    sides: Sides
    tolerances: Tolerances

    @property
    def is_soft(self) -> bool:
        """Whether a side may be violated."""
        return self.form.soft is not None

    def apart(self, v: Array) -> list[Array]:
        """`x, p, z, s, t, m` of a vector; the last two are zero without soft sides."""
        shapes = [self.form.q.shape, self.form.f.shape, *(4 * (self.sides.h.shape,))]
        parts, end = [], 0
        for shape in shapes if self.is_soft else shapes[:4]:
            start, end = end, end + math.prod(shape)
            parts.append(v[start:end].reshape(shape))
        return parts if self.is_soft else [*parts, *(2 * (jnp.zeros((), v.dtype),))]

    def joined(self, *parts: Array) -> Array:
        """The vector of `x, p, z, s, t, m`."""
        count = 6 if self.is_soft else 4
        return jnp.concatenate([jnp.ravel(part) for part in parts[:count]])

    def point(self, at: Iterate) -> tuple[Array, Array, Array]:
        """`x`, `p` and `z` in the units of the user."""
        D, E, R, c = self.scaling
        x, p, z, *_ = self.apart(at.v / at.tau)
        return x * D, p * E / c, z * R / c


def _largest(*arrays: Array) -> list[Scalar]:
    """The largest entry in magnitude of each of some arrays of one shape, in one loop.
    """
    stacked = jnp.abs(jnp.stack(arrays))
    return list(jnp.max(stacked, axis=range(1, stacked.ndim), initial=0))


def _sums(*arrays: Array) -> list[Scalar]:
    """The sum of each of some arrays of one shape."""
    stacked = jnp.stack(arrays)
    return list(jnp.sum(stacked, axis=range(1, stacked.ndim)))


def evaluated(method: Method, at: Iterate) -> Residuals:
    """The residuals of the program as the user gave it, from which those of the
    embedding of the scaled one follow: all scales are powers of two."""
    form, sides = method.form, method.own_sides
    D, E, R, c = method.scaling
    atol, rtol, least = method.tolerances
    tau = at.tau
    x, p, z = method.point(at)
    _, _, scaled_z, s, t, m = method.apart(at.v)
    t_own = t / (R * tau)
    Hx, reached = form.hessian(x), form.equations(x)
    pulled = form.equations_transposed(p) + form.rows_transposed(signed(z))
    row = jnp.where(sides.active, both(form.rows(x)) - t_own, 0)
    left_x, left_p, over = Hx + form.q + pulled, reached - form.f, row - sides.h
    violated = jnp.where(sides.equality, over, jnp.maximum(over, 0))
    # A direction of recession does not violate the bounds 0.
    outward = jnp.where(sides.equality, row, jnp.maximum(row, 0))
    slack = jnp.where(sides.inequality, z * jnp.maximum(-over, 0), 0)

    square, slope, x_size = _sums(x * Hx, x * form.q, jnp.abs(x))
    lift, p_size = _sums(form.f * p, jnp.abs(p))
    products, push, z_size = _sums(s * scaled_z, sides.h * z, jnp.abs(z))
    dual, *x_terms, pull, flat = _largest(
        left_x, Hx, form.q, pulled, pulled * D, Hx * D
    )
    missed, p_term, drift = _largest(left_p, form.f, reached * E)
    violated, *z_terms, outward, product = _largest(
        violated, row, sides.h, outward * R, slack
    )
    left_t, support = t, push
    if method.is_soft:
        bent = sides.W * t_own
        slack_t = jnp.where(sides.soft, bent + sides.v - z, 0)
        left_t = jnp.where(sides.soft, slack_t * c * tau / R - m, 0)
        # A soft side has no part in a certificate.
        yielding = jnp.where(sides.soft, z, 0)
        resisted = pulled - form.rows_transposed(signed(yielding))
        (pull,) = _largest(resisted * D)
        costs, squares, extra, given = _sums(
            sides.v * t_own, bent * t_own, t * m, yielding * sides.h
        )
        spring, held, bend = _largest(
            jnp.minimum(slack_t, 0), slack_t * t_own, bent / R
        )
        slope, square, products = slope + costs, square + squares, products + extra
        dual, product = jnp.maximum(dual, spring), jnp.maximum(product, held)
        flat, support = jnp.maximum(flat, bend), push - given
    gap = square + slope + lift + push
    products = products + tau * at.kappa

    # Each is compared with the terms that cancel in it.
    terms = jnp.max(jnp.abs(jnp.stack([square, slope, lift, push])))
    found = jnp.stack([violated, missed, dual, product, jnp.abs(gap)])
    rows, gradient = jnp.max(jnp.stack(z_terms)), jnp.max(jnp.stack(x_terms))
    scales = jnp.stack([rows, jnp.maximum(rows, p_term), gradient, terms, terms])
    errors = found / (atol + rtol * scales)
    # A certificate is judged in the scaled problem, whose units mean nothing. It must
    # hold with all data off by the tolerance too: what a tolerance away is feasible has
    # a solution.
    unit = c * tau
    gains = jnp.stack([lift + support, slope])
    relaxed = unit * (gains + (atol + rtol) * jnp.stack([p_size + z_size, x_size]))
    worst = jnp.maximum(jnp.maximum(flat * c, drift), outward)
    failings = tau * jnp.stack([pull * c, worst])
    certificates = jnp.where(relaxed < 0, failings / (least * -relaxed), jnp.inf)
    measured = jnp.concatenate([jnp.maximum(found[:1], found[1:2]), found[2:]])
    z_left = jnp.where(method.sides.active, R * tau * over + s, 0)
    return Residuals(
        unit * D * left_x,
        tau * E * left_p,
        z_left,
        left_t,
        at.kappa + unit * gap,
        unit * D * Hx,
        products,
        tau * jnp.maximum(errors[1], errors[2]),
        measured,
        jnp.concatenate([jnp.max(errors)[None], certificates]),
        gains,
    )


class System(NamedTuple):
    """The linear system of a step: its factors, and the compliance of each side, as it
    is and as it is factorised."""

    factors: object
    compliance: Array
    regularised: Array


def assembled(form: AbstractForm, sides: Sides, compliance: Array) -> System:
    """Factorise `[[H, F', G'], [F, 0, 0], [G, 0, -compliance]]`."""
    # An equation has no compliance, which refinement restores. Its rate is the sum of
    # this and of rounding over this, in the scaled problem.
    soft = jnp.asarray(jnp.finfo(form.q.dtype).eps ** 0.5, form.q.dtype)
    compliance = jnp.where(sides.equality, 0, compliance)
    regularised = jnp.where(sides.equality, soft, compliance)
    regularised = jnp.where(sides.active, regularised, 1)
    weight = jnp.sum(jnp.where(sides.active, 1 / regularised, 0), axis=0)
    return System(form.factorise(weight), compliance, regularised)


def solved(form, sides: Sides, system: System, right, passes: Array | int):
    """The solution `(x, p, z)` of the linear system, in so many passes."""
    active = sides.active

    def once(right):
        x, p, z = right
        push = jnp.where(active, z / system.regularised, 0)
        x = x + form.rows_transposed(signed(push))
        x, p = form.solve(system.factors, x, p)
        z = (both(form.rows(x)) - z) / system.regularised
        return x, p, jnp.where(active, z, 0)

    def error(solution):
        x, p, z = solution
        pulled = form.equations_transposed(p) + form.rows_transposed(signed(z))
        stretched = both(form.rows(x)) - system.compliance * z
        made = form.hessian(x) + pulled, form.equations(x), stretched
        left = jax.tree.map(lambda a, b: a - b, right, made)
        return *left[:2], jnp.where(active, left[2], 0)

    # The solver stands in the program once, for the solution and its refinements.
    def refine(k, carry):
        solution, left = carry
        solution = jax.tree.map(lambda a, b: a + b, solution, once(left))
        # The error of the last solution is not of interest.
        return solution, lax.cond(k + 1 < passes, error, lambda _: right, solution)

    start = jax.tree.map(jnp.zeros_like, right), right
    return lax.fori_loop(0, passes, refine, start)[0]


def direction(method: Method, at: Iterate, left: Residuals, first, count, passes):
    """Mehrotra's step: the direction, its length, the share of the residuals that it
    aims to remove, and the direction of tau."""
    form, sides, is_soft = method.scaled, method.sides, method.is_soft
    inequality, hinge = sides.inequality, sides.hinge
    x, _, z, s, t, m = method.apart(at.v)
    z, s = (jnp.where(inequality & ~first, a, 1) for a in (z, s))
    barrier = jnp.where(inequality, s / z, 0)
    e = stay = jnp.zeros((), z.dtype)
    if is_soft:
        # Of the violation, which the multiplier m keeps at zero with stiffness m / t.
        m, t_or_1 = jnp.where(hinge, m, 0), jnp.where(sides.soft & ~first, t, 1)
        stay = m / t_or_1
        stiffness = jnp.where(sides.soft, sides.W + stay, 1)
        e = jnp.where(sides.soft & ~first, 1 / stiffness, 0)
    system = assembled(form, sides, barrier + e)
    tau, kappa = at.tau, at.kappa
    weights = method.joined(
        form.q + 2 * left.Hx / tau,
        form.f,
        sides.h,
        jnp.zeros_like(s),
        sides.v + 2 * sides.W * t / tau,
        jnp.zeros_like(s),
    )
    on = method.joined(
        *(jnp.zeros_like(a, bool) for a in (form.q, form.f)),
        *(inequality, inequality, hinge, hinge),
    )
    values = method.joined(form.q, form.f, z, s, t, m)

    def solve(lines, rt, rs, rm):
        """The change of all vectors, for the right sides of the lines of `x, p, z`, of
        `t`, and of the products `s z` and `t m`. The last three are eliminated."""
        x, p, r = lines
        r = r - rs / z
        if is_soft:
            rm = rm / t_or_1
            r = r + e * (rt + rm)
        lines = x, p, jnp.where(sides.active, r, 0)
        dx, dp, dz = solved(form, sides, system, lines, passes)
        ds = jnp.where(inequality, rs / z - barrier * dz, 0)
        if not is_soft:
            return method.joined(dx, dp, dz, ds)
        dt = e * (dz + rt + rm)
        dm = jnp.where(hinge, rm - stay * dt, 0)
        return method.joined(dx, dp, dz, ds, dt, dm)

    # Three right sides in turn, that of tau, the affine one, and the one with Mehrotra's
    # correction: so all that follows stands in the program once.
    def turn(k, carry):
        along, d, sigma, _ = carry
        is_tau = k == 0
        share, aim = 1 - sigma, sigma * left.products / count
        pick = lambda a, b: jnp.where(is_tau, a, b)
        lines = (
            pick(-form.q, -share * left.x),
            pick(form.f, -share * left.p),
            pick(sides.h, -share * left.z),
        )
        _, _, dz, ds, dt, dm = method.apart(d.v)
        rs = jnp.where(inequality & ~is_tau, aim - s * z - ds * dz, 0)
        rt = rm = jnp.zeros((), z.dtype)
        if is_soft:
            rt = pick(-sides.v, -share * left.t)
            rm = jnp.where(hinge & ~is_tau, aim - t * m - dt * dm, 0)
        change = solve(lines, rt, rs, rm)
        along = pick(change, along)
        # The curvature of the last line along tau is a sum of squares.
        ax, _, az, _, a_t, _ = method.apart(along)
        off = x / tau - ax
        springs = barrier * az**2
        if is_soft:
            springs = springs + sides.W * (t / tau - a_t) ** 2 + stay * a_t**2
        slope = kappa / tau + jnp.sum(off * form.hessian(off)) + jnp.sum(springs)
        last = aim - tau * kappa - d.tau * d.kappa
        total = share * left.tau + jnp.sum(weights * change) + last / tau
        dtau = pick(0, total / slope)
        dkappa = pick(0, (last - kappa * dtau) / tau)
        d = Iterate(pick(0, change + dtau * along), dtau, dkappa)
        # The largest step within the bounds, at most 1.
        worst = jnp.max(jnp.where(on, -d.v / values, 0), initial=1)
        length = 1 / jnp.maximum(worst, jnp.maximum(-dtau / tau, -dkappa / kappa))
        return along, d, jnp.where(k == 1, (1 - length) ** 3, sigma), length

    none = jnp.zeros_like(at.v)
    nothing = jnp.zeros((), z.dtype)
    start = none, Iterate(none, nothing, nothing), nothing, nothing
    along, d, sigma, length = lax.fori_loop(0, 3, turn, start)
    return d, jnp.minimum(_TO_BOUNDARY * length, 1), 1 - sigma, along


def begun(method: Method, along: Array) -> Iterate:
    """A start: with unit weights the direction of tau solves the problem with squares
    for the inequalities, of which `s = -z`."""
    sides = method.sides
    x, p, z, *_ = method.apart(along)
    s, one = interior(-z, sides.inequality), jnp.ones((), along.dtype)
    z = jnp.where(sides.inequality, interior(z, sides.inequality), z)
    t, m = (jnp.where(on, one, 0) for on in (sides.soft, sides.hinge))
    return Iterate(method.joined(x, p, z, s, t, m), one, one)


def minimise(
    method: Method,
    start: tuple[Iterate, BoolScalar] | None,
    max_steps: int,
    refinements: int,
) -> Outcome:
    """Run the method, from a start or from its own."""
    sides, dtype = method.sides, method.form.q.dtype
    count = 1 + jnp.sum(sides.inequality) + jnp.sum(sides.hinge)
    rounding = jnp.finfo(dtype).eps

    def body(carry):
        at, left, best, known, k, since, passes = carry
        first, before = k == 0, left.linear
        d, length, share, along = direction(method, at, left, first, count, passes)
        moved = jax.tree.map(lambda a, d: a + length * d, at, d)
        begin = begun(method, along)
        at = jax.tree.map(lambda a, b: jnp.where(first, a, b), begin, moved)
        left = evaluated(method, at)
        # Where a residual is larger than it should be, rounding is: from now on the
        # linear systems are refined once more.
        expected = jnp.where(first, jnp.inf, (1 - length * share) * before)
        rounded = left.linear > 1.5 * expected + _NEGLIGIBLE * at.tau
        passes = jnp.minimum(passes + rounded, 1 + refinements)
        # NaN fails the comparison.
        better = jnp.min(left.errors) < jnp.min(known[1])
        now = left.measured, left.errors, left.gains
        best, known = jax.tree.map(
            lambda a, b: jnp.where(better, a, b), (at, now), (best, known)
        )
        # While the products fall, an error may rise for a while.
        falls = left.products > count * rounding * at.tau**2
        since = jnp.where(better, 0, since + ~falls)
        return at, left, best, known, k + 1, since, passes

    def going(carry):
        _, _, _, known, k, since, _ = carry
        return (jnp.min(known[1]) > 1) & (k < max_steps) & (since < _PATIENCE)

    k, one = jnp.zeros((), int), jnp.ones((), dtype)
    if start is None:
        none = jnp.zeros_like(sides.h)
        zeros = jnp.zeros_like(method.form.q), jnp.zeros_like(method.form.f)
        at = Iterate(method.joined(*zeros, none, none, none, none), one, one)
        left = jax.tree.map(
            lambda a: jnp.zeros(a.shape, a.dtype), jax.eval_shape(evaluated, method, at)
        )
    else:
        # The first iteration, which finds a start, is left out.
        at, usable = start
        left, k = evaluated(method, at), k + usable
    known = left.measured, jnp.full(3, jnp.inf, dtype), left.gains
    carry = at, left, at, known, k, jnp.zeros((), int), jnp.ones((), int)
    _, _, best, known, k, _, _ = lax.while_loop(going, body, carry)
    return Outcome(*method.point(best), best, *known, k)


def interior(z: Array, on: Array) -> Array:
    """`z` where all entries are well positive, else moved until they are."""
    least = jnp.min(jnp.where(on, z, jnp.inf), initial=jnp.inf)
    shift = jnp.where(least > 0, 0, 1 - least)
    return jnp.where(on, z + jnp.where(jnp.isfinite(shift), shift, 0), 0)
