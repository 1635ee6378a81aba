"""Operating points."""

import functools
from collections.abc import Mapping
from typing import Any

import equinox as eqx
import jax
import jax.lax as lax
import jax.numpy as jnp
from jaxtyping import Array

from .._check import check_bool, check_finite, check_number, is_concrete
from .._message import shortened
from .._results import choose, RESULTS
from .._typing import RealScalar
from ..systems import AbstractSystem
from ._base import AbstractDynamics
from ._discretized import Discretized, evaluate_field
from ._linear import LinearDynamics
from ._linearize import point_of
from ._operating_point import OperatingPoint


_MAX_STEPS = 256
"""Of each of the two methods."""

_ULPS = 4
"""What rounding leaves, in units of the last place."""


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

    Of all such points it is the one nearest to the guess, each state and control in
    units of its guess, or where that is zero of the largest state or control, or of 1
    if all are zero. So where there are as many free unknowns as equations it is the
    root, and where there are more it is the least change. Where there is no such point
    it is the one with the least residual, each equation in units of the size of its
    terms, and the result says so. What is below the rounding of its unit is zero.

    Levenberg and Marquardt's method, then Newton's on the conditions of the nearest
    point. Differentiable in forward and reverse mode with respect to all arrays in
    `model`, the guess and what is fixed, by the implicit function theorem. Disturbances
    are zero.

    **Arguments:**

    - `model`: an [`delucax.AbstractSystem`][] or [`delucax.AbstractDynamics`][].
        [`delucax.Discretized`][] dynamics rest where their system does.
    - `t`: time, 0 by default.
    - `x`, `u`: the guess, shapes `(n,)` and `(m,)`; by default the `equilibrium` that
        the model names. An `OperatingPoint` as `x` stands for both.
    - `fix`: the states and controls that stay at the guess, by name: one, several, or a
        dictionary from name to value, which replaces that of the guess. None by
        default.
    - `throw`: raise if there is no operating point (default); if false, look at
        `result`.

    **Returns:** [`delucax.dynamics.OperatingPoint`][].

    **Raises:** `ValueError` on a wrong shape, an unknown name or a guess that is not
    finite, if all is fixed, or if no guess is given and the model names no equilibrium;
    an error at run time as `throw` says.

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
    if not isinstance(model, AbstractSystem | AbstractDynamics):
        raise ValueError(
            f"{where}: model must be an AbstractSystem or AbstractDynamics (an "
            f"environment has `env.trim()`), got {type(model).__name__}."
        )
    check_bool(throw, "throw", where)
    if isinstance(model, LinearDynamics):
        model = model.at(t)
    x, u = point_of(model, x, u, where)
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
    failed = point.result != RESULTS.successful
    if not throw:
        return point
    if not is_concrete(failed):
        ends = (RESULTS.no_equilibrium, RESULTS.not_converged, RESULTS.diverged)
        which = jnp.argmax(jnp.stack([point.result == end for end in ends]))
        words = [f"{where}: {RESULTS[end]}" for end in ends]
        return eqx.branched_error_if(point, failed, which, words)
    if failed:
        raise RuntimeError(
            f"{where}: {RESULTS[point.result]} The residual is {point.residual} at x "
            f"{point.x}, u {point.u}. Pass throw=False to look at the point."
        )
    return point


def relative_drift(drift: Array, jacobian: Array, x: Array, u: Array) -> Array:
    """How far from rest a point is: the largest share of `drift` among its terms,

    `|drift_i| / (|drift_i| + sum_j |jacobian_ij z_j|)`, with `z = (x, u)`, after what
    rounding may leave is taken off: of the state itself, and of the largest of the
    terms. Axes in front are times, with one largest term.
    """
    z = jnp.abs(jnp.concatenate([x, u], axis=-1))
    terms = (jnp.abs(jacobian) @ z[..., None])[..., 0]
    rounding = _ULPS * jnp.finfo(x.dtype).eps * (jnp.abs(x) + jnp.max(terms))
    left = jnp.maximum(jnp.abs(drift) - rounding, 0)
    return jnp.max(jnp.where(left == 0, 0, left / (left + terms)))


def _fixed(model: Any, fix: Any, where: str) -> dict[int, Any]:
    """From the index of each state and control that is held to its value, if given."""
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


