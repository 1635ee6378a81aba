"""Derivatives of a solution, by the implicit function theorem at its active set.

A side with a positive multiplier becomes an equation, and a side with a positive slack
is left out. The conditions of optimality are then linear equations in the change of the
solution, with the matrix of one more step of the method. If the solution is not unique,
or if the multiplier and the slack of a side are both zero (the side is about to become
active or inactive), there is no derivative, and the result is NaN.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jax.flatten_util import ravel_pytree

from .._jax import by_lanes, nan_tangent
from .._typing import Array
from ..math._linear_solve import full_precision
from ._active_set import Guess, GUESSES
from ._embedding import Method, Outcome, Tolerances
from ._form import AbstractForm, both, Sides, signed
from ._interior_point import assembled, minimise, solved


_CLEAR = 1e3
"""It is clear whether a side is active if its multiplier is this many times its slack,
or the reverse, in the scaled problem."""
_PASSES = 3
_PROBING = 2
"""Passes of the linear solve, and of the solve that shows whether it is singular."""


class Options(eqx.Module):
    """The options of the method, which do not change the solution."""

    start: Any
    tolerances: Tolerances
    max_steps: int = eqx.field(static=True)
    refinements: int = eqx.field(static=True)


def optimum(form: AbstractForm, options: Options) -> Outcome:
    """The outcome of the method, differentiable with respect to the program."""
    return _optimum(form, options)


def _run(form: AbstractForm, options: Options) -> Outcome:
    method = Method.of(form, options.tolerances)
    none = jnp.zeros_like(method.sides.h, bool)
    guess = Guess(none, none, jnp.asarray(GUESSES))
    if options.start is not None:
        x, _, z = options.start
        guess = warm(method, x, z)
    return minimise(method, guess, options.max_steps, options.refinements)


def warm(method: Method, x: Array, z: Array) -> Guess:
    """The sides that are active at a point; none if the point is not finite."""
    D, _, R, c = method.scaling
    sides = method.sides
    usable = jnp.all(jnp.isfinite(x)) & jnp.all(jnp.isfinite(z))
    x, z = (jnp.where(usable, a, 0) for a in (x / D, z * c / R))
    slack = sides.h - both(method.scaled.rows(x))
    active = sides.inequality & (z > slack)
    over = active & sides.soft & (-slack > sides.v - z) & (slack < 0)
    return Guess(active & ~over, over, jnp.asarray(GUESSES))


@eqx.filter_custom_jvp
def _optimum(form: AbstractForm, options: Options) -> Outcome:
    return by_lanes(_run, form, options)


@_optimum.def_jvp
@full_precision
def _optimum_jvp(primals: Any, tangents: Any) -> Any:
    change, _ = tangents
    form, _ = primals
    outcome = _optimum(*primals)
    nothing = jax.tree.map(lambda _: None, outcome)
    if not jax.tree.leaves(change):
        return outcome, nothing
    change = jax.tree.map(
        lambda p, t: jnp.zeros_like(p) if t is None and eqx.is_inexact_array(p) else t,
        form,
        change,
        is_leaf=lambda leaf: leaf is None,
    )
    last = outcome.iterate
    pushes = lambda method: method.apart(last.v / last.tau)[2:]
    *moved, unique = _change(form, change, outcome[:3], pushes)
    # A failed solve has no derivative.
    ok = unique & (outcome.errors[0] <= 1)
    dx, dp, dz = (nan_tangent(d, ok) for d in moved)
    return outcome, nothing._replace(x=dx, p=dp, z=dz)


def moved_with(form: AbstractForm, change: AbstractForm, x: Array, p: Array, z: Array):
    """The change of a known solution, and whether the solution is unique."""

    def pushes(method):
        (D, _, R, c), sides = method.scaling, method.sides
        over = both(method.scaled.rows(x / D)) - sides.h
        pushed = z * c / R
        t = jnp.where(sides.soft, jnp.maximum(over, 0), 0)
        s = jnp.where(sides.inequality, jnp.maximum(t - over, 0), 0)
        m = jnp.where(sides.hinge, jnp.maximum(sides.v + sides.W * t - pushed, 0), 0)
        return pushed, s, t, m

    return _change(form, change, (x, p, z), pushes)


def _change(form: AbstractForm, change: AbstractForm, point: Any, pushes: Any):
    """The change of `x`, `p` and `z`, and whether the solution is unique.

    For the scaled problem, `pushes` gives the multipliers and slacks of the sides, and
    the violations of soft sides with their multipliers.
    """
    method = Method.of(form)
    scaled, sides, (D, E, R, c) = method.scaled, method.sides, method.scaling
    x, p, z = (jnp.where(jnp.isfinite(a), a, 0) for a in point)
    scaled_z, s, t, m = pushes(method)
    pressed = sides.inequality & (scaled_z > s)
    clear = _are_unlike(scaled_z, s) | ~sides.inequality
    violated = jnp.zeros_like(pressed)
    if form.soft is not None:
        violated = pressed & sides.soft & ((t > m) | ~sides.hinge)
        clear = clear & (_are_unlike(t, m) | ~(pressed & sides.hinge))
    held = sides.equality | (pressed & ~violated)
    spring = violated & (sides.W > 0)

    def conditions(form):
        """The gradient of the Lagrangian, the equations, the held rows, and the weights
        that are the multipliers of violated sides without a quadratic weight."""
        sides = form.sides()
        pushed = jnp.where(violated & ~spring, sides.v, z)
        act = form.rows_transposed(signed(pushed)) + form.equations_transposed(p)
        rows = both(form.rows(x)) - sides.h
        W = jnp.where(spring, sides.W, 1)
        rows = rows - jnp.where(spring, (z - sides.v) / W, 0)
        own = jnp.where(violated & ~spring, sides.v, 0)
        gradient = form.hessian(x) + form.q + act
        return (
            gradient,
            form.equations(x) - form.f,
            jnp.where(held | spring, rows, 0),
            own,
        )

    *right, own = jax.jvp(conditions, (form,), (change,))[1]
    right = [-a * unit for a, unit in zip(right, (c * D, E, R), strict=True)]
    # A linear system as in a step of the method. Held sides are its equations.
    none = jnp.zeros_like(scaled_z)
    W = jnp.where(spring, sides.W, 1)
    system_sides = Sides(none, spring, held, spring, spring, none, W)
    compliance = jnp.where(spring, 1 / W, 0)
    on = system_sides.active

    def product(vector):
        x, p, z = vector
        pull = scaled.equations_transposed(p) + scaled.rows_transposed(signed(z * on))
        rows = both(scaled.rows(x)) - compliance * z
        # Sides that are not active get the identity.
        return scaled.hessian(x) + pull, scaled.equations(x), jnp.where(on, rows, z)

    # Multiply a vector with the system and solve: a singular system does not return it.
    probe = jax.tree.map(
        lambda a: jnp.cos(1.0 + jnp.arange(a.size, dtype=a.dtype)).reshape(a.shape),
        (x, p, z),
    )
    probe = scaled.admissible(*probe[:2]) + (jnp.where(on, probe[2], 0),)

    def factorised(scaled, sides, compliance, probe, right):
        system = assembled(scaled, sides, compliance)
        returned = solved(scaled, sides, system, right, _PROBING)
        pairs = zip(probe, returned, strict=True)
        off = [jnp.max(jnp.abs(a - b), initial=0) for a, b in pairs]
        return system, jnp.max(jnp.stack(off))

    # A linear solve needs no derivatives of its factors.
    fixed = lax.stop_gradient((scaled, system_sides, compliance, probe, product(probe)))
    system, off = by_lanes(factorised, *fixed)
    unique = jnp.all(clear) & (off < 1e-2)

    def refined(scaled, sides, system, right):
        return solved(scaled, sides, system, right, _PASSES)

    def solve(_, right):
        x, p, z = by_lanes(refined, *fixed[:2], system, right)
        return x, p, jnp.where(on, z, right[2])

    # As one vector, because the whole right side must be linear in the tangents.
    flat, apart = ravel_pytree(tuple(right))
    flattened = lambda f: lambda *args: ravel_pytree(f(*args[:-1], apart(args[-1])))[0]
    dx, dp, dz = apart(
        lax.custom_linear_solve(
            flattened(product), flat, flattened(solve), flattened(solve), symmetric=True
        )
    )
    return dx * D, dp * E / c, dz * R / c + own, unique


def _are_unlike(a: Array, b: Array) -> Array:
    return jnp.maximum(a, b) > _CLEAR * jnp.minimum(a, b)
