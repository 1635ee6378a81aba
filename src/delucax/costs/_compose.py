"""Costs made of functions and of other costs."""

from collections.abc import Callable
from typing import Any

import jax.numpy as jnp
from jaxtyping import Array

from .._check import check_step
from .._fields import function_field, parameter
from .._typing import RealScalar
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

    def __call__(self, t, x, u):
        return self.stage(t, x, u)

    def final(self, t, x):
        if self.final_cost is None:
            return jnp.zeros((), x.dtype)
        return self.final_cost(t, x)


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

    def __init__(self, cost: AbstractCost, dt: Any):
        if not isinstance(cost, AbstractCost):
            raise ValueError(
                f"Rate: cost must be an AbstractCost, got {type(cost).__name__}."
            )
        check_step(dt, "Rate")
        self.cost = cost
        self.dt = dt

    def __call__(self, t, x, u):
        return self.cost(t, x, u) * self.dt

    def final(self, t, x):
        return self.cost.final(t, x)
