"""What a planner chooses besides the controls: first state, parameters, duration."""

import dataclasses
from collections.abc import Mapping
from typing import Any

import equinox as eqx
import numpy as np
from jaxtyping import Array

from .._check import as_float_array, is_concrete, number_at
from .._message import did_you_mean, shortened
from .._module import shown, with_values
from ..dynamics import AbstractDiscretization, AbstractDynamics
from ._plan import Plan
from ._problem import Problem


Bounds = tuple[Array, Array]


def _as_bounds(value: Any) -> Any:
    """Bounds as arrays."""
    if isinstance(value, Mapping):
        return {str(name): _as_bounds(pair) for name, pair in value.items()}
    if isinstance(value, tuple | list) and len(value) == 2:
        return tuple(as_float_array(end) for end in value)
    return value


class Unknowns(eqx.Module):
    """What a planner chooses besides the controls: first state, parameters, duration.

    [`delucax.planning.SQP`][] chooses the unknowns together with the controls. Each
    unknown has bounds `(low, high)`, which may be infinite. The iteration starts from
    the value that an unknown has in the arguments of the planner, clipped to the
    bounds.

    **Arguments:**

    - `start`: bounds of the first state: a dictionary from names of states to pairs
        `(low, high)` of numbers. `x0` gives the other states. None by default.
    - `parameters`: bounds of parameters: a dictionary from the path of a parameter to a
        pair `(low, high)`. Each bound is a number or has the shape of the parameter. A
        path starts with `dynamics`, `cost` or `constraints`. An example is
        `{"dynamics.system.length": (0.5, 2.0)}`. None by default.
    - `duration`: bounds `(low, high)` of the time from the first state to the last one,
        two positive numbers. All steps have the same length. The dynamics must
        discretise a system in continuous time, such as [`delucax.Discretized`][]. Costs
        and constraints are evaluated at the times that follow from the chosen duration.
        So a plan with the final cost `t` minimises the duration. The planner does not
        multiply the stage cost by the length of a step. By default the duration is not
        an unknown.

    **Raises:** `ValueError` if no unknown is given, bounds are not a pair of numbers
    with `low <= high`, or the bounds allow a duration of zero or less. A call of the
    planner raises a `ValueError` if a name does not exist or a parameter has no finite
    value to start from.

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp

        cart = dlx.systems.LinearSystem([[0.0, 1.0], [0.0, 0.0]], [[0.0], [1.0]])
        plan = dlx.planning.SQP()(
            dlx.Discretized(cart, dt=0.1),
            dlx.costs.Function(lambda t, x, u: 0.0, lambda t, x: t),  # least time
            jnp.array([-1.0, 0.0]),
            jnp.zeros((20, 1)),
            bounds=(-1.0, 1.0),
            constraints=dlx.planning.Constraints(final_equality=lambda t, x: x),
            unknowns=dlx.planning.Unknowns(duration=(0.5, 10.0)),
        )
        plan.duration  # 2, by full acceleration, then full deceleration
        ```
    """

    start: dict[str, Bounds] = eqx.field(default_factory=dict, converter=_as_bounds)
    parameters: dict[str, Bounds] = eqx.field(
        default_factory=dict, converter=_as_bounds
    )
    duration: Bounds | None = eqx.field(default=None, converter=_as_bounds)

    __repr__ = shown

    def __check_init__(self):
        where = "Unknowns"
        for field in ("start", "parameters"):
            value = getattr(self, field)
            if not isinstance(value, dict):
                raise ValueError(
                    f"{where}: {field} must be a dictionary from names to pairs "
                    f"(low, high), got {shortened(value)}."
                )
            for name, pair in value.items():
                _check_pair(pair, f"{field}[{name!r}]", where)
        if self.duration is not None:
            low, high = _check_pair(self.duration, "duration", where)
            if np.shape(low) or np.shape(high):
                raise ValueError(
                    f"{where}: duration must be two numbers (low, high), got "
                    f"{self.duration}."
                )
            _check_runs(low, "duration", where)
        if self.duration is None and not self.start and not self.parameters:
            raise ValueError(f"{where}: at least one unknown must be given.")


