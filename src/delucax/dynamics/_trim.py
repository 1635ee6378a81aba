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
    r"""Find an operating point near a guess: a state and a control at which the model
    rests.

    $$f(t, x, u) = 0 \text{ for a system}, \qquad
    F(t, x, u) = x \text{ for dynamics}$$

    Disturbances are zero. The point is a solution near the guess, but not always the
    nearest one. If there are more unknowns than equations, many solutions lie close to
    each other. Then `trim` returns the solution with the smallest change from the
    guess, to first order. If there is no solution, `trim` returns a point where the
    residual is smallest, and `result` says so.

    Changes and residuals are measured in units that follow from the guess:

    - The unit of a state is the absolute value of its guess. If the guess of a state is
        zero, its unit is the largest absolute guess of all states, or 1 if that is
        larger than 1. If the guesses of all states are zero, their unit is 1. The units
        of the controls are chosen in the same way.
    - A guess counts as zero if its absolute value is below 100 eps times the largest
        guess. If the largest guess is above 1, the threshold is 100 eps. In float32,
        100 eps is 1e-5. If a state is much smaller than the others, express it in a
        smaller unit, for example in nmol instead of mol.
    - A state or control that is not fixed is set to zero in the result if its absolute
        value is below 4 eps times its unit.
    - The residual of each equation is measured relative to the size of the terms of
        this equation.

    If the solution is a multiple root of the equations, the last digits of the
    operating point may be wrong, and `result` may be `no_equilibrium`.

    First `trim` uses the Levenberg-Marquardt method in a trust region. Then it applies
    Newton's method to the optimality conditions of the solution with the smallest
    change from the guess. The result is differentiable in forward and reverse mode with
    respect to all arrays in `model`, the guess and the fixed values, by the implicit
    function theorem.

    **Arguments:**

    - `model`: a [`delucax.AbstractSystem`][] or [`delucax.AbstractDynamics`][]. For
        [`delucax.Discretized`][] dynamics, the operating point is that of the
        continuous-time system.
    - `t`: time, a scalar, 0 by default.
    - `x`, `u`: the guess, shapes `(n,)` and `(m,)`; by default the `equilibrium` of the
        model. You may pass an `OperatingPoint` as `x`: it holds both the state and the
        control.
    - `fix`: the states and controls that stay at their guess: a name, several names, or
        a dictionary from names to values. The values in a dictionary replace the guess.
        None by default.
    - `throw`: whether to raise an error if there is no operating point, true by
        default. With `throw=False`, look at `result`.

    **Returns:** a [`delucax.dynamics.OperatingPoint`][].

    **Raises:** `ValueError` on a wrong shape, an unknown name, a time or guess that is
    not finite, if everything is fixed, or if there is no guess and the model has no
    equilibrium. An error is raised at run time if there is no operating point and
    `throw` is true.

    Source: Nocedal and Wright, 2006.

    !!! example

        ```python
        import delucax as dlx

        tanks = dlx.systems.TwoTank()
        point = dlx.trim(tanks, x=[8.0, 8.0], u=[5.0], fix={"lower": 12.0})
        model = dlx.linearize(tanks, x=point)
        point.x, point.u
        ```

        ```text
        (Array([12., 12.], dtype=float32), Array([10.894], dtype=float32))
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
        # Every solver stays where the field is zero, and the field is quicker.
        model = model.system
    point = _solve(model, jnp.asarray(t, guess.dtype), guess, free)
    facts = lambda: f"The residual is {point.residual} at x {point.x}, u {point.u}."
    return raise_on_failure(point, where, throw, "the point", facts)


def _fixed(model: Any, fix: Any, where: str) -> dict[int, Any]:
    """The index of each fixed state and control, with its value or `None`."""
    if isinstance(fix, str):
        fix = (fix,)
    names = (*model.state_names, *model.control_names)
    known = isinstance(fix, Mapping | tuple | list | set | frozenset)
    if not known or not all(isinstance(name, str) for name in fix):
        raise ValueError(
            f"{where}: fix must be a name, several names or a dictionary from names to "
            f"values, got {shortened(fix)}."
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
    """The equations. The unknowns `z` are the changes of the free states and controls,
    in their units."""

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
        # A value that is mere rounding is set to zero. Its derivative stays.
        tiny = jnp.abs(y) <= ULPS * jnp.finfo(y.dtype).eps * units
        tiny = tiny & jnp.zeros(y.shape, bool).at[free].set(True)
        return y - lax.stop_gradient(jnp.where(tiny, y, 0))

    def drift(self, y: Array) -> Array:
        """The rate of change of the state, or its change over a step."""
        model, n = self.model, self.model.state_size
        x, u = y[:n], y[n:]
        if isinstance(model, AbstractSystem):
            w = jnp.zeros(model.disturbance_size, x.dtype)
            held = w if model.disturbance_names else None
            # Projected, because there may be roots off the manifold that no trajectory
            # reaches.
            return evaluate_field(model, self.t, model.project(x), u, held)
        return model.difference(model.advance(self.t, x, u, None)[0], x)

    def expansion(self, y: Array) -> tuple[Array, Array, Array]:
        """The drift, its first derivatives, and its second derivatives with respect to
        the free entries. The program holds one copy of the model."""
        eye, k = jnp.eye(y.size, dtype=y.dtype), len(self.free)

        def along(pair):
            # Forward over forward along e_i and e_j gives F, dF/dy_i and
            # d2F/dy_i dy_j in one pass.
            first = lambda y: jax.jvp(self.drift, (y,), (pair[0],))
            (drift, slope), (_, curvature) = jax.jvp(first, (y,), (pair[1],))
            return drift, slope, curvature

        # By `lax.map` over pairs of directions, which compiles faster than `jax.vmap`.
        pairs = jnp.repeat(eye, k, 0), jnp.tile(eye[jnp.array(self.free)], (y.size, 1))
        drift, slopes, H = lax.map(along, pairs)
        return drift[0], slopes[::k].T, H.reshape(y.size, k, -1).transpose(2, 0, 1)

    def terms(self, J: Array) -> Array:
        """The size of the terms of each equation at the guess, as its unit."""
        terms = jnp.abs(J) @ self.units
        return jnp.where(terms > 0, terms, 1)


class _Point(eqx.Module):
    """The conditions of the nearest point, expanded about a point z.

    With the residual r and its Jacobian J, the nearest point solves its own linear
    model: `z = J^+ (J z - r)`. Then `J' r = 0`, and z has no part in the null space of
    J. This holds for any number of equations and unknowns, and for any rank of J.
    `offset` is the difference of the two sides, and `slope` its derivative.
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
    """The expansion at `z`, with the given `terms`, or its own if those are zero."""
    free, units = jnp.array(problem.free), problem.units
    drift, jacobian, H = problem.expansion(problem.at(z))
    terms = jnp.where(terms > 0, terms, problem.terms(jacobian))
    unit = units[free]
    # Rows are in units of their terms, columns in those of the unknowns, so that cost
    # and rank do not depend on the units of the model.
    r, J = drift / terms, jacobian[:, free] * unit / terms[:, None]
    H = H[:, free] * unit[:, None] * unit / terms[:, None, None]
    rtol = float(100 * max(J.shape) * jnp.finfo(J.dtype).eps)
    # Not by Lineax, because the derivatives of its solves raise on NaN.
    P = jnp.linalg.pinv(J, rtol=rtol)
    # The least solution of the linear model r + J (z' - z) = 0 is z' = P (J z - r).
    linear = J @ z - r
    near = P @ linear
    offset = z - near
    # The derivative of P follows from that of J (Golub and Pereyra, 1973).
    eye = jnp.eye(z.size, dtype=z.dtype)
    slope = eye - P @ jnp.einsum("ijk,j->ik", H, offset)
    slope -= P @ P.T @ jnp.einsum("ijk,i->jk", H, linear - J @ near)
    slope -= (eye - P @ J) @ jnp.einsum("ijk,i->jk", H, P.T @ near)
    return _Point(drift, jacobian, terms, r @ r, J.T @ r, J.T @ J, offset, slope)


