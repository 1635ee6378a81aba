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

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax

from .._typing import Array, BoolScalar, Scalar
from ._dense import regularisation
from ._form import AbstractForm, both, Scaling, Sides, signed


_TO_BOUNDARY = 0.99
"""The share of the step to the boundary that is taken."""
_NEGLIGIBLE = 1e-2
"""So much of the tolerance is no reason to refine a linear system."""
_PATIENCE = 5
"""It ends after so many steps without a better iterate: rounding is reached."""


class Iterate(NamedTuple):
    """A point of the embedding; without soft sides `t` and `m` are `None`."""

    x: Array
    p: Array
    z: Array
    s: Array
    t: Array | None
    m: Array | None
    tau: Scalar
    kappa: Scalar


class Residuals(NamedTuple):
    """What is left of each line of the embedding, and sums that it has."""

    x: Array
    p: Array
    z: Array
    t: Array | None
    tau: Scalar
    Hx: Array
    products: Scalar  # s'z + t'm + tau kappa
    linear: Scalar  # the worst of the lines `x` and `p`, over what is allowed, times tau
    errors: Array
    """The worst residual over what is allowed: of the program, of the certificate that
    it is infeasible, and of the one that it is unbounded."""


class Tolerances(NamedTuple):
    """Residuals may be `atol + rtol * scale`; those of a certificate `certificate`."""

    atol: Array
    rtol: Array
    certificate: Array


class Outcome(NamedTuple):
    """The best iterate, its errors, and the number of iterations."""

    iterate: Iterate
    errors: Array
    iterations: Array


def _sums(*arrays: Array) -> list[Scalar]:
    """The sum of each of some arrays of one shape, in one loop."""
    stacked = jnp.stack(arrays)
    return list(jnp.sum(stacked, axis=range(1, stacked.ndim)))


def _largest(*arrays: Array) -> list[Scalar]:
    """The largest entry in magnitude of each of some arrays of one shape."""
    stacked = jnp.abs(jnp.stack(arrays))
    return list(jnp.max(stacked, axis=range(1, stacked.ndim), initial=0))


def evaluated(
    form: AbstractForm,
    sides: Sides,
    scaling: Scaling,
    tolerances: Tolerances,
    at: Iterate,
) -> Residuals:
    """The residuals of an iterate, and how far it is from each of the three ends, in
    the units of the user."""
    atol, rtol, least = tolerances
    D, E, R, c = scaling
    tau, active = at.tau, sides.active
    Hx = form.hessian(at.x)
    pulled = form.equations_transposed(at.p) + form.rows_transposed(signed(at.z))
    x = Hx + form.q * tau + pulled
    reached = form.equations(at.x)
    p = reached - form.f * tau
    # What is violated is not what the slack does not match.
    row = both(form.rows(at.x)) - (0 if at.t is None else at.t)
    row = jnp.where(active, row, 0)
    over = row - sides.h * tau
    z = over + at.s
    slope, square, x_size = _sums(form.q * at.x, Hx * at.x, jnp.abs(at.x) * D)
    lift, p_size = _sums(form.f * at.p, jnp.abs(at.p) * E)
    push, z_size, products = _sums(sides.h * at.z, jnp.abs(at.z) * R, at.s * at.z)
    products = products + tau * at.kappa
    violated = jnp.where(sides.equality, over, jnp.maximum(over, 0))
    # A direction of recession does not violate the bounds 0.
    outward = jnp.where(sides.equality, row, jnp.maximum(row, 0))
    dual, *slopes, pulled_most, flat = _largest(x / D, Hx / D, pulled / D, pulled, Hx)
    push_most = push
    missed, drift = _largest(p / E, reached)
    violated, row_scale, outward = _largest(violated / R, row / R, outward)
    t = None
    if at.t is not None:
        Wt = sides.W * at.t
        t = jnp.where(sides.soft, Wt + sides.v * tau - at.z - at.m, 0)
        costs, squares, extra = _sums(sides.v * at.t, Wt * at.t, at.t * at.m)
        spring, bent = _largest(t * R, Wt)
        slope, square, products = slope + costs, square + squares, products + extra
        dual, flat = jnp.maximum(dual, spring), jnp.maximum(flat, bent)
        # A soft side has no part in a certificate.
        yielding = jnp.where(sides.soft, at.z, 0)
        resisted = pulled - form.rows_transposed(signed(yielding))
        pulled_most = _largest(resisted)[0]
        push_most = push - jnp.sum(sides.h * yielding)
    gap = slope + lift + push + square / tau

    # Each is compared with the terms that cancel in it. Those of the dual are divided
    # by c D, those of the primal by E or R.
    size = lambda data: _largest(data)[0]
    terms = jnp.abs(jnp.stack([slope, square / tau, lift, push]))
    found = jnp.stack([dual / c, violated, missed, jnp.abs(gap) / c])
    scales = jnp.stack([jnp.maximum(*slopes) / c, row_scale, row_scale, jnp.max(terms) / c])
    data = jnp.stack([size(form.q / (c * D)), size(sides.h / R), size(form.f / E), 0])
    errors = found / tau / (atol + rtol * jnp.maximum(scales / tau, data))
    # A certificate is judged in the scaled problem, whose units mean nothing. It must
    # hold with all data off by the tolerance too: what a tolerance away is feasible has
    # a solution.
    relaxed = atol + rtol
    gains = jnp.stack([lift + push_most, slope])
    gains = gains + relaxed * jnp.stack([p_size + z_size, c * x_size])
    failings = jnp.stack([pulled_most, jnp.maximum(jnp.maximum(flat, drift), outward)])
    certificates = jnp.where(gains < 0, failings / (least * -gains), jnp.inf)
    linear = tau * jnp.maximum(errors[0], errors[2])
    errors = jnp.concatenate([jnp.max(errors)[None], certificates])
    return Residuals(x, p, z, t, at.kappa + gap, Hx, products, linear, errors)