def _check_runs(low: Any, name: str, where: str) -> None:
    """Raise unless the lower bound of a time is positive."""
    if is_concrete(low) and not np.all(np.asarray(low) > 0):
        raise ValueError(
            f"{where}: {name} must have positive bounds, because time does not run "
            f"backwards, got a lower bound of {shortened(low)}."
        )


def _check_pair(pair: Any, name: str, where: str) -> Bounds:
    """Return the pair. Raise unless it is a pair of numbers with `low <= high`."""
    if not isinstance(pair, tuple):
        raise ValueError(
            f"{where}: {name} must be a pair (low, high), a tuple or a list, got "
            f"{shortened(pair)}."
        )
    if all(map(is_concrete, pair)):
        low, high = map(np.asarray, pair)
        if low.dtype.kind not in "iuf" or high.dtype.kind not in "iuf":
            raise ValueError(f"{where}: {name} must be numbers, got {pair}.")
        if not np.all(low <= high):
            raise ValueError(
                f"{where}: {name} must have low <= high, got {low} and {high}."
            )
    return pair


def check_unknowns(problem: Problem, horizon: int) -> None:
    """Raise unless the names of the unknowns exist and have values to start from."""
    if problem.unknowns is None:
        return
    where, names = "SQP", problem.dynamics.state_names
    for name, pair in problem.unknowns.start.items():
        if name not in names:
            raise ValueError(
                f"{where}: start of unknowns names the state {name!r}; "
                f"{did_you_mean(name, names)}"
            )
        if any(np.shape(end) for end in pair):
            raise ValueError(
                f"{where}: the bounds of the state {name!r} must be numbers, got shape "
                f"{max(map(np.shape, pair))}."
            )
    parts, step = parts_of(problem), _path_of_step(problem.dynamics, throw=False)
    for path, pair in bounds_by_path(problem, horizon).items():
        if path.split(".")[0] not in _PARTS:
            raise ValueError(
                f"{where}: a path of unknowns must start with dynamics, cost or "
                f"constraints, got {path!r}."
            )
        if path == step:
            _check_runs(pair[0], path, where)
        value = number_at(parts, path, "parameters of unknowns", "problem", where)
        for end in pair:
            if np.shape(end) not in ((), value.shape):
                raise ValueError(
                    f"{where}: the bounds of {path!r} must be numbers or have shape "
                    f"{value.shape}, got shape {np.shape(end)}."
                )


def parts_of(problem: Problem) -> dict[str, Any]:
    """The parts of the problem, by the first words of the paths of parameters."""
    return {name: getattr(problem, name) for name in _PARTS}


_PARTS = "dynamics", "cost", "constraints"


def bounds_by_path(problem: Problem, horizon: int) -> dict[str, Bounds]:
    """The bounds of the parameters, and of the step if the duration is unknown, by
    paths."""
    unknowns = problem.unknowns
    named = dict(unknowns.parameters)
    if unknowns.duration is not None:
        path = _path_of_step(problem.dynamics)
        if path in named:
            raise ValueError(
                f"SQP: unknowns must have the parameter {path!r} or a duration, got "
                "both."
            )
        named[path] = tuple(end / horizon for end in unknowns.duration)
    return named


def _path_of_step(dynamics: AbstractDynamics, throw: bool = True) -> str:
    """The path of the step `dt` of a discretised system, through its wrappers."""
    path = "dynamics"
    inside: Any = dynamics
    while not isinstance(inside, AbstractDiscretization) and hasattr(
        inside, "dynamics"
    ):
        path, inside = f"{path}.dynamics", inside.dynamics
    if throw and not isinstance(inside, AbstractDiscretization):
        raise ValueError(
            "SQP: with an unknown duration, dynamics must discretise a system in "
            f"continuous time, as `delucax.Discretized` does, got "
            f"{type(inside).__name__}."
        )
    return f"{path}.dt"


def solved_problem(problem: Problem, plan: Plan) -> Problem:
    """The problem with the values that a plan found."""
    parts = with_values(parts_of(problem), plan.parameters or {})
    return dataclasses.replace(problem, **parts)