@eqx.filter_custom_jvp
def _nearest(problem: _Problem) -> tuple[Array, Array, Array, Array]:
    """The nearest point, the drift there and its Jacobian, and the size of the last
    step.

    Levenberg-Marquardt within a trust radius, then Newton's method. Both run in one
    loop that traces the model once, because compile time dominates. If Newton's method
    does not converge, for example because J loses rank, the point of smallest residual
    is returned.
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
        # Every Newton step is taken, because it may lead to a saddle of the cost.
        better = newton | (finite & (new.cost < old.cost))
        z, new = select(better, (z + d, new), (z, old))
        # Marquardt's rule. The radius bounds the largest entry of the step, because the
        # model may have other roots far from the guess.
        damping = jnp.where(better, jnp.maximum(damping / 4, eps), damping * 4)
        radius = jnp.where(better, 2 * radius, jnp.max(jnp.abs(d)) / 4)
        diagonal = jnp.diagonal(new.gram)
        # Scaled by the diagonal, so that units do not matter. The floor is for unknowns
        # that appear in no equation.
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
        # After convergence one more step is taken, which squares the error.
        converged, done = newton & small, converged
        newton = newton | small | (step >= _MAX_STEPS)
        return step + 1, newton, converged, done, z, d, damping, radius, new, best

    no = jnp.array(False)
    best = inf, zero, blank.drift, blank.jacobian, inf
    # The first step is zero, so that the guess is expanded inside the loop. It counts
    # as a success, after which the damping is 1/4 and the radius 1.
    start = jnp.array(0), no, no, no, zero, zero, one, one / 2, blank, best
    end = lax.while_loop(proceeds, body, start)
    *_, z, d, _, _, point, (cost, *best) = end
    gap = jnp.max(jnp.abs(d))
    # Newton's method may converge to a stationary point with a larger residual than the
    # best point so far.
    good = _settled(gap, z) & (point.cost <= 1.01 * cost + eps)
    return select(good, (z, point.drift, point.jacobian, gap), tuple(best))


def _settled(gap: Array, z: Array) -> Array:
    """Whether a step was short. The bound is loose, because at a multiple root Newton's
    method is slow and reaches only a part of the digits."""
    return gap <= jnp.finfo(z.dtype).eps ** (1 / 3) * (1 + jnp.max(jnp.abs(z)))


@_nearest.def_jvp
def _nearest_jvp(primals, tangents):
    """By the implicit function theorem."""
    z, *rest = _nearest(*primals)

    def offset(problem, z):
        _, jacobian, _ = problem.expansion(problem.guess)
        return _expand(problem, z, problem.terms(jacobian)).offset

    _, change = eqx.filter_jvp(lambda problem: offset(problem, z), primals, tangents)
    # From offset(problem, z) = 0 follows d(offset)/dz dz = -change.
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
    # Relative to the terms that cancel in the drift, because these set its rounding.
    rests = lax.stop_gradient(share) <= eps**0.5
    settled = _settled(offset, z)
    failure = choose(settled, RESULTS.no_equilibrium, RESULTS.not_converged)
    failure = choose(jnp.all(jnp.isfinite(drift)), failure, RESULTS.diverged)
    if is_system:
        x = model.project(x)
    return OperatingPoint(
        x, u, drift, choose(rests & settled, RESULTS.successful, failure)
    )
