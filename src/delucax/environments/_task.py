"""The arguments of a task, sorted by who takes them."""

import difflib
import inspect
from collections.abc import Callable, Mapping
from typing import Any, TypeVar

import diffrax

from .._check import check_instance, check_step
from ..dynamics import AbstractDynamics, Discretized
from ..systems import AbstractSystem
from ._environment import Environment


_System = TypeVar("_System", bound=AbstractSystem)

# What changes which observations there are, and so the bounds of a task's features.
_CHANGES_OBSERVATIONS = {
    "disturbance",
    "dynamics",
    "encode",
    "initial_state",
    "sensor_noise",
    "terminated",
}


def _parameters(function: Callable[..., Any]) -> list[str]:
    """The names that `function` takes as keywords."""
    parameters = inspect.signature(function).parameters.values()
    keyword = inspect.Parameter.POSITIONAL_OR_KEYWORD, inspect.Parameter.KEYWORD_ONLY
    return [p.name for p in parameters if p.kind in keyword]


def _split(
    arguments: Mapping[str, Any], function: Callable[..., Any]
) -> tuple[dict[str, Any], dict[str, Any]]:
    """Those of `arguments` that `function` takes, and the rest."""
    names = _parameters(function)
    taken = {name: value for name, value in arguments.items() if name in names}
    return taken, {n: value for n, value in arguments.items() if n not in taken}


def check_names(
    task: Callable[..., Environment],
    others: Mapping[str, Any],
    *takers: Callable[..., Any],
) -> None:
    """Raise unless `Environment` or one of `takers` takes each of `others`."""
    known = [name for f in (*takers, Environment) for name in _parameters(f)]
    for name in others:
        if name not in known:
            names = list(dict.fromkeys([*_parameters(task), *known]))
            close = difflib.get_close_matches(name, names, n=3) or names
            raise ValueError(
                f"{task.__name__}: no argument is called {name!r}; did you mean "
                f"{' or '.join(repr(n) for n in close)}?"
            )


def system_of(
    task: Callable[..., Environment],
    kind: type[_System],
    system: _System | None,
    others: Mapping[str, Any],
    *takers: Callable[..., Any],
    base: type[AbstractSystem] | None = None,
) -> tuple[_System, dict[str, Any]]:
    """The system of a task, and those of `others` that are not arguments of it.

    `system` itself, or the `kind` that the arguments in `others` make. The rest is what
    `takers` and `Environment` take.

    **Raises:** `ValueError` if nothing takes one of `others`, if there are both a
    system and arguments of one, or if it is not of that kind, or of its `base`.
    """
    where = task.__name__
    check_names(task, others, kind, *takers)
    constants, others = _split(others, kind)
    if system is None:
        return kind(**constants), others
    check_instance(system, base or kind, "system", where)
    if constants:
        names = ", ".join(constants)
        raise ValueError(f"{where}: give a system or its {names}, not both.")
    return system, others


def gym_dynamics(
    task: Callable[..., Environment],
    kind: type[AbstractSystem],
    gym: Callable[..., AbstractDynamics],
    system: AbstractSystem | None,
    others: Mapping[str, Any],
    dt: Any,
    solver: diffrax.AbstractSolver | None,
    substeps: int,
) -> tuple[AbstractDynamics, dict[str, Any]]:
    """The dynamics of a task with Gym's arithmetic, or a solver in its place, and those
    of `others` that are arguments of `Environment`.

    `gym` takes the system, `dt`, and what `others` hold of its arguments. See
    `system_of` for the rest.

    **Raises:** `ValueError` as `system_of` does, if `dt` is not positive, on `substeps`
    without a solver, or on an argument of `gym` with it.
    """
    where = task.__name__
    system, others = system_of(task, kind, system, others, gym)
    check_step(dt, where)
    limits, others = _split(others, gym)
    if solver is None:
        if substeps != 1:
            raise ValueError(f"{where}: substeps needs a solver, such as RK4().")
        return gym(system, dt, **limits), others
    for name in limits:
        raise ValueError(
            f"{where}: {name} is of Gym's arithmetic, and no solver has the like; give "
            f"one of {name} and solver."
        )
    return Discretized(system, dt, solver, substeps), others


def task_environment(others: Mapping[str, Any], **arguments: Any) -> Environment:
    """The environment of a task, in which `others` hold instead of `arguments`.

    The task's `observation_bounds` hold for the task as it is: they are left out where
    something is given that changes what is observed.
    """
    given = not _CHANGES_OBSERVATIONS.isdisjoint(others)
    if given and "observation_bounds" not in others:
        arguments["observation_bounds"] = None
    return Environment(**(arguments | dict(others)))
