"""Operating points."""

import functools
from collections.abc import Mapping
from typing import Any

import equinox as eqx
import jax
import jax.lax as lax
import jax.numpy as jnp
from jaxtyping import Array

from .._check import check_bool, check_finite, check_number
from .._integration import evaluate_field
from .._message import shortened
from .._results import choose, raise_on_failure, RESULTS
from .._typing import RealScalar
from ..math._norms import relative_drift, ULPS, units_of
from ..systems import AbstractSystem
from ._base import AbstractDynamics
from ._discretized import Discretized
from ._linearize import at_point, OperatingPoint


_MAX_STEPS = 256
"""The step limit of each of the two methods."""


def trim(
    model: AbstractSystem | AbstractDynamics,
    t: RealScalar = 0.0,
    x: Any = None,
    u: Any = None,
    *,
    fix: Any = (),
    throw: bool = True,
) -> OperatingPoint:
    r"""An operating point: a state and a control with

    `f(t, x, u) = 0` for a system, `F(t, x, u) = x` for dynamics.

    It is a root near the guess, not always the nearest. Where there are more free
    unknowns than equations it is the least change among its neighbours, to first order.
    The unit of each state is its guess, or where that is zero the largest guess of a
    state, at most 1, and 1 if all are zero; so for controls. A guess counts as zero if
    it is below 100 eps times the largest one, or times 1 if that is less: in float32,
    1e-5 of it. Residuals are measured relative to these units, so scale states that are
    much smaller than the others (use nmol, for instance). A free state or control below
    4 eps of its unit is set to zero. Where there is no root it is a point of least
    residual, each equation in units of the size of its terms, and the result says so.
    At a multiple root the last digits may be missing, and the result be
    `no_equilibrium`.

    Levenberg and Marquardt's method in a trust region, then Newton's on the conditions
    of the nearest point. Differentiable in forward and reverse mode with respect to all
    arrays in `model`, the guess and what is fixed, by the implicit function theorem.
    Disturbances are zero.

    **Arguments:**

    - `model`: an [`delucax.AbstractSystem`][] or [`delucax.AbstractDynamics`][].
        [`delucax.Discretized`][] dynamics rest where their system does.
    - `t`: time, 0 by default.
    - `x`, `u`: the guess, shapes `(n,)` and `(m,)`; by default the `equilibrium` that
        the model defines. An `OperatingPoint` as `x` supplies both.
    - `fix`: the states and controls that stay at the guess, by name: one, several, or a
        dictionary from name to value, which replaces that of the guess. None by
        default.
    - `throw`: raise if there is no operating point (default); if false, look at
        `result`.

    **Returns:** [`delucax.dynamics.OperatingPoint`][].

    **Raises:** `ValueError` on a wrong shape, an unknown name, a time or guess that is
    not finite, if all is fixed, or if no guess is given and the model defines no
    equilibrium; an error at run time as `throw` says.

    Source: Nocedal and Wright, 2006.

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp

        tanks = dlx.systems.TwoTank()
        point = dlx.trim(tanks, x=[8.0, 8.0], u=[5.0], fix={"lower": 12.0})
        point.x, point.u
        dlx.linearize(tanks, x=point).A
        ```
    """
    where = "trim"
    check_bool(throw, "throw", where)
    check_number(t, "t", where)
    hint = "an environment has `env.trim()`"
    model, x, u = at_point(model, t, x, u, where, hint)
    check_finite(x, "x (the state)", where)
    check_finite(u, "u (the control)", where)
    guess = jnp.concatenate([x, u])
    values = _fixed(model, fix, where)
    for index, value in values.items():
        if value is not None:
            guess = guess.at[index].set(value)
    free = tuple(i for i in range(guess.size) if i not in values)
    if not free:
        raise ValueError(f"{where}: fix must leave a state or a control free.")
    if isinstance(model, Discretized):
        # Where the field is zero the state stays, by any method that integrates it.
        model = model.system
    point = _solve(model, jnp.asarray(t, guess.dtype), guess, free)
    facts = lambda: f"The residual is {point.residual} at x {point.x}, u {point.u}."
    return raise_on_failure(point, where, throw, "the point", facts)


