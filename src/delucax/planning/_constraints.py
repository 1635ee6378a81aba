"""Constraints of a plan, as the user gives them."""

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple, TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from .._check import as_float_array, is_concrete
from .._module import as_module, check_function, function_field, parameter, shown
from ..qp import Soft


class SoftConstraint(eqx.Module):
    r"""A constraint that may be violated, at a cost.

    If a value of the function violates the constraint by $v$, the cost increases by
    $\mathrm{linear}\; v + \tfrac12\, \mathrm{quadratic}\; v^2$.

    If the linear weight is larger than the multiplier that the constraint would have as
    a hard constraint, the penalty is exact. Then the solution satisfies the constraint
    if this is possible.

    **Arguments:**

    - `function`: a function as for [`delucax.planning.Constraints`][].
    - `linear`: the linear weight, at least 0: a number, or one number for each value of
        the function; 0 by default.
    - `quadratic`: the quadratic weight, at least 0: a number, or one number for each
        value of the function; 0 by default.

    **Raises:** `ValueError` if `function` is not a function, or a weight is negative or
    not finite.

    Source: Kerrigan and Maciejowski, 2000.

    !!! example

        ```python
        import delucax as dlx

        warm = lambda t, x, u: x[1] - 350.0
        limit = dlx.planning.SoftConstraint(warm, linear=10.0)
        constraints = dlx.planning.Constraints({"temperature": limit})
        ```
    """

    function: Callable[..., Any] = function_field()
    linear: Array = parameter(0.0)
    quadratic: Array = parameter(0.0)

    __repr__ = shown

    def __check_init__(self):
        check_function(self.function, "function", "SoftConstraint")
        for name in ("linear", "quadratic"):
            weight = as_float_array(getattr(self, name))
            if not is_concrete(weight):
                continue
            if not np.all(np.isfinite(weight) & (np.asarray(weight) >= 0)):
                raise ValueError(
                    f"SoftConstraint: {name} must be finite and at least 0, got "
                    f"{weight}."
                )

    def __call__(self, *args: Any) -> Any:
        return self.function(*args)


def _as_functions(value: Any) -> Any:
    """A function, or a dictionary of functions."""
    if isinstance(value, Mapping):
        # JAX sorts the keys of a dictionary in this order.
        names = sorted(value, key=str)
        return {str(name): as_module(value[name]) for name in names}
    return as_module(value)


def _as_limits(value: Any) -> Any:
    """Bounds as arrays."""
    if isinstance(value, tuple | list) and len(value) == 2:
        return tuple(as_float_array(end) for end in value)
    return value


_FUNCTIONS = "inequality", "equality", "final_inequality", "final_equality"