class System(NamedTuple):
    """The linear system of a step: its factors, and the compliance of each side, as it
    is and as it is factorised."""

    factors: object
    compliance: Array
    regularised: Array


def assembled(form: AbstractForm, sides: Sides, compliance: Array) -> System:
    """Factorise `[[H, F', G'], [F, 0, 0], [G, 0, -compliance]]`."""
    # An equation has no compliance, which refinement restores.
    soft = jnp.asarray(regularisation(form.q.dtype), form.q.dtype)
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


def stored(tree):
    """The arrays behind a barrier: XLA would repeat what they are computed from in each
    loop that reads them, and compile it as often."""
    return lax.optimization_barrier(tree)


def minimise(
    form: AbstractForm,
    scaling: Scaling,
    start: tuple[Iterate, BoolScalar] | None,
    tolerances: Tolerances,
    max_steps: int,
    refinements: int,
) -> Outcome:
    """Run the method on a scaled form, from a start or from its own."""
    sides = form.sides()
    is_soft, inequality = form.soft is not None, sides.inequality
    count = 1 + jnp.sum(inequality)
    if is_soft:
        count = count + jnp.sum(sides.hinge)
    one = jnp.ones((), form.q.dtype)
    none = jnp.zeros_like(sides.h)
    rounding = jnp.finfo(one.dtype).eps

    def step(at: Iterate, left: Residuals, first: BoolScalar, passes: Array):
        """The next iterate, and the share of the linear residuals that it has."""
        z = jnp.where(inequality & ~first, at.z, 1)
        s = jnp.where(inequality & ~first, at.s, 1)
        barrier = jnp.where(inequality, s / z, 0)
        t = m = e = stay = 0
        if is_soft:
            # Of the violation: `t` stays at zero with stiffness `m / t`.
            t, m = at.t, jnp.where(sides.hinge, at.m, 0)
            stay = m / jnp.where(sides.soft, t, 1)
            stiffness = jnp.where(sides.soft, sides.W + stay, 1)
            e = jnp.where(sides.soft & ~first, 1 / stiffness, 0)
        system = assembled(form, sides, barrier + e)
        solve = lambda *right: solved(form, sides, system, right, passes)

        def right_of(x, p, r, rt, rs, rm):
            """The right side, of which the lines of `t`, `s z` and `t m` are
            eliminated."""
            r = r - rs / z
            if is_soft:
                r = r + e * (rt + rm / jnp.where(sides.soft, t, 1))
            return x, p, jnp.where(sides.active, r, 0)

        def expanded(solution, rt, rs, rm):
            dx, dp, dz = solution
            ds = jnp.where(inequality, rs / z - barrier * dz, 0)
            if not is_soft:
                return dx, dp, dz, ds, None, None
            rm = rm / jnp.where(sides.soft, t, 1)
            dt = e * (dz + rt + rm)
            return dx, dp, dz, ds, dt, jnp.where(sides.hinge, rm - stay * dt, 0)

        # The direction of tau, and the affine one: two columns.
        unit = -sides.v if is_soft else 0, 0, 0
        data = right_of(-form.q, form.f, sides.h, *unit)
        targets = -left.t if is_soft else 0, jnp.where(inequality, -s * z, 0), -t * m
        affine = right_of(-left.x, -left.p, -left.z, *targets)
        pairs = zip(data, affine, strict=True)
        columns = jax.vmap(solve)(*(jnp.stack(pair) for pair in pairs))
        tau_column, affine = (
            jax.tree.map(lambda a, k=k: a[k], columns) for k in range(2)
        )
        along = stored(expanded(tau_column, *unit))

        # The curvature of the last line along tau is a sum of squares.
        tau, kappa = at.tau, at.kappa
        off = at.x / tau - along[0]
        slope = kappa / tau + jnp.sum(off * form.hessian(off))
        springs = barrier * along[2] ** 2
        if is_soft:
            off = at.t / tau - along[4]
            springs = springs + sides.W * off**2 + stay * along[4] ** 2
        slope = slope + jnp.sum(springs)
        x_weight = form.q + 2 * left.Hx / tau
        t_weight = sides.v + 2 * sides.W * t / tau if is_soft else 0

        def combined(change, tau_right, tau_kappa) -> Iterate:
            dx, dp, dz, _, dt, _ = change
            sided = sides.h * dz + (t_weight * dt if is_soft else 0)
            total = jnp.sum(x_weight * dx) + jnp.sum(form.f * dp) + jnp.sum(sided)
            dtau = (tau_right + total + tau_kappa / tau) / slope
            change = jax.tree.map(lambda a, b: a + dtau * b, change, along)
            return stored(Iterate(*change, dtau, (tau_kappa - kappa * dtau) / tau))

        def longest(d: Iterate):
            """The largest step within the bounds, at most 1."""
            ratios = [jnp.where(inequality, -d.z / z, 0)]
            ratios = [*ratios, jnp.where(inequality, -d.s / s, 0)]
            if is_soft:
                moves = (d.t, t), (d.m, m)
                ratios += [jnp.where(sides.hinge, -d / v, 0) for d, v in moves]
            worst = jnp.max(jnp.stack(ratios), initial=1)
            ends = jnp.maximum(-d.tau / tau, -d.kappa / kappa)
            return 1 / jnp.maximum(worst, ends)

        predictor = combined(expanded(affine, *targets), left.tau, -tau * kappa)
        sigma = (1 - longest(predictor)) ** 3
        aim, share = sigma * left.products / count, 1 - sigma
        # The second-order correction of each product.
        targets = (
            -share * left.t if is_soft else 0,
            jnp.where(inequality, aim - s * z - predictor.s * predictor.z, 0),
            jnp.where(sides.hinge, aim - t * m - predictor.t * predictor.m, 0)
            if is_soft
            else 0,
        )
        lines = (-share * part for part in (left.x, left.p, left.z))
        corrector = expanded(solve(*right_of(*lines, *targets)), *targets)
        last = aim - tau * kappa - predictor.tau * predictor.kappa
        change = combined(corrector, share * left.tau, last)
        length = jnp.minimum(_TO_BOUNDARY * longest(change), 1)
        moved = stored(jax.tree.map(lambda a, d: a + length * d, at, change))

        # The first iteration finds a start: with unit weights the column of tau solves
        # the problem with squares for the inequalities, of which z = -s.
        x, p, z = tau_column
        found = jnp.where(inequality, interior(z, inequality), z)
        begun = (
            (jnp.where(sides.soft, 1, none), jnp.where(sides.hinge, 1, none))
            if is_soft
            else (None, None)
        )
        start = Iterate(x, p, found, interior(-z, inequality), *begun, one, one)
        after = jax.tree.map(lambda a, b: jnp.where(first, a, b), start, moved)
        return stored(after), jnp.where(first, jnp.inf, 1 - length * share)

    def body(carry):
        at, left, best, least, k, since, passes = carry
        before = left.linear
        at, share = step(at, left, k == 0, passes)
        left = evaluated(form, sides, scaling, tolerances, at)
        # Where a residual is larger than it should be, rounding is: from now on the
        # linear systems are refined once more.
        rounded = left.linear > 1.5 * share * before + _NEGLIGIBLE * at.tau
        passes = jnp.minimum(passes + rounded, 1 + refinements)
        # NaN fails the comparison.
        better = jnp.min(left.errors) < jnp.min(least)
        best, least = jax.tree.map(
            lambda a, b: jnp.where(better, a, b), (at, left.errors), (best, least)
        )
        # While the products fall, an error may rise for a while.
        falls = left.products > count * rounding * at.tau**2
        since = jnp.where(better, 0, since + ~falls)
        return at, left, best, least, k + 1, since, passes

    def going(carry):
        *_, least, k, since, _ = carry
        return (jnp.min(least) > 1) & (k < max_steps) & (since < _PATIENCE)

    k = jnp.zeros((), int)
    if start is None:
        nothing = (none, none) if is_soft else (None, None)
        zero = jnp.zeros_like(form.q), jnp.zeros_like(form.f), none, none
        start = Iterate(*zero, *nothing, one, one)
        left = jax.tree.map(
            lambda a: jnp.zeros(a.shape, a.dtype),
            jax.eval_shape(evaluated, form, sides, scaling, tolerances, start),
        )
    else:
        # The first iteration, which finds a start, is left out.
        start, usable = start
        left, k = evaluated(form, sides, scaling, tolerances, start), k + usable
    least = jnp.full(3, jnp.inf, one.dtype)
    zero = jnp.zeros((), int)
    carry = start, left, start, least, k, zero, zero + 1
    _, _, best, least, k, _, _ = lax.while_loop(going, body, carry)
    return Outcome(best, least, k)


def interior(z: Array, on: Array) -> Array:
    """`z` where all entries are well positive, else moved until they are."""
    least = jnp.min(jnp.where(on, z, jnp.inf), initial=jnp.inf)
    shift = jnp.where(least > 0, 0, 1 - least)
    return jnp.where(on, z + jnp.where(jnp.isfinite(shift), shift, 0), 0)