def _fixed(model: Any, fix: Any, where: str) -> dict[int, Any]:
    """The index of each state and control that is held, with its value if given."""
    if isinstance(fix, str):
        fix = (fix,)
    names = (*model.state_names, *model.control_names)
    known = isinstance(fix, Mapping | tuple | list | set | frozenset)
    if not known or not all(isinstance(name, str) for name in fix):
        raise ValueError(
            f"{where}: fix must be a name, names or a dictionary from name to value, "
            f"got {shortened(fix)}."
        )
    values = {}
    for name in fix:
        if names.count(name) != 1:
            some = "none" if name not in names else "more than one"
            raise ValueError(
                f"{where}: fix must name states and controls, which are "
                f"{', '.join(names)}; {some} is named {name!r}."
            )
        value = fix[name] if isinstance(fix, Mapping) else None
        if value is not None:
            check_number(value, f"fix[{name!r}]", where)
        values[names.index(name)] = value
    return values


class _Problem(eqx.Module):
    """Unknowns are changes of what is free, relative to its units."""

    model: Any
    t: Array
    guess: Array
    free: tuple[int, ...] = eqx.field(static=True)

    @property
    def units(self) -> Array:
        n = self.model.state_size
        return jnp.concatenate([units_of(self.guess[:n]), units_of(self.guess[n:])])

    def at(self, z: Array) -> Array:
        free, units = jnp.array(self.free), self.units
        y = self.guess.at[free].add(units[free] * z)
        # Set to zero where it is rounding alone; its derivative stays.
        tiny = jnp.abs(y) <= ULPS * jnp.finfo(y.dtype).eps * units
        tiny = tiny & jnp.zeros(y.shape, bool).at[free].set(True)
        return y - lax.stop_gradient(jnp.where(tiny, y, 0))

    def drift(self, y: Array) -> Array:
        """The rate of change of the state, or its change in a step."""
        model, n = self.model, self.model.state_size
        x, u = y[:n], y[n:]
        if isinstance(model, AbstractSystem):
            w = jnp.zeros(model.disturbance_size, x.dtype)
            held = w if model.disturbance_names else None
            # A state is at rest on its manifold: off it, there would be roots that no
            # trajectory reaches.
            return evaluate_field(model, self.t, model.project(x), u, held)
        return model.difference(model.advance(self.t, x, u, None)[0], x)

    def expansion(self, y: Array) -> tuple[Array, Array, Array]:
        """The drift and its first and second derivatives, the last of these with
        respect to what is free, from one copy of the model."""
        eye, k = jnp.eye(y.size, dtype=y.dtype), len(self.free)

        def along(pair):
            # Forward over forward, along e_i and then e_j: F, dF/dy_i and d2F/dy_i dy_j
            # in one pass.
            first = lambda y: jax.jvp(self.drift, (y,), (pair[0],))
            (drift, slope), (_, curvature) = jax.jvp(first, (y,), (pair[1],))
            return drift, slope, curvature

        # By `lax.map` over pairs of directions, because `jax.vmap` compiles for longer.
        pairs = jnp.repeat(eye, k, 0), jnp.tile(eye[jnp.array(self.free)], (y.size, 1))
        drift, slopes, H = lax.map(along, pairs)
        return drift[0], slopes[::k].T, H.reshape(y.size, k, -1).transpose(2, 0, 1)

    def terms(self, J: Array) -> Array:
        """The size of the terms of each equation at the guess, a unit of it."""
        # Of J dz, entry by entry: a residual is small if it is beside these.
        terms = jnp.abs(J) @ self.units
        return jnp.where(terms > 0, terms, 1)


