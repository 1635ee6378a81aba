"""What the interior-point method asks of a quadratic program.

Minimise `1/2 x'H x + q'x` over `F x = f` and `lower <= G x <= upper`. Each row has two
sides, the upper and the lower one, in this order on an axis in front. A side without a
finite bound takes no part. Where both bounds of a row are equal, its upper side is an
equation. A soft side may be violated by `t >= 0` at the cost `v t + 1/2 W t^2`.
"""

from abc import abstractmethod
from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp

from .._module import shown
from .._typing import Array, Scalar


class Scaling(NamedTuple):
    """The scaled problem has the unknowns `x / primal`, its equations are multiplied by
    `equations`, its rows by `rows`, and its cost by `cost`; all are powers of two."""

    primal: Array
    equations: Array
    rows: Array
    cost: Array


class Sides(NamedTuple):
    """The sides of all rows: `G x <= upper` and `-G x <= -lower`."""

    h: Array  # the bound; 0 where there is none
    inequality: Array
    equality: Array
    soft: Array  # may be violated
    hinge: Array  # the violation has a linear weight
    v: Array
    W: Array

    @property
    def active(self) -> Array:
        """The sides that take part."""
        return self.inequality | self.equality

    def scaled(self, scaling: Scaling) -> "Sides":
        """The sides of the scaled problem."""
        R, c = scaling.rows, scaling.cost
        return self._replace(h=R * self.h, v=c * self.v / R, W=c * self.W / R**2)


class AbstractForm(eqx.Module):
    """The arrays of a program, and what is linear algebra of its own structure.

    All methods take one vector.
    """

    q: eqx.AbstractVar[Array]
    f: eqx.AbstractVar[Array]
    lower: eqx.AbstractVar[Array]
    upper: eqx.AbstractVar[Array]
    soft: eqx.AbstractVar[tuple[Array, Array] | None]
    """The weights `v` and `W` of both sides of each row; infinite where a side is hard.
    """

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
        """The factors of `[[H + G'diag(weight)G, F'], [F, 0]]`, regularised."""

    @abstractmethod
    def solve(self, factors: Any, x: Array, p: Array) -> tuple[Array, Array]:
        """The solution for one right side."""

    @abstractmethod
    def equilibrated(self) -> tuple["AbstractForm", Scaling]:
        """The same problem with rows and columns of similar size, but for its bounds
        and weights, which are those of `Sides.scaled`."""

    def meaningful(self, sides: Sides) -> Sides:
        """The sides that the method takes, of all."""
        return sides

    def admissible(self, x: Array, p: Array) -> tuple[Array, Array]:
        """A vector without the entries that stand for nothing."""
        return x, p

    def sides(self) -> Sides:
        """The sides of all rows."""
        bounds = jnp.stack([self.upper, -self.lower])
        finite = jnp.isfinite(bounds)
        equal = finite[0] & (self.lower == self.upper)
        if self.soft is not None:
            # A soft equation may be violated on either side, each with its price.
            equal = equal & ~_are_soft(*self.soft)[0]
        # An equation stands once, at the upper side.
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
        """The cost, soft sides included."""
        cost = jnp.sum(x * (self.hessian(x) / 2 + self.q))
        if self.soft is None:
            return cost
        sides = self.sides()
        t = jnp.where(sides.soft, jnp.maximum(both(self.rows(x)) - sides.h, 0), 0)
        return cost + jnp.sum(t * (sides.v + sides.W * t / 2))


def _are_soft(v: Array, W: Array) -> Array:
    return jnp.isfinite(v) & jnp.isfinite(W)


def both(row: Array) -> Array:
    """The rows as the two sides see them."""
    return jnp.stack([row, -row])


def signed(z: Array) -> Array:
    """The sum over both sides of what acts on a row."""
    return z[0] - z[1]
