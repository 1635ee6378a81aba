"""Lagrange multipliers by the names of their constraints."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from .._module import shown
from ._constraints import Constraints, rows_of


class Multipliers(eqx.Module):
    """The Lagrange multipliers of a plan under constraints: the derivative of the
    optimal cost with respect to what each constraint is tightened by.

    Those of inequalities and bounds are at least 0, and 0 where there is slack. An
    earlier plan as the start of a planner gives its multipliers too.

    **Attributes:**

    - `stage`: of the constraints `inequality` and `equality` by their names, each of
        shape `(T, p)`.
    - `final`: of `final_inequality` and `final_equality` by their names, each `(p,)`.
    - `states`: of bounds, a pair `(lower, upper)` of shape `(T+1, n)`; `None` without.
    - `controls`: likewise, of shape `(T, m)`. [`delucax.planning.ILQR`][] has none.
    - `costates`: of `x_0` as given and of `x_{k+1} = F(t_k, x_k, u_k)`, shape
        `(T+1, n)`: minus the derivative of the cost from stage `k` on with respect to
        `x_k`, as in [`delucax.qp.StagedMultipliers`][]. `ILQR` has none.
    - `penalty`: the last weight of violated constraints of `ILQR`; `SQP` has none.

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp

        dynamics = dlx.Discretized(dlx.systems.Pendulum(), dt=0.1)
        cost = dlx.costs.Quadratic([1.0, 0.1], [0.1], final=[20.0, 2.0])
        slow = lambda t, x, u: -x[1] - 1.2
        plan = dlx.planning.SQP()(
            dynamics,
            cost,
            jnp.array([1.0, 0.0]),
            20,
            constraints=dlx.planning.Constraints({"speed": slow}),
        )
        plan.multipliers.stage["speed"].max()
        ```
    """

    stage: dict[str, Array]
    final: dict[str, Array]
    states: tuple[Array, Array] | None = None
    controls: tuple[Array, Array] | None = None
    costates: Array | None = None
    penalty: Array | None = None

    __repr__ = shown


def by_name(
    constraints: Constraints | None, final: bool, arguments: tuple, y: Array
) -> dict[str, Array]:
    """The entries of `y` along its last axis, by the names of their constraints."""
    named, start = {}, 0
    for row in [] if constraints is None else rows_of(constraints, final, arguments):
        named[row.name] = y[..., start : start + row.size]
        start += row.size
    return named


def in_order(
    constraints: Constraints | None, final: bool, arguments: tuple, given: Any, y: Array
) -> Array:
    """The multipliers `given` by name, where they have the shape of the entries of `y`,
    which is zero, and zero for the others."""
    parts = [jnp.zeros_like(y[..., :0])]
    for name, part in by_name(constraints, final, arguments, y).items():
        value = given.get(name, part)
        parts.append(value if value.shape == part.shape else jnp.zeros_like(part))
    return jnp.concatenate(parts, axis=-1)


def zeros_like_result(function: Callable[..., Multipliers], *args: Any) -> Multipliers:
    """Zeros of the shapes that `function(*args)` returns, which is not computed."""
    like = eqx.filter_eval_shape(function, *args)
    return jax.tree.map(lambda a: np.zeros(a.shape, a.dtype), like)