class _Point(eqx.Module):
    """The conditions of the nearest point, expanded at one.

    With the residual r and its Jacobian J, the nearest point z is that of its own
    linear model, `z = J^+ (J z - r)`: then `J' r = 0`, and z has no part in the null
    space of J. That holds for as many equations as unknowns, for fewer, for more, and
    where J has not full rank. `offset` is the difference of the two sides, and `slope`
    its derivative.
    """

    drift: Array
    jacobian: Array
    terms: Array
    cost: Array
    gradient: Array
    gram: Array
    offset: Array
    slope: Array


def _expand(problem: _Problem, z: Array, terms: Array) -> _Point:
    """The point at `z`, whose terms are those given, or if these are zero its own."""
    free, units = jnp.array(problem.free), problem.units
    drift, jacobian, H = problem.expansion(problem.at(z))
    terms = jnp.where(terms > 0, terms, problem.terms(jacobian))
    unit = units[free]
    # Rows in units of their terms and columns in those of the unknowns, so that neither
    # cost nor rank depends on the units of the model.
    r, J = drift / terms, jacobian[:, free] * unit / terms[:, None]
    H = H[:, free] * unit[:, None] * unit / terms[:, None, None]
    rtol = float(100 * max(J.shape) * jnp.finfo(J.dtype).eps)
    # Not by Lineax, whose solves raise in their derivative where there is NaN.
    P = jnp.linalg.pinv(J, rtol=rtol)
    # The least solution of the linear model r + J (z' - z) = 0 is z' = P (J z - r).
    linear = J @ z - r
    near = P @ linear
    offset = z - near
    # The derivative of P by that of J (Golub and Pereyra, 1973).
    eye = jnp.eye(z.size, dtype=z.dtype)
    slope = eye - P @ jnp.einsum("ijk,j->ik", H, offset)
    slope -= P @ P.T @ jnp.einsum("ijk,i->jk", H, linear - J @ near)
    slope -= (eye - P @ J) @ jnp.einsum("ijk,i->jk", H, P.T @ near)
    return _Point(drift, jacobian, terms, r @ r, J.T @ r, J.T @ J, offset, slope)


@eqx.filter_custom_jvp
def _nearest(problem: _Problem) -> tuple[Array, Array, Array, Array]:
    """The nearest point, the drift there and its Jacobian, and the size of the last
    step.

    Levenberg and Marquardt's method within a trust radius, then Newton's, in one loop
    that traces the model once, because compile time dominates. Where Newton's
    does not converge, as where J loses rank, it is the point of least residual.
    """
    dtype, n = problem.guess.dtype, problem.model.state_size
    eps = jnp.finfo(dtype).eps
    zero, zeros = jnp.zeros(len(problem.free), dtype), jnp.zeros(n, dtype)
    one, inf = jnp.ones((), dtype), jnp.full((), jnp.inf, dtype)
    blank = eqx.filter_eval_shape(_expand, problem, zero, zeros)
    blank = jax.tree.map(lambda leaf: jnp.full(leaf.shape, jnp.nan, dtype), blank)
    blank = eqx.tree_at(lambda point: (point.cost, point.terms), blank, (inf, zeros))
    select = lambda which, a, b: jax.tree.map(functools.partial(jnp.where, which), a, b)

    def proceeds(carry):
        step, _, _, done, _, d, *_ = carry
        return (step < 2 * _MAX_STEPS) & ~done & jnp.all(jnp.isfinite(d))

    def body(carry):
        step, newton, converged, _, z, d, damping, radius, old, best = carry
        new = _expand(problem, z + d, old.terms)
        finite = jnp.isfinite(jnp.sum(new.slope) + jnp.sum(new.gram))
        # Newton's steps are all taken: towards a saddle of the cost, too.
        better = newton | (finite & (new.cost < old.cost))
        z, new = select(better, (z + d, new), (z, old))
        # Marquardt's rule. The radius bounds the step in the largest entry, because far
        # from the guess the model may have other roots.
        damping = jnp.where(better, jnp.maximum(damping / 4, eps), damping * 4)
        radius = jnp.where(better, 2 * radius, jnp.max(jnp.abs(d)) / 4)
        diagonal = jnp.diagonal(new.gram)
        # Scaled by the diagonal, so that units don't matter; unknowns that no equation
        # has would make it singular.
        floor = eps * (jnp.max(diagonal) + eps)
        damped = new.gram + jnp.diag(damping * (diagonal + floor))
        matrix = jnp.where(newton, new.slope, damped)
        d = -jnp.linalg.solve(matrix, jnp.where(newton, new.offset, new.gradient))
        length = jnp.max(jnp.abs(d))
        d = jnp.where(newton | (length <= radius), d, d * (radius / length))
        gap = jnp.max(jnp.abs(d))
        small = gap <= 1e3 * eps * (1 + jnp.max(jnp.abs(z)))
        here = new.cost, z, new.drift, new.jacobian
        best = (
            *select(new.cost < best[0], here, best[:-1]),
            jnp.where(newton, best[-1], gap),
        )
        # One more step after convergence, whose error is the square of the last one.
        converged, done = newton & small, converged
        newton = newton | small | (step >= _MAX_STEPS)
        return step + 1, newton, converged, done, z, d, damping, radius, new, best

    no = jnp.array(False)
    best = inf, zero, blank.drift, blank.jacobian, inf
    # The first step is zero: it expands the guess inside the loop, and counts as a
    # success, after which the damping is 1/4 and the radius 1.
    start = jnp.array(0), no, no, no, zero, zero, one, one / 2, blank, best
    end = lax.while_loop(proceeds, body, start)
    *_, z, d, _, _, point, (cost, *best) = end
    gap = jnp.max(jnp.abs(d))
    # Newton's method may converge to another stationary point, of a larger residual
    # than the best one visited.
    good = _settled(gap, z) & (point.cost <= 1.01 * cost + eps)
    return select(good, (z, point.drift, point.jacobian, gap), tuple(best))


