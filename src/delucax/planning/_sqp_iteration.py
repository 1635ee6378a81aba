"""Sequential quadratic programming.

Each iteration solves the quadratic program about the present trajectory, and takes the
longest step of sufficient decrease of the merit function, the cost plus the weighted sum
of all that is violated. If the program has no feasible point, its constraints are
relaxed at a price, which rises until they hold or no price makes them hold.

Source: Nocedal and Wright, 2006, chapter 18; Fletcher, 1985 (relaxed constraints);
Grippo, Lampariello and Lucidi, 1986 (the merit need not fall at once).
"""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax

from .._results import choose, Result, RESULTS
from .._typing import Array
from ..qp._derivatives import warm
from ..qp._embedding import Method, Tolerances
from ..qp._interior_point import minimise
from ._problem import Problem
from ._sqp_model import (
    evaluated,
    expanded,
    form_of,
    Iterate,
    limits_of,
    convex_cost,
    Model,
    Shape,
    shape_of,
    Values,
)


HALVINGS = 12
WIDTH = float(__import__('os').environ.get('WIDTH','10000'))
MEMORY = 4
LEAST_SHARE = 1e-4
FIRST_PRICE = 1e1
MOST_PRICE = 1e9
import os
DEBUG = bool(os.environ.get('SQPDEBUG'))


class Options(eqx.Module):
    """The fields of `SQP`, defaults filled in."""

    tolerance: Array
    constraint_tolerance: Array
    second_order: bool = eqx.field(static=True)
    max_iterations: int = eqx.field(static=True)


class Progress(NamedTuple):
    """The state of the loop."""

    at: Iterate
    price: Array  # of a violation in the program; infinite while none is allowed
    weights: Array  # of the merit function: of defects, and of constraints
    memory: Array  # (MEMORY, 3): cost, defects and violations of the last iterates
    mu: Array
    trace: Array
    gains: Array
    residual: Array
    violation: Array
    iterations: Array
    inner: Array
    tried: Array
    result: Result
    done: Array


def broken(shape: Shape, values: Values) -> Array:
    """By how much each constraint is violated, `(T+1, p)`."""
    c = jnp.where(shape.equal, jnp.abs(values.c), jnp.maximum(values.c, 0))
    return jnp.where(shape.given, c, 0)


def measures(shape: Shape, values: Values) -> Array:
    """The cost, the sum of the defects, and that of the violations."""
    parts = (
        values.cost,
        jnp.sum(jnp.abs(values.defects)),
        jnp.sum(broken(shape, values)),
    )
    return jnp.stack(parts)


def conditions(problem, shape: Shape, at: Iterate, model: Model):
    """The largest entry of the gradient of the Lagrangian, and of all that is violated
    or not complementary; and each over what is allowed at a tolerance of one."""
    n = at.states.shape[1]
    low, high = limits_of(problem, shape, at, model.values.c)
    p, z = at.costates, at.sides[0] - at.sides[1]
    size = shape.equal.shape[1]
    rows = z.shape[1]
    pulled = jnp.pad(
        jnp.einsum("tij,ti->tj", model.F, p[1:]), ((0, 1), (0, 0))
    )
    first, last = shape.bounded
    pushed = jnp.einsum("tpi,tp->ti", model.G, z[:, rows - size :])
    pushed = pushed.at[:, first:last].add(z[:, : last - first])
    gradient = model.h - pulled + pushed
    gradient = gradient.at[:, :n].add(p)
    # The last control stands for nothing.
    gradient = gradient.at[-1, n:].set(0)
    terms = jnp.maximum(jnp.max(jnp.abs(model.h)), jnp.max(jnp.abs(pulled)))
    slope = jnp.max(jnp.abs(gradient))
    slack = jnp.stack([high, -low])
    finite = jnp.isfinite(slack)
    slack = jnp.where(finite, slack, 0)
    product = jnp.max(jnp.maximum(slack, 0) * at.sides, initial=0)
    missed = jnp.max(jnp.abs(model.values.defects))
    violation = jnp.max(broken(shape, model.values), initial=0)
    size_x = 1 + jnp.max(jnp.abs(at.states))
    return slope, slope / (1 + terms), product / (1 + terms), missed / size_x, violation