def _units(guess: Array) -> Array:
    """The size of each entry, or where it is zero up to rounding that of the largest;
    1 if all are."""
    size = jnp.abs(guess)
    largest = jnp.max(size, initial=0)
    known = size > 10 * jnp.finfo(guess.dtype).eps * largest
    return jnp.where(known, size, jnp.where(largest > 0, largest, 1))


class _Problem(eqx.Module):
    """Unknowns are changes of what is free, relative to its units."""

    model: Any
    t: Array
    guess: Array
    free: tuple[int, ...] = eqx.field(static=True)

    @property
    def units(self) -> Array:
        n = self.model.state_size
        return jnp.concatenate([_units(self.guess[:n]), _units(self.guess[n:])])

    def at(self, z: Array) -> Array:
        moves, units = jnp.array(self.free), self.units
        y = self.guess.at[moves].add(units[moves] * z)
        # What is below the rounding of its unit is zero, and moves as it did.
        tiny = jnp.abs(y) <= 4 * jnp.finfo(y.dtype).eps * units
        tiny = tiny & jnp.zeros(y.shape, bool).at[moves].set(True)
        return y - lax.stop_gradient(jnp.where(tiny, y, 0))

    def drift(self, y: Array) -> Array:
        """How fast, or in a step how far, the state moves."""
        model, n = self.model, self.model.state_size
        x, u = y[:n], y[n:]
        if isinstance(model, AbstractSystem):
            w = jnp.zeros(model.disturbance_size, x.dtype)
            held = w if model.disturbance_names else None
            return evaluate_field(model, self.t, model.project(x), u, held)
        return model.difference(model.advance(self.t, x, u, None)[0], x)

    def expansion(self, y: Array) -> tuple[Array, Array, Array]:
        """The drift and its first and second derivatives, the last of these with
        respect to what is free, from one copy of the model."""
        eye, k = jnp.eye(y.size, dtype=y.dtype), len(self.free)

        def along(pair):
            first = lambda y: jax.jvp(self.drift, (y,), (pair[0],))
            (drift, slope), (_, bend) = jax.jvp(first, (y,), (pair[1],))
            return drift, slope, bend

        # A pair of directions after the other: a batch of them compiles for longer.
        pairs = jnp.repeat(eye, k, 0), jnp.tile(eye[jnp.array(self.free)], (y.size, 1))
        drift, slopes, bends = lax.map(along, pairs)
        return drift[0], slopes[::k].T, bends.reshape(y.size, k, -1).transpose(2, 0, 1)

    def terms(self, J: Array) -> Array:
        """The size of what moves each state at the guess, in which residuals are."""
        terms = jnp.abs(J) @ self.units
        return jnp.where(terms > 0, terms, 1)


class _Point(eqx.Module):
    """What a step of the solve looks at.

    With the residual r and its Jacobian J, the nearest point z is that of its own
    linear model, `z = J^+ (J z - r)`: then `J' r = 0`, and z has no part in the null
    space of J. That holds for as many equations as unknowns, for fewer, for more, and
    where J has not full rank. `off` is the difference of the two sides, and `slope` its
    derivative.
    """

    drift: Array
    jacobian: Array
    terms: Array
    cost: Array
    gradient: Array
    gram: Array
    off: Array
    slope: Array


def _look(problem: _Problem, z: Array, terms: Array) -> _Point:
    """The point at `z`, whose terms are those given, or if these are zero its own."""
    moves, units = jnp.array(problem.free), problem.units
    drift, jacobian, H = problem.expansion(problem.at(z))
    terms = jnp.where(terms > 0, terms, problem.terms(jacobian))
    unit = units[moves]
    r, J = drift / terms, jacobian[:, moves] * unit / terms[:, None]
    H = H[:, moves] * unit[:, None] * unit / terms[:, None, None]
    rtol = float(100 * max(J.shape) * jnp.finfo(J.dtype).eps)
    # Not by Lineax, whose solves raise in their derivative where there is NaN.
    P = jnp.linalg.pinv(J, rtol=rtol)
    linear = J @ z - r
    near = P @ linear
    off = z - near
    # The derivative of P by that of J (Golub and Pereyra, 1973).
    eye = jnp.eye(z.size, dtype=z.dtype)
    slope = eye - P @ jnp.einsum("ijk,j->ik", H, off)
    slope -= P @ P.T @ jnp.einsum("ijk,i->jk", H, linear - J @ near)
    slope -= (eye - P @ J) @ jnp.einsum("ijk,i->jk", H, P.T @ near)
    return _Point(drift, jacobian, terms, r @ r, J.T @ r, J.T @ J, off, slope)


