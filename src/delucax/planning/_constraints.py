"""Constraints on states and controls, and what they add to the cost."""

from collections.abc import Callable
from typing import Any, NamedTuple, TypeAlias

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from .._module import check_parameters, function_field


class Constraints(eqx.Module):
    """What must hold along a plan: `inequality(t, x, u) <= 0` and
    `equality(t, x, u) = 0` at each step, `final_inequality(t, x) <= 0` and
    `final_equality(t, x) = 0` at the end.

    Each returns a number or a vector. The constraints of a step hold at the first one
    too, where the state is given: one on the state alone must hold there anyway. Bounds
    on the controls alone are cheaper as `bounds` of the planner.

    **Arguments:**

    - `inequality`: a function of time, state and control; none by default.
    - `equality`: likewise; none by default.
    - `final_inequality`: a function of time and the last state; none by default.
    - `final_equality`: likewise; none by default.

    A function that is a module with [`delucax.parameter`][] fields can be
    differentiated with respect to them.

    **Raises:** `ValueError` if one is no function, or if there is none.

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp

        slow = lambda t, x, u: jnp.abs(x[1]) - 3.0
        upright = lambda t, x: x
        constraints = dlx.planning.Constraints(slow, final_equality=upright)
        dynamics = dlx.Discretized(dlx.systems.Pendulum(), dt=0.1)
        cost = dlx.costs.Quadratic([0.0, 0.0], [1.0])
        plan = dlx.planning.ilqr(
            dynamics,
            cost,
            jnp.array([1.0, 0.0]),
            jnp.zeros((20, 1)),
            constraints=constraints,
        )
        plan.states[-1], plan.violation
        ```
    """

    inequality: Callable[[Array, Array, Array], Any] | None = function_field(None)
    equality: Callable[[Array, Array, Array], Any] | None = function_field(None)
    final_inequality: Callable[[Array, Array], Any] | None = function_field(None)
    final_equality: Callable[[Array, Array], Any] | None = function_field(None)

    def __check_init__(self):
        check_parameters(self)
        if all(function is None for function in vars(self).values()):
            raise ValueError("Constraints: at least one function must be given.")


Values: TypeAlias = tuple[Float[Array, "*steps p"], Bool[Array, "*steps p"]]
"""The values of constraints, inequalities first, and which are of equalities."""


class Multipliers(NamedTuple):
    """Of the constraints: at each step, at the end, and the weight of the squares."""

    stage: Array  # (T, p)
    final: Array  # (q,)
    rho: Array


def values_of(functions: tuple[Any, Any], arguments: tuple, dtype: Any) -> Values:
    """Of an inequality and an equality, either of which may be none."""
    given = (jnp.zeros(0) if f is None else f(*arguments) for f in functions)
    inequality, equality = (jnp.ravel(jnp.asarray(c, dtype)) for c in given)
    c = jnp.concatenate([inequality, equality])
    return c, jnp.arange(c.size) >= inequality.size


def augmented(c: Array, y: Array, rho: Array, equal: Array) -> Array:
    """What constraints with values `c` and multipliers `y` add to the cost:
    `y c + rho c^2 / 2`, or `(max(0, y + rho c)^2 - y^2) / (2 rho)` of an inequality.

    Source: Hestenes, 1969; Powell, 1969; Rockafellar, 1973 (inequalities).
    """
    # The two agree where an inequality is active, and so do their first derivatives at
    # the switch; the second one jumps there. A weight of zero leaves the Lagrangian.
    active = equal | (y + rho * c > 0)
    safe = jnp.where(rho > 0, rho, 1)
    return jnp.sum(jnp.where(active, c * (y + rho * c / 2), -(y**2) / (2 * safe)))


def updated(c: Array, y: Array, rho: Array, equal: Array) -> Array:
    """The multipliers after a minimisation."""
    return jnp.where(equal, y + rho * c, jnp.maximum(y + rho * c, 0))


def violated(c: Array, y: Array, rho: Array, equal: Array) -> Array:
    """How far each constraint is from holding, or its multiplier from being needed."""
    # max(c, -y / rho) is zero just where c <= 0, y >= 0 and y c = 0: both feasibility
    # and complementarity, in the unit of the constraint.
    slack = jnp.maximum(c, -y / rho)
    return jnp.where(equal, jnp.abs(c), jnp.abs(slack))