def choose_(ok, a, b):
    pick = lambda a, b: jnp.where(ok, a, b) if eqx.is_array(a) else a
    result = choose(ok, a.result, b.result)
    picked = jax.tree.map(pick, a._replace(result=None), b._replace(result=None))
    return picked._replace(result=result)


def iterate(problem: Problem, start: Iterate, options: Options) -> Progress:
    """Iterate from a trajectory to a solution."""
    T, m = start.controls.shape
    n, dtype = start.states.shape[1], start.states.dtype
    shape = shape_of(problem, T)
    zero = jnp.zeros((), dtype)
    infinite = jnp.full((), jnp.inf, dtype)
    first = Progress(
        at=start,
        price=infinite,
        weights=jnp.zeros(2, dtype),
        memory=jnp.full((MEMORY, 3), -jnp.inf, dtype),
        mu=zero,
        trace=jnp.zeros(options.max_iterations + 1, dtype),
        gains=jnp.zeros((T, m, n), dtype),
        residual=infinite,
        violation=infinite,
        iterations=jnp.zeros((), int),
        inner=jnp.zeros((), int),
        tried=jnp.zeros((), int),
        result=RESULTS.not_converged,
        done=jnp.asarray(False),
    )
    eps = jnp.finfo(dtype).eps
    tight = jnp.asarray(eps**0.5 * 1e-1, dtype)
    tolerances = Tolerances(tight, tight, jnp.asarray(1e-6, dtype))

    def program(now: Progress, model: Model):
        level, delta, convex = convex_cost(
            problem, shape, now.at, model, now.mu, now.weights[1]
        )
        form = form_of(problem, shape, now.at, model, convex, now.price)
        scaled, scaling = form.equilibrated()
        sides = form.sides(), scaled.sides()
        method = Method(form, scaled, scaling, *sides, tolerances)
        guess = warm(method, jnp.zeros_like(form.q), now.at.sides)
        left = jnp.where(now.iterations > 0, 4, 2)
        out = minimise(method, guess._replace(left=left), 60, 2)
        dx = out.x
        p = out.p - jnp.einsum("tij,tj->ti", convex.P, dx[:, :n]) - convex.s
        return dx, p, out.z, out.errors, out.iterations, convex, level, delta

    def body(now: Progress) -> Progress:
        at = now.at
        model = expanded(problem, shape, at, options.second_order)
        slope, *errors, violation = conditions(problem, shape, at, model)
        errors = jnp.max(jnp.stack(errors))
        feasible = violation <= options.constraint_tolerance
        settled = errors <= options.tolerance
        converged = settled & feasible
        # At a stationary point of the relaxed problem the price was too low.
        scale = 1 + jnp.max(jnp.abs(model.h))
        price = jnp.where(settled & ~feasible, 10 * now.price, now.price)
        hopeless = jnp.isfinite(price) & (price > MOST_PRICE * scale)
        trace = now.trace.at[now.iterations].set(model.values.cost)
        now = now._replace(trace=trace, residual=slope, violation=violation)
        now = now._replace(price=price, done=hopeless)
        now = now._replace(result=choose(hopeless, RESULTS.infeasible, now.result))
        finished = now._replace(
            done=jnp.asarray(True), result=RESULTS.successful
        )
        return lax.cond(
            converged | hopeless,
            lambda now, _: choose_(converged, finished, now),
            step,
            now,
            model,
        )

    def step(now: Progress, model: Model) -> Progress:
        at = now.at
        here = measures(shape, model.values)
        dz, p, z, errors, inner, convex, level, delta = program(now, model)
        dx, du = dz[:, :n], dz[:-1, n:]
        usable = jnp.all(jnp.isfinite(dz)) & (errors[0] <= 1e3)
        # How far the linearised constraints are from holding.
        c = model.values.c + jnp.einsum("tpi,ti->tp", model.G, dz)
        left = jnp.sum(broken(shape, model.values._replace(c=c)))
        # The funnel.
        infeasible = here[1] + here[2]
        width = jnp.where(
            jnp.isfinite(now.weights[0]) & (now.iterations > 0) & (now.weights[0] > 0),
            now.weights[0],
            jnp.maximum(WIDTH, 15 * infeasible),
        )
        decrease = -jnp.sum(model.h * dz)
        slack = 10 * eps * jnp.abs(here[0])

        def trial(i):
            length = 0.5 ** i.astype(dtype)
            states, controls = at.states + length * dx, at.controls + length * du
            controls = jax.vmap(problem.clip)(controls)
            values = evaluated(problem, shape, states, controls)
            found = measures(shape, values)
            missed = found[1] + found[2]
            by_cost = length * decrease >= 1e-3 * infeasible
            falls = found[0] <= here[0] - LEAST_SHARE * length * decrease + slack
            closes = missed <= jnp.maximum(0.9 * width, 1e-14)
            good = (missed <= width) & jnp.where(by_cost, falls, closes)
            good = good & jnp.all(jnp.isfinite(found))
            narrowed = jnp.where(by_cost, width, 0.1 * missed + 0.9 * width)
            return states, controls, good, length, narrowed

        def search(carry):
            i, *_ = carry
            return i + 1, *trial(i)

        zero_ = jnp.zeros((), dtype)
        nothing = at.states, at.controls, jnp.asarray(False), zero_, zero_
        count = jnp.where(usable, HALVINGS, 0)
        tried, states, controls, accepted, length, narrowed = lax.while_loop(
            lambda carry: ~carry[3] & (carry[0] < count),
            search,
            (jnp.zeros((), int), *nothing),
        )
        moved = Iterate(
            states,
            controls,
            at.costates + length * (p - at.costates),
            at.sides + length * (z - at.sides),
        )
        after = jax.tree.map(lambda a, b: jnp.where(accepted, a, b), moved, at)
        # Without a feasible point the constraints get a price; where they still do not
        # hold, a higher one.
        impossible = ~usable & (errors[1] <= 1) & jnp.isinf(now.price)
        scale = 1 + jnp.max(jnp.abs(model.h))
        price_next = jnp.where(impossible, FIRST_PRICE * scale, now.price)
        failed = ~accepted & ~impossible
        mu = jnp.where(
            failed, jnp.maximum(10 * now.mu, 1e-4 * jnp.max(jnp.abs(model.H))), 0.1 * now.mu
        )
        mu = jnp.where(mu < 1e-8, 0, mu)
        stuck = mu > 1e10
        count = now.iterations + 1
        result = choose(stuck, RESULTS.no_descent, RESULTS.not_converged)
        if DEBUG:
            jax.debug.print("{k} J {J:.6g} d {d:.2g} v {v:.2g} left {l:.2g} | its {i} err {e} | len {len} price {p:.2g} w {w} mu {mu:.1g} shift {sh:.1g} {lev}", lev=level, k=now.iterations, J=here[0], d=here[1], v=here[2], l=left, i=inner, e=errors, len=length, p=now.price, w=width, mu=now.mu, sh=convex.shift)
        return now._replace(
            at=after,
            price=price_next,
            weights=jnp.stack([jnp.where(accepted, narrowed, width), jnp.where(delta > 0, delta, now.weights[1])]),
            mu=mu,
            gains=convex.K,
            iterations=count,
            inner=now.inner + inner,
            tried=now.tried + tried,
            result=result,
            done=stuck | (count >= options.max_iterations),
        )

    return lax.while_loop(lambda now: ~now.done, body, first)
