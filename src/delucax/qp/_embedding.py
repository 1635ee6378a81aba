"""The homogeneous embedding of a program: its points and its residuals.

    H x + q tau + F'p + G'z = 0,   F x = f tau,   G x - t + s = h tau,
    W t + v tau = z + m,   kappa + q'x + v't + f'p + h'z + (x'H x + t'W t) / tau = 0,
    s z = 0,   t m = 0,   tau kappa = 0,   and s, z, t, m, tau, kappa >= 0.

A solution of the embedding is either a solution of the program (`tau > 0`) or a
certificate that the program has no solution (`tau = 0`).

Source: Andersen and Ye, 1999; Goulart and Chen, 2024 (with a quadratic cost).
"""

import math
from typing import NamedTuple

import jax.numpy as jnp

from .._typing import Array, Scalar
from ._form import AbstractForm, both, Scaling, Sides, signed


class Iterate(NamedTuple):
    """A point of the embedding, or a direction.

    All vectors are in one, so that an operation on all entries compiles to one loop:
    `x, p, z, s`, and `t, m` if there are soft sides.
    """

    v: Array
    tau: Scalar
    kappa: Scalar


class Residuals(NamedTuple):
    """The residual of each line of the embedding, and the errors of the end tests."""

    x: Array
    p: Array
    z: Array
    t: Array
    tau: Scalar
    Hx: Array
    products: Scalar  # s'z + t'm + tau kappa
    linear: Scalar
    """The larger of the errors of the lines `x` and `p`, relative to the tolerance,
    times tau."""
    measured: Array
    """The primal residual, the dual residual, the complementarity and the gap of the
    program, in the units of the user."""
    errors: Array
    """The largest of these, relative to the tolerance, and the errors of the
    certificates that the program is infeasible and that it is unbounded."""
    gains: Array
    """The support of the first certificate and the slope of the second, scaled."""


class Tolerances(NamedTuple):
    """A residual may be `atol + rtol * scale`; `certificate` is for certificates."""

    atol: Array
    rtol: Array
    certificate: Array


class Outcome(NamedTuple):
    """The best point in the units of the user, and its residuals."""

    x: Array
    p: Array
    z: Array
    iterate: Iterate
    measured: Array
    errors: Array
    gains: Array
    iterations: Array


class Method(NamedTuple):
    """A program, the scaled program, and the sides of both."""

    form: AbstractForm
    scaled: AbstractForm
    scaling: Scaling
    own_sides: Sides
    sides: Sides
    tolerances: Tolerances | None

    @staticmethod
    def of(form: AbstractForm, tolerances: Tolerances | None = None) -> "Method":
        """The method for a program."""
        scaled, scaling = form.equilibrated()
        own = form.sides()
        sides = form.meaningful(own).scaled(scaling)
        return Method(form, scaled, scaling, own, sides, tolerances)

    @property
    def is_soft(self) -> bool:
        """Whether some side may be violated."""
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
    """The largest magnitude in each of some arrays of one shape, in one loop."""
    stacked = jnp.abs(jnp.stack(arrays))
    return list(jnp.max(stacked, axis=range(1, stacked.ndim), initial=0))


def _sums(*arrays: Array) -> list[Scalar]:
    """The sum of each of some arrays of one shape."""
    stacked = jnp.stack(arrays)
    return list(jnp.sum(stacked, axis=range(1, stacked.ndim)))


def evaluated(method: Method, at: Iterate) -> Residuals:
    """The residuals of the program in the units of the user, and those of the scaled
    embedding, which follow from them because all scales are powers of two."""
    form, sides = method.form, method.own_sides
    D, E, R, c = method.scaling
    assert method.tolerances is not None
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
    # A direction of recession does not violate the rows with bounds of zero.
    outward = jnp.where(sides.equality, row, jnp.maximum(row, 0))
    slack = jnp.where(sides.inequality, z * jnp.maximum(-over, 0), 0)

    square, slope, x_size = _sums(x * Hx, x * form.q, jnp.abs(x))
    lift, p_size = _sums(form.f * p, jnp.abs(p))
    products, push, z_size = _sums(s * scaled_z, sides.h * z, jnp.abs(z))
    dual, *x_terms, pull, flat = _largest(
        left_x, Hx, form.q, pulled, pulled * D, Hx * D
    )
    missed, p_term, drift = _largest(left_p, form.f, reached * E)
    # A bound that is far away, such as 1e6 for none, does not excuse another one.
    near = jnp.where(violated != 0, sides.h, 0)
    violated, *z_terms, outward, product = _largest(
        violated, row, near, outward * R, slack
    )
    left_t, support = t, push
    if method.is_soft:
        resistance = sides.W * t_own
        slack_t = jnp.where(sides.soft, resistance + sides.v - z, 0)
        left_t = jnp.where(sides.soft, slack_t * c * tau / R - m, 0)
        # Soft sides do not take part in a certificate.
        yielding = jnp.where(sides.soft, z, 0)
        resisted = pulled - form.rows_transposed(signed(yielding))
        (pull,) = _largest(resisted * D)
        costs, squares, extra, given = _sums(
            sides.v * t_own, resistance * t_own, t * m, yielding * sides.h
        )
        negative, product_t, flat_t = _largest(
            jnp.minimum(slack_t, 0), slack_t * t_own, resistance / R
        )
        slope, square, products = slope + costs, square + squares, products + extra
        dual, product = jnp.maximum(dual, negative), jnp.maximum(product, product_t)
        flat, support = jnp.maximum(flat, flat_t), push - given
    gap = square + slope + lift + push
    products = products + tau * at.kappa

    # Each residual is compared with the terms that cancel in it.
    terms = jnp.max(jnp.abs(jnp.stack([square, slope, lift, push])))
    left = jnp.stack([violated, missed, dual, product, jnp.abs(gap)])
    rows, gradient = jnp.max(jnp.stack(z_terms)), jnp.max(jnp.stack(x_terms))
    scales = jnp.stack([rows, jnp.maximum(rows, p_term), gradient, terms, terms])
    errors = left / (atol + rtol * scales)
    # A certificate is judged in the scaled problem, so that units do not matter. It
    # must also hold after a change of all data by the tolerance, because a program that
    # is feasible after such a change counts as solvable.
    unit = c * tau
    gains = jnp.stack([lift + support, slope])
    relaxed = unit * (gains + (atol + rtol) * jnp.stack([p_size + z_size, x_size]))
    worst = jnp.maximum(jnp.maximum(flat * c, drift), outward)
    failings = tau * jnp.stack([pull * c, worst])
    certificates = jnp.where(relaxed < 0, failings / (least * -relaxed), jnp.inf)
    measured = jnp.concatenate([jnp.maximum(left[:1], left[1:2]), left[2:]])
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
