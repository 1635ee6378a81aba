"""Lagrange multipliers, by the names of their constraints."""

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
    r"""The Lagrange multipliers of a plan under constraints.

    A multiplier $y$ is a derivative of the optimal cost: if the constraint
    $c(t, x, u) \le 0$ is tightened to $c(t, x, u) + e \le 0$, the cost rises by $y\, e$
    to first order. The same holds for equalities. Multipliers of inequalities and
    bounds are at least 0, and they are 0 if the constraint is inactive.

    If a planner starts from an earlier plan, it also starts from the multipliers of
    that plan.

    **Attributes:**

    - `stage`: the multipliers of the constraints `inequality` and `equality`, in a
        dictionary whose keys are the names of the constraints. If a constraint has `p`
        values, its multipliers have the shape `(T, p)`.
    - `final`: the multipliers of the constraints `final_inequality` and
        `final_equality`, in a dictionary like `stage`, each of shape `(p,)`.
    - `states`: the multipliers of the bounds of states, a pair `(lower, upper)` of
        arrays of shape `(T+1, n)`; `None` without such bounds.
    - `controls`: the multipliers of the bounds of controls, a pair `(lower, upper)` of
        arrays of shape `(T, m)`; `None` without bounds, and always `None` for
        [`delucax.planning.ILQR`][]. If the controls have both hard bounds and soft
        bounds, these are the multipliers of the hard bounds.
    - `costates`: the multipliers of the dynamics, shape `(T+1, n)`. Row `k` is the
        negative derivative with respect to $x_k$ of the cost from stage `k` to the end,
        as in [`delucax.qp.StagedMultipliers`][]. `None` for `ILQR`. If the plan has
        [`delucax.planning.Unknowns`][], `costates` and `states` have one more column
        for each unknown, in scaled units.
    - `penalty`: the last penalty weight of `ILQR`; `None` for
        [`delucax.planning.SQP`][].

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
    """Split `y` along its last axis, by the names of the constraints."""
    named, start = {}, 0
    for row in [] if constraints is None else rows_of(constraints, final, arguments):
        named[row.name] = y[..., start : start + row.size]
        start += row.size
    return named


def in_order(
    constraints: Constraints | None, final: bool, arguments: tuple, given: Any, y: Array
) -> Array:
    """The multipliers `given` by name, as one array like `y`. The entries of a
    constraint are zero if it is not given or has another shape."""
    parts = [jnp.zeros_like(y[..., :0])]
    for name, part in by_name(constraints, final, arguments, y).items():
        value = given.get(name, part)
        parts.append(value if value.shape == part.shape else jnp.zeros_like(part))
    return jnp.concatenate(parts, axis=-1)


def zeros_like_result(function: Callable[..., Multipliers], *args: Any) -> Multipliers:
    """Zeros in the shapes of `function(*args)`, which is not computed."""
    like = eqx.filter_eval_shape(function, *args)
    return jax.tree.map(lambda a: np.zeros(a.shape, a.dtype), like)
