"""What a step costs and what an arrival is worth."""

from collections.abc import Callable
from typing import Any

import jax.numpy as jnp
from jaxtyping import Array

from .._module import function_field, parameter
from .._typing import Control, RealScalar, Scalar, State
from ._base import AbstractCost


class Arrival(AbstractCost):
    """`step_cost + control_weight u'u` a step, and `arrival_cost` once, if the last
    state is a goal.

    The costs of most Gym tasks. It says nothing of the way to the goal: the gradient
    with respect to the state is 0 wherever there is one.

    **Arguments:**

    - `reached`: `(t, x) -> bool`, whether the state is a goal; usually the `terminated`
        of the environment. Never by default.
    - `step_cost`: 1 by default.
    - `control_weight`: 0 by default.
    - `arrival_cost`: 0 by default; a reward is negative.

    **Raises:** `ValueError` if a number is not finite.

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp

        cost = dlx.costs.Arrival(lambda t, x: x[0] > 1, arrival_cost=-100.0)
        cost.final(0.0, jnp.array([1.5, 0.0]))
        ```
    """

    reached: Callable[[RealScalar, Array], Array] | None = function_field()
    step_cost: Array = parameter()
    control_weight: Array = parameter()
    arrival_cost: Array = parameter()

    def __init__(
        self,
        reached: Callable[[RealScalar, Array], Array] | None = None,
        step_cost: Any = 1.0,
        control_weight: Any = 0.0,
        arrival_cost: Any = 0.0,
    ):
        self.reached = reached
        self.step_cost = step_cost
        self.control_weight = control_weight
        self.arrival_cost = arrival_cost

    def __call__(self, t: RealScalar, x: State, u: Control) -> Scalar:
        effort = self.control_weight * sum(part * part for part in tuple(u))
        return (self.step_cost + effort).astype(x.dtype)

    def final(self, t: RealScalar, x: State) -> Scalar:
        if self.reached is None:
            return super().final(t, x)
        return jnp.where(self.reached(t, x), self.arrival_cost, 0.0).astype(x.dtype)
