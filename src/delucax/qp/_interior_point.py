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
_PATIENCE = 5
"""It ends after so many steps without a better iterate: rounding is reached."""


class Iterate(NamedTuple):
    """A point of the embedding."""

    x: Array
    p: Array
    z: Array
    s: Array
    t: Array
    m: Array
    tau: Scalar
    kappa: Scalar


class Residuals(NamedTuple):
    """What is left of each line of the embedding."""

    x: Array
    p: Array
    z: Array
    t: Array
    tau: Scalar
    Hx: Array
    gap: Scalar  # kappa + (what the last line has beside it), for tau = 1
    objective: Scalar


class Tolerances(NamedTuple):
    """Residuals may be `atol + rtol * scale`; those of a certificate `certificate`."""

    atol: Array
    rtol: Array
    certificate: Array


class Progress(NamedTuple):
    """The worst residual over what is allowed; likewise of the two certificates."""

    error: Scalar
    infeasible: Scalar
    unbounded: Scalar


class Outcome(NamedTuple):
    """The last iterate and the number of iterations."""

    iterate: Iterate
    iterations: Array


def largest(a: Array) -> Scalar:
    """The largest entry in magnitude."""
    return jnp.max(jnp.abs(a), initial=0)


def residuals(form: AbstractForm, sides: Sides, at: Iterate) -> Residuals:
    """The residuals of an iterate."""
    Hx = form.hessian(at.x)
    pulled = form.equations_transposed(at.p) + form.rows_transposed(signed(at.z))
    x = Hx + form.q * at.tau + pulled
    p = form.equations(at.x) - form.f * at.tau
    z = both(form.rows(at.x)) - at.t + at.s - sides.h * at.tau
    Wt = sides.W * at.t
    t = jnp.where(sides.soft, Wt + sides.v * at.tau - at.z - at.m, 0)
    squares = (jnp.sum(at.x * Hx) + jnp.sum(at.t * Wt)) / at.tau
    costs = jnp.sum(form.q * at.x) + jnp.sum(sides.v * at.t)
    gap = costs + jnp.sum(form.f * at.p) + jnp.sum(sides.h * at.z) + squares
    objective = (costs + squares / 2) / at.tau
    z = jnp.where(sides.active, z, 0)
    return Residuals(x, p, z, t, at.kappa + gap, Hx, gap / at.tau, objective)


def progress(
    form: AbstractForm,
    sides: Sides,
    scaling: Scaling,
    tolerances: Tolerances,
    at: Iterate,
    left: Residuals,
) -> Progress:
    """How far an iterate is from each of the three ends, in the units of the user."""
    atol, rtol, least = tolerances
    D, E, R, c = scaling

    # Residuals of the dual are divided by c D, those of the primal by E or R.
    def relative(error, *scales):
        scale = jnp.max(jnp.stack([largest(s) for s in scales]))
        return largest(error) / (atol + rtol * scale)

    tau = at.tau
    # What is violated, not what the slack does not match.
    over = jnp.where(sides.equality, left.z, jnp.maximum(left.z - at.s, 0))
    rows = (left.z - at.s + sides.h * tau) / (R * tau)
    dual = left.x / (c * D * tau)
    primal = over / (R * tau)
    errors = jnp.stack(
        [
            relative(dual, left.Hx / (c * D * tau), form.q / (c * D)),
            relative(primal, jnp.where(sides.active, rows, 0), sides.h / R),
            relative(left.p / (E * tau), form.f / E),
            relative(left.t * R / (c * tau), sides.v * R / c),
            relative(left.gap / c, left.objective / c),
        ]
    )
    # A certificate is judged in the scaled problem, whose units mean nothing. It must
    # hold with all data off by the tolerance too: what a tolerance away is feasible has
    # a solution.
    relaxed = atol + rtol
    support = jnp.sum(form.f * at.p) + jnp.sum(sides.h * at.z)
    sizes = jnp.sum(jnp.abs(at.p) * E) + jnp.sum(jnp.abs(at.z) * R)
    support = support + relaxed * sizes
    pulled = left.x - left.Hx - form.q * tau
    slope = jnp.sum(form.q * at.x) + jnp.sum(sides.v * at.t)
    slope = slope + relaxed * c * jnp.sum(jnp.abs(at.x) * D)
    bounded_by = jnp.stack(
        [
            largest(left.Hx),
            largest(left.p + form.f * tau),
            largest(jnp.where(sides.equality, left.z + sides.h * tau, 0)),
            jnp.max(jnp.where(sides.active, left.z - at.s + sides.h * tau, 0)),
            largest(sides.W * at.t),
        ]
    )
    ratio = lambda error, gain: jnp.where(gain < 0, error / (least * -gain), jnp.inf)
    # Where a component is NaN, so is the maximum, and it fails every comparison.
    infeasible = ratio(largest(pulled), support)
    unbounded = ratio(jnp.max(bounded_by), slope)
    return Progress(jnp.max(errors), infeasible, unbounded)


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


