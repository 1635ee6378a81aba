"""The interface between a quadratic program and the interior-point method.

Minimise `1/2 x'H x + q'x` such that `F x = f` and `lower <= G x <= upper`. Each row has
two sides, the upper and the lower one, in this order on a leading axis. A side without
a finite bound does not take part. If both bounds of a row are equal, its upper side is
an equation. A soft side may be violated by `t >= 0` at the cost `v t + 1/2 W t^2`.
"""

from abc import abstractmethod
from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp

from .._module import shown
from .._typing import Array, Scalar


class Scaling(NamedTuple):
    """The factors of the scaled problem, all powers of two. Its unknowns are
    `x / primal`. Its equations, rows and cost are multiplied by the other three."""

    primal: Array
    equations: Array
    rows: Array
    cost: Array


class Sides(NamedTuple):
    """The sides of all rows: `G x <= upper` and `-G x <= -lower`."""

    h: Array  # the bound, or 0 without a bound
    inequality: Array
    equality: Array
    soft: Array  # may be violated
    hinge: Array  # the violation has a linear weight
    v: Array
    W: Array

    @property
    def active(self) -> Array:
        """The sides that take part in the program."""
        return self.inequality | self.equality

    def scaled(self, scaling: Scaling) -> "Sides":
        """The sides of the scaled problem."""
        R, c = scaling.rows, scaling.cost
        return self._replace(h=R * self.h, v=c * self.v / R, W=c * self.W / R**2)


class AbstractForm(eqx.Module):
    """The arrays of a program, and the linear algebra that uses its structure.

    All methods act on a single vector, not on batches.
    """

    q: eqx.AbstractVar[Array]
    f: eqx.AbstractVar[Array]
    lower: eqx.AbstractVar[Array]
    upper: eqx.AbstractVar[Array]
    soft: eqx.AbstractVar[tuple[Array, Array] | None]
    """The weights `v` and `W` of both sides of each row; infinite for hard sides."""

    __repr__ = shown

    @abstractmethod
    def hessian(self, x: Array) -> Array:
        """`H x`."""

    @abstractmethod
    def rows(self, x: Array) -> Array:
        """`G x`."""

    @abstractmethod
    def rows_transposed(self, y: Array) -> Array:
        """`G'y`."""

    @abstractmethod
    def equations(self, x: Array) -> Array:
        """`F x`."""

    @abstractmethod
    def equations_transposed(self, p: Array) -> Array:
        """`F'p`."""

    @abstractmethod
    def factorise(self, weight: Array) -> Any:
        """The factors of the regularised `[[H + G'diag(weight)G, F'], [F, 0]]`."""

    @abstractmethod
    def solve(self, factors: Any, x: Array, p: Array) -> tuple[Array, Array]:
        """Solve the factorised system for one right side `(x, p)`."""

    @abstractmethod
    def equilibrated(self) -> tuple["AbstractForm", Scaling]:
        """The problem with rows and columns of similar size, and its scaling. Bounds
        and weights are not scaled here, but by `Sides.scaled`."""

    def meaningful(self, sides: Sides) -> Sides:
        """The sides that the method uses; by default all."""
        return sides

    def admissible(self, x: Array, p: Array) -> tuple[Array, Array]:
        """The vector with zeros in the entries that the form does not use."""
        return x, p

    def sides(self) -> Sides:
        """The sides of all rows."""
        bounds = jnp.stack([self.upper, -self.lower])
        finite = jnp.isfinite(bounds)
        equal = finite[0] & (self.lower == self.upper)
        if self.soft is not None:
            v, W = self.soft
            # A soft equation may be violated on both sides, so it is two inequalities.
            equal = equal & ~_are_soft(v, W)[0]
            # A bound has no effect if its violation costs nothing.
            finite = finite & ~((v == 0) & (W == 0))
        # An equation takes part once, as the upper side.
        equality = jnp.stack([equal, jnp.zeros_like(equal)])
        inequality = finite & ~equal
        h = jnp.where(inequality | equality, bounds, 0)
        if self.soft is None:
            none = jnp.zeros_like(finite)
            return Sides(h, inequality, equality, none, none, *(2 * (0 * h,)))
        v, W = self.soft
        soft = _are_soft(v, W) & inequality
        v, W = jnp.where(soft, v, 0), jnp.where(soft, W, 0)
        return Sides(h, inequality, equality, soft, soft & (v > 0), v, W)

    def cost(self, x: Array) -> Scalar:
        """The cost, with the violations of soft sides."""
        cost = jnp.sum(x * (self.hessian(x) / 2 + self.q))
        if self.soft is None:
            return cost
        sides = self.sides()
        t = jnp.where(sides.soft, jnp.maximum(both(self.rows(x)) - sides.h, 0), 0)
        return cost + jnp.sum(t * (sides.v + sides.W * t / 2))


def _are_soft(v: Array, W: Array) -> Array:
    return jnp.isfinite(v) & jnp.isfinite(W)


def both(row: Array) -> Array:
    """The values of the rows for the upper and the lower side."""
    return jnp.stack([row, -row])


def signed(z: Array) -> Array:
    """The multiplier of each row: upper minus lower."""
    return z[0] - z[1]