@eqx.filter_custom_jvp
def _nearest(problem: _Problem) -> tuple[Array, Array, Array, Array]:
    """The nearest point, the drift there and its Jacobian, and how far from it the last
    step still was.

    Levenberg and Marquardt's method, then Newton's, in one loop with one copy of the
    model, whose compilation is most of the price.
    """
    dtype, n = problem.guess.dtype, problem.model.state_size
    eps = jnp.finfo(dtype).eps
    zero, zeros = jnp.zeros(len(problem.free), dtype), jnp.zeros(n, dtype)
    blank = jax.eval_shape(_look, problem, zero, zeros)
    blank = jax.tree.map(lambda leaf: jnp.full(leaf.shape, jnp.nan, dtype), blank)
    blank = eqx.tree_at(
        lambda point: (point.cost, point.terms),
        blank,
        (jnp.asarray(jnp.inf, dtype), zeros),
    )

    def proceeds(carry):
        step, _, _, done, _, d, _, _ = carry
        return (step < 2 * _MAX_STEPS) & ~done & jnp.all(jnp.isfinite(d))

    def body(carry):
        step, newton, last, _, z, d, damping, old = carry
        new = _look(problem, z + d, old.terms)
        finite = jnp.isfinite(jnp.sum(new.slope) + jnp.sum(new.gram))
        better = newton | (finite & (new.cost < old.cost))
        z = jnp.where(better, z + d, z)
        new = jax.tree.map(functools.partial(jnp.where, better), new, old)
        damping = jnp.where(better, damping / 4, damping * 4)
        diagonal = jnp.diagonal(new.gram)
        damped = new.gram + jnp.diag(damping * (diagonal + eps * jnp.max(diagonal)))
        matrix = jnp.where(newton, new.slope, damped)
        d = -jnp.linalg.solve(matrix, jnp.where(newton, new.off, new.gradient))
        small = jnp.max(jnp.abs(d)) <= 1e3 * eps * (1 + jnp.max(jnp.abs(z)))
        turn = newton | small | (step >= _MAX_STEPS)
        return step + 1, turn, newton & small, last, z, d, damping, new

    no = jnp.array(False)
    start = jnp.array(0), no, no, no, zero, zero, jnp.ones((), dtype), blank
    *_, z, d, _, point = lax.while_loop(proceeds, body, start)
    return z, point.drift, point.jacobian, jnp.max(jnp.abs(d))


@_nearest.def_jvp
def _nearest_jvp(primals, tangents):
    """By the implicit function theorem."""
    z, *rest = _nearest(*primals)

    def off(problem, z):
        return _look(problem, z, problem.terms(problem.expansion(problem.guess)[1])).off

    _, change = eqx.filter_jvp(lambda problem: off(problem, z), primals, tangents)
    dz = -jnp.linalg.solve(jax.jacfwd(off, 1)(primals[0], z), change)
    moved = lambda problem, z: problem.drift(problem.at(z))
    _, drift = eqx.filter_jvp(moved, (*primals, z), (*tangents, dz))
    return (z, *rest), (dz, drift, *(jnp.zeros_like(each) for each in rest[1:]))


@eqx.filter_jit
def _solve(model: Any, t: Array, guess: Array, free: tuple[int, ...]):
    """The point nearest to the guess, and what became of it."""
    n = model.state_size
    eps = jnp.finfo(guess.dtype).eps
    problem = _Problem(model, t, guess, free)
    z, drift, jacobian, off = _nearest(problem)
    y = problem.at(z)
    x, u = y[:n], y[n:]
    rests = lax.stop_gradient(relative_drift(drift, jacobian, x, u)) <= eps**0.5
    settled = off <= eps ** (1 / 3) * (1 + jnp.max(jnp.abs(z)))
    failure = choose(settled, RESULTS.no_equilibrium, RESULTS.not_converged)
    failure = choose(jnp.all(jnp.isfinite(drift)), failure, RESULTS.diverged)
    if isinstance(model, AbstractSystem):
        x = model.project(x)
    return OperatingPoint(
        x, u, drift, choose(rests & settled, RESULTS.successful, failure)
    )