def solved(form, sides: Sides, system: System, right, passes: int):
    """The solution `(x, p, z)` of the linear system, refined."""
    active = sides.active

    def once(right):
        x, p, z = right
        push = jnp.where(active, z / system.regularised, 0)
        x = x + form.rows_transposed(signed(push))
        x, p = form.solve(system.factors, x, p)
        z = (both(form.rows(x)) - z) / system.regularised
        return x, p, jnp.where(active, z, 0)

    def refine(_, solution):
        x, p, z = solution
        pulled = form.equations_transposed(p) + form.rows_transposed(signed(z))
        stretched = both(form.rows(x)) - system.compliance * z
        made = form.hessian(x) + pulled, form.equations(x), stretched
        left = jax.tree.map(lambda a, b: a - b, right, made)
        left = (*left[:2], jnp.where(active, left[2], 0))
        return jax.tree.map(lambda a, b: a + b, solution, once(left))

    # The first pass starts at zero: so the solver stands in the program once.
    start = jax.tree.map(jnp.zeros_like, right)
    return lax.fori_loop(0, passes, refine, start)


def minimise(
    form: AbstractForm,
    scaling: Scaling,
    start: Iterate | None,
    tolerances: Tolerances,
    max_steps: int,
    passes: int = 2,
) -> Outcome:
    """Run the method on a scaled form, from a start or from its own."""
    sides = form.sides()
    inequality, hinge = sides.inequality, sides.hinge
    count = 1 + jnp.sum(inequality) + jnp.sum(hinge)
    one = jnp.ones((), form.q.dtype)
    rounding = jnp.finfo(one.dtype).eps

    def step(at: Iterate, left: Residuals, first: BoolScalar):
        z = jnp.where(inequality & ~first, at.z, 1)
        s = jnp.where(inequality & ~first, at.s, 1)
        t, m = jnp.where(hinge, at.t, 1), jnp.where(hinge, at.m, 1)
        # The compliance of the spring, and of the barrier.
        stiff = sides.W + jnp.where(hinge, m / t, 0)
        e = jnp.where(sides.soft & ~first, 1 / jnp.where(sides.soft, stiff, 1), 0)
        system = assembled(form, sides, s / z + e)
        solve = lambda *right: solved(form, sides, system, right, passes)

        def right_of(x, p, r, rt, rs, rm):
            """Of the lines of `z`, `t`, `s z` and `t m` after elimination."""
            r = r - jnp.where(inequality, rs / z, 0) + e * (rt + hinge * rm / t)
            return x, p, jnp.where(sides.active, r, 0)

        def expanded(solution, rt, rs, rm):
            dx, dp, dz = solution
            dt = e * (dz + rt + hinge * rm / t)
            dm = jnp.where(hinge, (rm - m * dt) / t, 0)
            ds = jnp.where(inequality, (rs - s * dz) / z, 0)
            return dx, dp, dz, ds, dt, dm

        none = jnp.zeros_like(at.z)
        # The direction of tau, and the affine one: two columns.
        data = right_of(-form.q, form.f, sides.h, -sides.v, none, none)
        targets = -left.t, -s * z, -t * m
        affine = right_of(-left.x, -left.p, -left.z, *targets)
        columns = jax.vmap(solve)(*(jnp.stack(pair) for pair in zip(data, affine)))
        column = lambda k: jax.tree.map(lambda a: a[k], columns)
        along = expanded(column(0), -sides.v, none, none)

        # The curvature of the last line along tau is a sum of squares.
        tau, kappa = at.tau, at.kappa
        off, soft_off = at.x / tau - along[0], at.t / tau - along[4]
        squares = jnp.sum(off * form.hessian(off)) + jnp.sum(sides.W * soft_off**2)
        springs = jnp.sum(jnp.where(inequality, s / z * along[2] ** 2, 0))
        springs = springs + jnp.sum(jnp.where(hinge, m / t * along[4] ** 2, 0))
        slope = kappa / tau + squares + springs

        def combined(change, tau_right, tau_kappa):
            dx, dp, dz, _, dt, _ = change
            total = jnp.sum((form.q + 2 * left.Hx / tau) * dx) + jnp.sum(form.f * dp)
            total = total + jnp.sum(sides.h * dz)
            total = total + jnp.sum((sides.v + 2 * sides.W * at.t / tau) * dt)
            dtau = (tau_right + total + tau_kappa / tau) / slope
            change = jax.tree.map(lambda a, b: a + dtau * b, change, along)
            return Iterate(*change, dtau, (tau_kappa - kappa * dtau) / tau)

        def longest(d: Iterate):
            """The largest step within the bounds, at most 1."""
            pairs = (
                (d.z, z, inequality),
                (d.s, s, inequality),
                (d.t, t, hinge),
                (d.m, m, hinge),
            )
            worst = [jnp.max(jnp.where(on, -d / v, 0)) for d, v, on in pairs]
            ends = jnp.stack([*worst, -d.tau / tau, -d.kappa / kappa, one])
            return 1 / jnp.max(ends)

        predictor = combined(expanded(column(1), *targets), left.tau, -tau * kappa)
        length = longest(predictor)
        sigma = (1 - length) ** 3
        products = jnp.sum(jnp.where(inequality, s * z, 0))
        products = products + jnp.sum(jnp.where(hinge, t * m, 0)) + tau * kappa
        aim, share = sigma * products / count, 1 - sigma
        # The second-order correction of each product.
        targets = (
            -share * left.t,
            aim - s * z - predictor.s * predictor.z,
            aim - t * m - predictor.t * predictor.m,
        )
        lines = (-share * part for part in (left.x, left.p, left.z))
        corrector = expanded(solve(*right_of(*lines, *targets)), *targets)
        last = aim - tau * kappa - predictor.tau * predictor.kappa
        change = combined(corrector, share * left.tau, last)
        length = jnp.minimum(_TO_BOUNDARY * longest(change), 1)
        moved = Iterate(*(a + length * d for a, d in zip(at, change, strict=True)))

        # The first iteration finds a start: with unit weights the column of tau solves
        # the problem with squares for the inequalities, of which z = -s.
        x, p, z = column(0)
        start = Iterate(
            x,
            p,
            jnp.where(inequality, interior(z, inequality), z),
            interior(-z, inequality),
            jnp.where(sides.soft, 1, none),
            jnp.where(hinge, 1, none),
            one,
            one,
        )
        return jax.tree.map(lambda a, b: jnp.where(first, a, b), start, moved)

    def body(carry):
        at, left, best, least, k, since, warm = carry
        at = step(at, left, (k == 0) & ~warm)
        left = residuals(form, sides, at)
        now = progress(form, sides, scaling, tolerances, at, left)
        reached = jnp.min(jnp.stack(now))
        better = reached < least
        best = jax.tree.map(lambda a, b: jnp.where(better, a, b), at, best)
        # While the products fall, an error may rise for a while.
        products = jnp.sum(at.s * at.z * inequality) + jnp.sum(at.t * at.m * hinge)
        falls = (products + at.tau * at.kappa) / count > rounding * at.tau**2
        since = jnp.where(better, 0, since + ~falls)
        least = jnp.where(better, reached, least)
        return at, left, best, least, k + 1, since, warm

    def going(carry):
        *_, least, k, since, _ = carry
        return (least > 1) & (k < max_steps) & (since < _PATIENCE)

    warm = jnp.asarray(start is not None)
    if start is None:
        zero = jnp.zeros_like(sides.h)
        start = Iterate(0 * form.q, 0 * form.f, zero, zero, zero, zero, one, one)
    left = residuals(form, sides, start)
    count0 = jnp.zeros((), int)
    carry = (start, left, start, jnp.asarray(jnp.inf, one.dtype), count0, count0, warm)
    _, _, best, _, k, _, _ = lax.while_loop(going, body, carry)
    return Outcome(best, k)


def interior(z: Array, on: Array) -> Array:
    """`z` where all entries are well positive, else moved until they are."""
    least = jnp.min(jnp.where(on, z, jnp.inf), initial=jnp.inf)
    shift = jnp.where(least > 0, 0, 1 - least)
    return jnp.where(on, z + jnp.where(jnp.isfinite(shift), shift, 0), 0)
