"""Costs made of functions and of other costs."""

import functools
import operator
from collections.abc import Callable

from jaxtyping import Array

from .._check import check_instance, check_number, check_step
from .._module import function_field, parameter
from .._typing import Control, RealScalar, State
from ._base import AbstractCost


class Function(AbstractCost):
    """A cost from functions.

    **Arguments:**

    - `stage`: `(t, x, u) -> scalar`.
    - `final_cost`: `(t, x) -> scalar`; zero by default.

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp

        cost = dlx.costs.Function(lambda t, x, u: jnp.sum(x**2) + jnp.sum(u**2))
        cost(0.0, jnp.ones(2), jnp.zeros(1))
        ```
    """

    stage: Callable[[RealScalar, Array, Array], Array] = function_field()
    final_cost: Callable[[RealScalar, Array], Array] | None = function_field(None)

    def __call__(self, t: RealScalar, x: State, u: Control) -> Array:
        return self.stage(t, x, u)

    def final(self, t: RealScalar, x: State) -> Array:
        if self.final_cost is None:
            return super().final(t, x)
        return self.final_cost(t, x)


class Sum(AbstractCost):
    """The sum of several costs, `c_1(t, x, u) + ... + c_n(t, x, u)`, and of their final
    costs. `cost + other` makes it.

    **Arguments:** `*terms`: the costs, at least one.

    **Raises:** `ValueError` if there are none, or if one is no cost.

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp

        effort = dlx.costs.Function(lambda t, x, u: jnp.sum(jnp.abs(u)))
        cost = dlx.costs.Quadratic(jnp.eye(2), jnp.eye(1)) + 0.1 * effort
        cost(0.0, jnp.ones(2), jnp.ones(1))
        ```
    """

    terms: tuple[AbstractCost, ...]

    def __init__(self, *terms: AbstractCost):
        self.terms = terms

    def __check_init__(self):
        if not self.terms:
            raise ValueError("Sum: at least one cost must be given.")
        for term in self.terms:
            check_instance(term, AbstractCost, "every term", "Sum")

    def __call__(self, t: RealScalar, x: State, u: Control) -> Array:
        return functools.reduce(operator.add, (c(t, x, u) for c in self.terms))

    def final(self, t: RealScalar, x: State) -> Array:
        return functools.reduce(operator.add, (c.final(t, x) for c in self.terms))


class Scaled(AbstractCost):
    """A cost times a number, `factor c(t, x, u)`, and so its final cost.
    `factor * cost` makes it.

    **Arguments:**

    - `cost`: the cost.
    - `factor`: a number; it can be differentiated.

    **Raises:** `ValueError` if `cost` is not one, or `factor` is not a finite number.

    !!! example

        ```python
        import delucax as dlx

        doubled = 2 * dlx.costs.PendulumCost()
        ```
    """

    cost: AbstractCost
    factor: Array = parameter()

    def __check_init__(self):
        check_instance(self.cost, AbstractCost, "cost", "Scaled")
        check_number(self.factor, "factor", "Scaled")

    def __call__(self, t: RealScalar, x: State, u: Control) -> Array:
        return self.factor * self.cost(t, x, u)

    def final(self, t: RealScalar, x: State) -> Array:
        return self.factor * self.cost.final(t, x)


class Rate(AbstractCost):
    """A cost a second, charged for a step of `dt`: `c(t, x, u) dt`.

    The problem then stays the same when `dt` changes. The final cost is unchanged.

    **Arguments:**

    - `cost`: the cost a second.
    - `dt`: the step.

    **Raises:** `ValueError` if `dt` is not positive.

    !!! example

        ```python
        import delucax as dlx

        cost = dlx.costs.Rate(dlx.costs.PendulumCost(), dt=0.05)
        ```
    """

    cost: AbstractCost
    dt: Array = parameter()

    def __check_init__(self):
        check_instance(self.cost, AbstractCost, "cost", "Rate")
        check_step(self.dt, "Rate")

    def __call__(self, t: RealScalar, x: State, u: Control) -> Array:
        return self.cost(t, x, u) * self.dt

    def final(self, t: RealScalar, x: State) -> Array:
        return self.cost.final(t, x)