class Constraints(eqx.Module):
    """Constraints on the states and controls of a plan, at each step and at the end.

    The constraints of each step are `inequality(t, x, u) <= 0` and
    `equality(t, x, u) = 0`. The constraints at the end are
    `final_inequality(t, x) <= 0` and `final_equality(t, x) = 0`. You can add bounds on
    states and controls.

    Each function returns a number or a vector. To give several functions, use a
    dictionary. The keys of the dictionary name the functions in messages and in
    [`delucax.planning.Multipliers`][]. The constraints also apply at the first step,
    where the state is given. So a constraint that depends only on the state must
    already hold for the given first state.

    **Arguments:**

    - `inequality`: a function `(t, x, u)`, a [`delucax.planning.SoftConstraint`][], or
        a dictionary of functions and soft constraints; none by default.
    - `equality`: a constraint or a dictionary, as for `inequality`; none by default.
    - `final_inequality`: a constraint or a dictionary, as for `inequality`, with
        functions `(t, x)`; none by default.
    - `final_equality`: a constraint or a dictionary, as for `inequality`, with
        functions `(t, x)`; none by default.
    - `states`: bounds `(low, high)` of the states, each a number or an array of shape
        `(n,)` or `(T+1, n)`; or a [`delucax.qp.Soft`][] with such bounds. The first row
        of the bounds is ignored, because the first state is given. None by default.
    - `controls`: bounds of the controls, given like `states`, of shape `(m,)` or
        `(T, m)`. If the bounds of the controls are constant in time, use the argument
        `bounds` of the planner, because this is cheaper. If you also pass `bounds` to
        the planner, the controls must satisfy the bounds in both arguments. None by
        default.

    Only the planner [`delucax.planning.SQP`][] accepts soft constraints and the
    arguments `states` and `controls`.

    To differentiate with respect to a number in a constraint, write the constraint as a
    module with this number as a [`delucax.parameter`][].

    **Raises:** `ValueError` if a constraint is not a function, bounds are not a pair of
    numbers with `low <= high`, an inequality and an equality have the same name, or no
    constraint is given.

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

    inequality: Any = eqx.field(default=None, converter=_as_functions)
    equality: Any = eqx.field(default=None, converter=_as_functions)
    final_inequality: Any = eqx.field(default=None, converter=_as_functions)
    final_equality: Any = eqx.field(default=None, converter=_as_functions)
    states: Any = eqx.field(default=None, converter=_as_limits)
    controls: Any = eqx.field(default=None, converter=_as_limits)

    __repr__ = shown

    def __check_init__(self):
        where = "Constraints"
        if all(value is None for value in vars(self).values()):
            raise ValueError("Constraints: at least one constraint must be given.")
        for field in _FUNCTIONS:
            for name, function in self.named(field).items():
                is_soft = isinstance(function, SoftConstraint)
                inner = function.function if is_soft else function
                of = "t, x" if field.startswith("final") else "t, x, u"
                check_function(inner, name, where, of)
        for start in ("", "final_"):
            pair = (self.named(f"{start}{kind}") for kind in ("inequality", "equality"))
            if twice := set.intersection(*map(set, pair)):
                raise ValueError(
                    f"{where}: {start}inequality and {start}equality must have "
                    f"different names, got {sorted(twice)} in both."
                )
        for field in ("states", "controls"):
            value = getattr(self, field)
            if value is None or isinstance(value, Soft):
                continue
            if not isinstance(value, tuple):
                raise ValueError(
                    f"{where}: {field} must be a pair (low, high) or a "
                    f"`delucax.qp.Soft`, got {type(value).__name__}."
                )
            if not all(map(is_concrete, value)):
                continue
            low, high = map(np.asarray, value)
            if low.dtype.kind not in "iuf" or high.dtype.kind not in "iuf":
                raise ValueError(f"{where}: {field} must be numbers, got {value}.")
            if not np.all(low <= high):
                raise ValueError(
                    f"{where}: {field} must have low <= high, got {low} and {high}."
                )

    def named(self, field: str) -> dict[str, Callable[..., Any]]:
        """The functions of one field, by their names.

        **Arguments:** `field`: the name of the field, such as `"inequality"`.
        """
        value = getattr(self, field)
        if value is None:
            return {}
        return value if isinstance(value, dict) else {field: value}

    @property
    def is_hard(self) -> bool:
        """Whether all constraints are hard and given by functions."""
        functions = [f for field in _FUNCTIONS for f in self.named(field).values()]
        soft = any(isinstance(f, SoftConstraint) for f in functions)
        return not soft and self.states is None and self.controls is None


Values: TypeAlias = tuple[Float[Array, "*steps p"], Bool[Array, "*steps p"]]
"""The values of constraints, inequalities first, and which of them are equalities."""


class Row(NamedTuple):
    """One constraint: the name, the number of values and the kind of a function."""

    name: str
    size: int
    is_equality: bool
    weights: tuple[Any, Any] | None  # `None` for a hard constraint


def values_of(
    constraints: Constraints, final: bool, arguments: tuple, dtype: Any
) -> Values:
    """The values of all constraints of a step, or of the end, in one vector."""
    parts, equal = [jnp.zeros(0, dtype)], [np.zeros(0, bool)]
    for _, function, is_equality in _each(constraints, final):
        c = jnp.ravel(jnp.asarray(function(*arguments), dtype))
        parts.append(c)
        equal.append(np.full(c.size, is_equality))
    return jnp.concatenate(parts), jnp.asarray(np.concatenate(equal))


def rows_of(constraints: Constraints, final: bool, arguments: tuple) -> list[Row]:
    """Describe the values that `values_of` returns, in their order."""
    rows = []
    for name, function, equal in _each(constraints, final):
        try:
            like = eqx.filter_eval_shape(lambda *a, f=function: f(*a), *arguments)
        except TypeError as error:
            given = "(t, x)" if final else "(t, x, u)"
            raise ValueError(
                f"Constraints: {name} fails when it is called with {given}: {error}"
            ) from error
        leaves = jax.tree.leaves(like)
        dtype = getattr(leaves[0], "dtype", None) if len(leaves) == 1 else None
        is_real = dtype is not None and np.dtype(dtype).kind in "fiu"
        is_number = len(leaves) == 1 and type(leaves[0]) in (int, float)
        if not is_number and (not is_real or len(leaves[0].shape) > 1):
            raise ValueError(
                f"Constraints: {name} must return a number or a vector, got {like}."
            )
        soft = isinstance(function, SoftConstraint)
        weights = (function.linear, function.quadratic) if soft else None
        size = int(np.prod(np.shape(leaves[0])))
        for weight in weights or ():
            if np.shape(weight) not in ((), (size,)):
                raise ValueError(
                    f"SoftConstraint: the weights of {name} must be numbers or have "
                    f"shape ({size},), got shape {np.shape(weight)}."
                )
        rows.append(Row(name, size, equal, weights))
    return rows


def _each(constraints: Constraints, final: bool):
    """Yield the name of each function, the function, and whether it is an equality."""
    start = "final_" if final else ""
    for kind in ("inequality", "equality"):
        for name, function in constraints.named(start + kind).items():
            yield name, function, kind == "equality"


_LISTED = 4
"""How many violated constraints a message lists."""


class Violation(NamedTuple):
    """The largest violation of one constraint, and where it is."""

    size: float
    name: str
    place: str


def violations_of(
    constraints: Constraints, problem: Any, states: Any, controls: Any
) -> str:
    """A sentence for messages: the violated constraints, by how much, and where."""
    T, violated = len(controls), []
    times = problem.times(T)
    stage = jax.vmap(lambda t, x, u: problem.stage_constraints(t, x, u)[0])
    each = stage(times[:-1], states[:-1], controls)
    last = problem.final_constraints(times[-1], states[-1])[0][None]
    args = times[0], states[0], controls[0]
    for final, values in ((False, each), (True, last)):
        start = 0
        for row in rows_of(constraints, final, args[:2] if final else args):
            c = np.asarray(values[:, start : start + row.size])
            start += row.size
            if row.weights is None and row.size:
                over = np.abs(c) if row.is_equality else np.maximum(c, 0)
                name = f"constraint `{row.name}`"
                names = [f"{name} (entry {i})" for i in range(row.size)]
                names = names if row.size > 1 else [name]
                violated.append(_largest(over, names, None if final else 0))
    for kind, value, planned, first in (
        ("state", constraints.states, states, 1),  # the first state is given
        ("control", constraints.controls, controls, 0),
    ):
        if value is None or isinstance(value, Soft):
            continue
        low, high = (e[first:] if e.ndim == 2 else e for e in map(np.asarray, value))
        planned, known = planned[first:], getattr(problem.dynamics, f"{kind}_names")
        for side, over in (("lower", low - planned), ("upper", planned - high)):
            over = np.maximum(over, 0)
            for i, n in enumerate(known):
                name = f"{side} bound of {kind} {i} ({n})"
                violated.append(_largest(over[:, i : i + 1], [name], first))
    # A constraint that is violated only by rounding is not to blame.
    least = np.finfo(states.dtype).eps ** 0.5
    violated = sorted((v for v in violated if v.size > least), key=lambda v: -v.size)
    if not violated:
        return ""
    if len(violated) == 1:
        size, name, place = violated[0]
        return f"The {name} is violated by {size:.2g} {place}."
    listed = [f"the {v.name} by {v.size:.2g} {v.place}" for v in violated[:_LISTED]]
    if more := len(violated) - len(listed):
        listed.append(f"and {more} more")
    return (
        f"{len(violated)} constraints are violated: {', '.join(listed)}. Any of them "
        "can be the one that cannot hold."
    )


def _largest(over: Any, names: list[str], first: int | None) -> Violation:
    """The largest entry of the violations of a constraint, one row for each stage from
    `first` on, or of a constraint at the end if that is None."""
    over = np.nan_to_num(np.asarray(over), nan=np.inf)
    k, i = (int(j) for j in np.unravel_index(over.argmax(), over.shape))
    place = "at the end" if first is None else f"at stage {k + first}"
    return Violation(float(over[k, i]), names[i], place)
