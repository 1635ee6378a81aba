"""The quadratic program of an SQP iteration, and the errors of an iterate."""

from typing import Any

import jax.numpy as jnp

from .._typing import Array
from ..qp._derivatives import warm
from ..qp._embedding import Method, Outcome as Solved, Tolerances
from ..qp._interior_point import minimise
from ..qp._staged import StagedForm
from ._convex import Convex, Held, held_rows
from ._transcription import Iterate, Limits, Model


MAX_STEPS = 60


def rows_left(limits: Limits, rows: Array) -> tuple[Array, Array]:
    """The bounds of the changes of the rows."""
    return limits.low - rows, limits.high - rows


def priced(limits: Limits, price: Array, on: Array) -> Limits:
    """The limits in which, if `on`, hard rows may be violated at a price. Hard bounds
    of controls and of unknowns stay hard."""
    steps, size = limits.low.shape
    index, stage = jnp.arange(size), jnp.arange(steps)[:, None]
    elastic = ((index < limits.states) & (stage > 0)) | (index >= limits.own)
    elastic = elastic & limits.hard & on
    return limits._replace(
        linear=jnp.where(elastic, 0, limits.linear),
        quadratic=jnp.where(elastic, price, limits.quadratic),
    )


def without(paid: Array, price: Array, held: Held, low: Array, high: Array):
    """Remove the bounds of the rows that are paid for. If such a row is violated, its
    square is added to the cost."""
    over = paid & ((low > 0) | (high < 0))
    target = jnp.where(over, jnp.where(low > 0, low, high), held.target)
    held = Held(held.rows, target, jnp.where(over, price, 0))
    return held, jnp.where(paid, -jnp.inf, low), jnp.where(paid, jnp.inf, high)


def form_of(
    limits: Limits, model: Model, convex: Convex, low: Array, high: Array
) -> StagedForm:
    """The quadratic program in the form of the solver."""
    soft = None
    if limits.is_soft:
        v, W = limits.linear, limits.quadratic
        soft = jnp.stack([v, v]), jnp.stack([W, W])
    return StagedForm(
        H=convex.H,
        q=convex.h,
        F=model.F,
        f=model.values.defects,
        G=model.G,
        lower=low,
        upper=high,
        soft=soft,
        bounded=limits.bounded,
        free=limits.free,
    )


def infeasibility(limits: Limits, values: Any) -> Array:
    """The sum of all violations, of the dynamics and of the hard rows."""
    broken = jnp.sum(limits.broken(values.rows))
    return jnp.sum(jnp.abs(values.defects)) + broken


def optimality(limits: Limits, at: Iterate, model: Model) -> tuple[Array, ...]:
    """The errors of an iterate.

    Returns the gradient of the Lagrangian without the terms of the rows, the largest
    entry of the whole gradient, the largest relative error of the optimality conditions
    (without the violations of the rows), and the largest violation.
    """
    n, rows = at.states.shape[1], model.values.rows
    p, z = at.costates, at.sides[0] - at.sides[1]
    first, last = limits.bounded
    pulled = jnp.sum(model.F * p[1:, :, None], axis=1)
    pulled = jnp.pad(pulled, ((0, 1), (0, 0)))
    pushed = jnp.sum(model.G * z[:, limits.own :, None], axis=1)
    pushed = pushed.at[:, first:last].add(z[:, : limits.own])
    own = (model.h - pulled).at[:, :n].add(p)
    gradient = own + pushed
    # The last row of the controls is padding.
    slope = jnp.max(jnp.abs(gradient.at[-1, n:].set(0)))
    scale = 1 + jnp.maximum(jnp.max(jnp.abs(model.h)), jnp.max(jnp.abs(pulled)))
    # Complementarity: the multiplier of an inactive row is zero, that of a violated
    # soft row is its price.
    slack = jnp.stack([limits.high - rows, rows - limits.low])
    slack = jnp.where(jnp.isfinite(slack), slack, 0)
    products = jnp.maximum(slack, 0) * at.sides
    over = jnp.where(limits.hard, 0, jnp.maximum(-slack, 0))
    price = jnp.where(limits.hard, 0, limits.linear + limits.quadratic * over)
    unpaid = over * jnp.abs(price - at.sides)
    product = jnp.max(jnp.maximum(products, unpaid), initial=0)
    missed = jnp.max(jnp.abs(model.values.defects))
    missed = missed / (1 + jnp.max(jnp.abs(at.states)))
    error = jnp.maximum(jnp.maximum(slope, product) / scale, missed)
    return own, slope, error, jnp.max(limits.broken(rows), initial=0)


def solved(
    form: StagedForm, at: Iterate, guesses: Array | int, tolerance: Array
) -> Solved:
    """The solution of the program. The multipliers of the iterate give the first guess
    of the active constraints."""
    certificate = jnp.asarray(1e-6, form.q.dtype)
    method = Method.of(form, Tolerances(tolerance, tolerance, certificate))
    guess = warm(method, jnp.zeros_like(form.q), at.sides)
    left = jnp.asarray(guesses, guess.left.dtype)
    return minimise(method, guess._replace(left=left), MAX_STEPS, 2)


def curved(limits: Limits, at: Iterate, model: Model) -> Held:
    """The active rows at an iterate."""
    return held_rows(limits, at.sides, *rows_left(limits, model.values.rows))
