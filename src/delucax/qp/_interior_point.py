"""The interior-point method, for every form of a program.

The violation `t` of a soft side and its multiplier `m` are eliminated, so that a soft
side takes no more time than a hard side. In a linear step it is a spring with the
compliance `1 / (W + m / t)`, in series with the compliance `s / z` of the barrier.

Source: Mehrotra, 1992.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax

from .._typing import Array
from ._active_set import active_at, Guess, PASSES, tried
from ._embedding import evaluated, Iterate, Method, Outcome, Residuals
from ._form import AbstractForm, both, Sides, signed


_TO_BOUNDARY = 0.99
"""The share of the step to the boundary that the method takes."""
_NEGLIGIBLE = 1e-2
"""An error of this share of the tolerance is no reason to refine a linear system."""
_PATIENCE = 5
"""The method ends after this many steps without a better iterate."""


class System(NamedTuple):
    """The linear system of a step: its factors, and the compliance of each side, exact
    and regularised for the factorisation."""

    factors: object
    compliance: Array
    regularised: Array


def assembled(form: AbstractForm, sides: Sides, compliance: Array) -> System:
    """Factorise `[[H, F', G'], [F, 0, 0], [G, 0, -compliance]]`."""
    # The compliance of an equation is zero. It is factorised with a small one, and
    # refinement removes the error, at a rate of `soft` plus rounding over `soft`.
    soft = jnp.asarray(jnp.finfo(form.q.dtype).eps ** 0.5, form.q.dtype)
    compliance = jnp.where(sides.equality, 0, compliance)
    regularised = jnp.where(sides.equality, soft, compliance)
    regularised = jnp.where(sides.active, regularised, 1)
    weight = jnp.sum(jnp.where(sides.active, 1 / regularised, 0), axis=0)
    return System(form.factorise(weight), compliance, regularised)


def solved(form, sides: Sides, system: System, right, passes: Array | int):
    """The solution `(x, p, z)` of the linear system, after some refinement passes."""
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

    # A loop, so that the solve is compiled once for the solution and its refinements.
    def refine(k, carry):
        solution, left = carry
        solution = jax.tree.map(lambda a, b: a + b, solution, once(left))
        # The error of the last solution is not needed.
        return solution, lax.cond(k + 1 < passes, error, lambda _: right, solution)

    start = jax.tree.map(jnp.zeros_like, right), right
    return lax.fori_loop(0, passes, refine, start)[0]


def direction(method, at: Iterate, left: Residuals, first, guess: Guess, count, passes):
    """A step of Mehrotra's method: the direction, its length, the share of the
    residuals that a full step removes, and the direction of tau."""
    form, sides, is_soft = method.scaled, method.sides, method.is_soft
    inequality, hinge = sides.inequality, sides.hinge
    guessing = guess.left > 0
    first = first | guessing
    x, _, z, s, t, m = method.apart(at.v)
    z, s = (jnp.where(inequality & ~first, a, 1) for a in (z, s))
    barrier = jnp.where(inequality, s / z, 0)
    e = stay = jnp.zeros((), z.dtype)
    t_or_1 = jnp.ones((), z.dtype)
    if is_soft:
        # The violation t is a spring too. Its multiplier m adds the stiffness m / t.
        m, t_or_1 = jnp.where(hinge, m, 0), jnp.where(sides.soft & ~first, t, 1)
        stay = m / t_or_1
        stiffness = jnp.where(sides.soft, sides.W + stay, 1)
        e = jnp.where(sides.soft & ~first, 1 / stiffness, 0)
    taken, compliance = guess.sides(sides)
    either = lambda a, b: jnp.where(guessing, a, b)
    now = sides._replace(
        inequality=either(taken.inequality, sides.inequality),
        equality=either(taken.equality, sides.equality),
    )
    compliance = either(compliance, barrier + e)
    pushed = jnp.where(guessing, guess.pushed(sides), 0)
    system = assembled(form, now, compliance)
    begin_x = -form.q - form.rows_transposed(signed(pushed))
    begin_z = sides.h - jnp.where(guessing, sides.v * compliance, 0)
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
        """The change of all vectors, from the right sides of the lines of `x, p, z` and
        `t`, and of the products `s z` and `t m`. The last three are eliminated."""
        x, p, r = lines
        r = r - rs / z
        if is_soft:
            rm = rm / t_or_1
            r = r + jnp.where(guessing, 0, e * (rt + rm))
        lines = x, p, jnp.where(now.active, r, 0)
        dx, dp, dz = solved(form, now, system, lines, passes)
        ds = jnp.where(inequality, rs / z - barrier * dz, 0)
        if not is_soft:
            return method.joined(dx, dp, dz, ds)
        dt = e * (dz + rt + rm)
        dm = jnp.where(hinge, rm - stay * dt, 0)
        return method.joined(dx, dp, dz, ds, dt, dm)

    # A loop over three right sides, so that the solve is compiled once: for tau, for
    # the affine step, and for the step with the second-order correction.
    def turn(k, carry):
        along, d, sigma, _ = carry
        is_tau = k == 0
        share, aim = 1 - sigma, sigma * left.products / count
        pick = lambda a, b: jnp.where(is_tau, a, b)
        lines = (
            pick(begin_x, -share * left.x),
            pick(form.f, -share * left.p),
            pick(begin_z, -share * left.z),
        )
        _, _, dz, ds, dt, dm = method.apart(d.v)
        rs = jnp.where(inequality & ~is_tau, aim - s * z - ds * dz, 0)
        rt = rm = jnp.zeros((), z.dtype)
        if is_soft:
            rt = pick(-sides.v, -share * left.t)
            rm = jnp.where(hinge & ~is_tau, aim - t * m - dt * dm, 0)
        change = solve(lines, rt, rs, rm)
        along = pick(change, along)
        # The slope of the last line along tau is a sum of squares.
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
    # A start and a guess need the first right side only.
    turns = jnp.where(first, 1, 3)
    along, d, sigma, length = lax.fori_loop(0, turns, turn, start)
    return d, jnp.minimum(_TO_BOUNDARY * length, 1), 1 - sigma, along


def begun(method: Method, along: Array) -> Iterate:
    """The start of the method. With unit weights, the direction of tau solves the
    problem with squared violations instead of inequalities, and `s = -z`."""
    sides = method.sides
    x, p, z, *_ = method.apart(along)
    s, one = interior(-z, sides.inequality), jnp.ones((), along.dtype)
    z = jnp.where(sides.inequality, interior(z, sides.inequality), z)
    t, m = (jnp.where(on, one, 0) for on in (sides.soft, sides.hinge))
    return Iterate(method.joined(x, p, z, s, t, m), one, one)


def minimise(method: Method, guess: Guess, max_steps: int, refinements: int) -> Outcome:
    """Solve a program.

    First try a guess of the active sides and the guesses that follow from it. If none
    gives the solution, run the method from its own start. At its end, one more linear
    system for the active sides gives the solution up to rounding.
    """
    sides, dtype = method.sides, method.form.q.dtype
    count = 1 + jnp.sum(sides.inequality) + jnp.sum(sides.hinge)
    rounding = jnp.finfo(dtype).eps

    def body(carry):
        at, left, best, known, k, since, passes, begun_yet, guess, ends = carry
        guessing = guess.left > 0
        first, before = ~begun_yet & ~guessing, left.linear
        now = jnp.where(guessing, PASSES, passes)
        steps = direction(method, at, left, first, guess, count, now)
        d, length, share, along = steps
        moved = jax.tree.map(lambda a, d: a + length * d, at, d)
        begin, (point, next_guess) = begun(method, along), tried(method, along, guess)
        pick = lambda a, b, c: jnp.where(guessing, a, jnp.where(first, b, c))
        at = jax.tree.map(pick, point, begin, moved)
        left = evaluated(method, at)
        # A residual that is larger than expected is a sign of rounding. From now on the
        # linear systems get one more refinement.
        fresh = first | guessing
        expected = jnp.where(fresh, jnp.inf, (1 - length * share) * before)
        rounded = left.linear > 1.5 * expected + _NEGLIGIBLE * at.tau
        passes = jnp.minimum(passes + rounded, 1 + refinements)
        # NaN fails the comparison.
        better = jnp.min(left.errors) < jnp.min(known[1])
        now = left.measured, left.errors, left.gains
        best, known = jax.tree.map(
            lambda a, b: jnp.where(better, a, b), (at, now), (best, known)
        )
        # An error may increase for a while, as long as the products decrease.
        falls = left.products > count * rounding * at.tau**2
        since = jnp.where(better | fresh, 0, since + ~falls)
        ends = (jnp.min(known[1]) <= 1) & (guessing | (known[1][0] > 1))
        last = active_at(method, at)._replace(left=jnp.where(ends, 0, 1))
        pick = lambda a, b, c: jnp.where(guessing, a, jnp.where(known[1][0] <= 1, b, c))
        guess = jax.tree.map(pick, next_guess, last, guess)
        begun_yet = begun_yet | first
        return at, left, best, known, k + 1, since, passes, begun_yet, guess, ends

    def going(carry):
        *_, k, since, _, _, _, ends = carry
        return ~ends & (k < max_steps) & (since < _PATIENCE)

    k, one = jnp.zeros((), int), jnp.ones((), dtype)
    none = jnp.zeros_like(sides.h)
    zeros = jnp.zeros_like(method.form.q), jnp.zeros_like(method.form.f)
    at = Iterate(method.joined(*zeros, none, none, none, none), one, one)
    left = jax.tree.map(
        lambda a: jnp.zeros(a.shape, a.dtype), jax.eval_shape(evaluated, method, at)
    )
    known = left.measured, jnp.full(3, jnp.inf, dtype), left.gains
    no = jnp.asarray(False)
    passes = jnp.ones((), int)
    carry = at, left, at, known, k, jnp.zeros((), int), passes, no, guess, no
    out = lax.while_loop(going, body, carry)
    _, _, best, (measured, errors, gains), k, *_ = out
    return Outcome(*method.point(best), best, measured, errors, gains, k)


def interior(z: Array, on: Array) -> Array:
    """`z` if all its entries are positive, else `z` shifted until they are."""
    least = jnp.min(jnp.where(on, z, jnp.inf), initial=jnp.inf)
    shift = jnp.where(least > 0, 0, 1 - least)
    return jnp.where(on, z + jnp.where(jnp.isfinite(shift), shift, 0), 0)