def _settled(gap: Array, z: Array) -> Array:
    """Whether a step was short: at a multiple root, where Newton's method is slow and
    the root known to a part of its digits, too."""
    return gap <= jnp.finfo(z.dtype).eps ** (1 / 3) * (1 + jnp.max(jnp.abs(z)))


@_nearest.def_jvp
def _nearest_jvp(primals, tangents):
    """By the implicit function theorem."""
    z, *rest = _nearest(*primals)

    def offset(problem, z):
        _, jacobian, _ = problem.expansion(problem.guess)
        return _expand(problem, z, problem.terms(jacobian)).offset

    _, change = eqx.filter_jvp(lambda problem: offset(problem, z), primals, tangents)
    # The implicit function theorem for offset(problem, z) = 0: d offset/dz dz =
    # -change.
    dz = -jnp.linalg.solve(jax.jacfwd(offset, 1)(primals[0], z), change)
    drift_at = lambda problem, z: problem.drift(problem.at(z))
    _, drift = eqx.filter_jvp(drift_at, (*primals, z), (*tangents, dz))
    return (z, *rest), (dz, drift, *(jnp.zeros_like(each) for each in rest[1:]))


@eqx.filter_jit
def _solve(model: Any, t: Array, guess: Array, free: tuple[int, ...]):
    """The point nearest to the guess, with its status."""
    n = model.state_size
    eps = jnp.finfo(guess.dtype).eps
    problem = _Problem(model, t, guess, free)
    z, drift, jacobian, offset = _nearest(problem)
    y = problem.at(z)
    x, u = y[:n], y[n:]
    is_system = isinstance(model, AbstractSystem)
    share = relative_drift(drift, jacobian, x, u, is_map=not is_system)
    # Relative to the terms that cancel in the drift, which set its rounding.
    rests = lax.stop_gradient(share) <= eps**0.5
    settled = _settled(offset, z)
    failure = choose(settled, RESULTS.no_equilibrium, RESULTS.not_converged)
    failure = choose(jnp.all(jnp.isfinite(drift)), failure, RESULTS.diverged)
    if is_system:
        x = model.project(x)
    return OperatingPoint(
        x, u, drift, choose(rests & settled, RESULTS.successful, failure)
    )
