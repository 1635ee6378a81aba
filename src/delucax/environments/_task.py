"""What the tasks share: their arguments, dynamics and solver, and where they start."""

import functools
import inspect
from collections.abc import Callable, Iterable
from typing import Any

import diffrax
import equinox as eqx
import jax.random as jr
import numpy as np
from jaxtyping import Array

from .._check import (
    as_bounds,
    check_instance,
    check_key,
    check_keywords,
    check_step,
    keywords_of,
)
from .._module import parameter
from .._typing import PRNGKey
from ..dynamics import AbstractDynamics, Discretized
from ..systems import AbstractSystem
from ._environment import Environment


class UniformState(eqx.Module):
    """A first state drawn uniformly from a box.

    **Arguments:** `low`, `high`: vectors, the corners of the box.

    **Raises:** `ValueError` if the corners differ in size or `low` is above `high`.

    !!! example

        ```python
        import delucax as dlx
        import jax
        import jax.numpy as jnp

        start = dlx.environments.UniformState(-jnp.ones(2), jnp.ones(2))
        start(jax.random.key(0))
        ```
    """

    low: Array = parameter()
    high: Array = parameter()

    def __init__(self, low: Any, high: Any):
        self.low = low
        self.high = high

    def __check_init__(self):
        size = np.size(self.low)
        as_bounds((self.low, self.high), "UniformState", "low and high", size)

    def __call__(self, key: PRNGKey) -> Array:
        """A state drawn with `key`."""
        check_key(key, "UniformState")
        unit = jr.uniform(key, self.low.shape, self.low.dtype)
        return self.low + (self.high - self.low) * unit


# What a task observes has its bounds for the task as it is. They are left out where
# one of these is given.
_CHANGES_OBSERVATIONS = {
    "disturbance",
    "dynamics",
    "encode",
    "initial_state",
    "sensor_noise",
    "terminated",
}


def task(
    kind: type[AbstractSystem],
    *,
    dt: float,
    horizon: int,
    solver: diffrax.AbstractSolver | None = None,
    substeps: int = 1,
    gym: Callable[..., AbstractDynamics] | None = None,
    arguments: Callable[..., dict[str, Any]] = lambda: {},
    accepts: type[AbstractSystem] | None = None,
) -> Callable[[Callable[..., dict[str, Any]]], Callable[..., Environment]]:
    """A decorator that makes a task of what the task adds to a system.

    It decorates a function of the system (with `gym`, of the dynamics) and of options
    to arguments of `Environment`. The task takes a system or the arguments of one, the
    options, `dt`, `horizon`, `solver` and `substeps`, the arguments of `gym`, and those
    of `Environment`, which hold instead of what the function returns.

    **Arguments:**

    - `kind`: the class of the system, if none is given.
    - `dt`, `horizon`, `solver`, `substeps`: defaults of the task.
    - `gym`: Gym's arithmetic, of a system, `dt` and limits, for which a solver can be
        given instead.
    - `arguments`: makes arguments of the system of others, by keywords.
    - `accepts`: what a system may be; of that `kind` by default.
    """
    default_solver, accepts = solver, accepts or kind
    arithmetic = () if gym is None else (gym,)
    derived = inspect.signature(arguments).parameters

    def decorate(added: Callable[..., dict[str, Any]]) -> Callable[..., Environment]:
        where = added.__name__

        def make(
            system: Any = None,
            *,
            dt: Any = dt,
            horizon: int = horizon,
            solver: diffrax.AbstractSolver | None = None,
            substeps: int = substeps,
            **others: Any,
        ) -> Environment:
            check_keywords(others, where, make, kind, *arithmetic, Environment)
            chosen = _taken(others, [p.name for p in options])
            special = _taken(others, derived)
            special = {n: v for n, v in special.items() if v is not None}
            constants = _taken(others, keywords_of(kind))
            if system is None:
                system = kind(**(constants | arguments(**special)))
            elif special or constants:
                names = ", ".join([*special, *constants])
                raise ValueError(f"{where}: give a system or its {names}, not both.")
            check_instance(system, accepts, "system", where)
            if gym is None:
                subject = system
                dynamics = Discretized(system, dt, solver or default_solver, substeps)
            else:
                limits = _taken(others, keywords_of(gym))
                step = functools.partial(gym, system, dt, **limits)
                subject = dynamics = gym_or_solver(step, solver, substeps, where)
            fields: dict[str, Any] = dict(dynamics=dynamics, horizon=horizon)
            fields = fields | added(subject, **chosen) | others
            if "observation_bounds" not in others:
                if not _CHANGES_OBSERVATIONS.isdisjoint(others):
                    fields["observation_bounds"] = None
            return Environment(**fields)

        # Documentation and the check of keywords read the arguments off the signature.
        signature = inspect.signature(make)
        system, *rest = signature.parameters.values()
        system = system.replace(annotation=accepts | None)
        _, *options = inspect.signature(added).parameters.values()
        parameters = [system, *options, *derived.values(), *rest]
        signature = signature.replace(parameters=parameters)
        functools.update_wrapper(make, added)
        vars(make)["__signature__"] = signature
        return make

    return decorate


def _taken(arguments: dict[str, Any], names: Iterable[str]) -> dict[str, Any]:
    """Those of `arguments` that are called so, which they no longer hold then."""
    return {name: arguments.pop(name) for name in names if name in arguments}


def gym_or_solver(
    step: functools.partial[AbstractDynamics],
    solver: diffrax.AbstractSolver | None,
    substeps: int,
    where: str,
) -> AbstractDynamics:
    """What `step` makes of a system, `dt` and limits, or a solver in its place."""
    system, dt = step.args
    check_step(dt, where)
    if solver is None:
        if substeps != 1:
            raise ValueError(f"{where}: substeps needs a solver, such as RK4().")
        return step()
    for name in step.keywords:
        raise ValueError(
            f"{where}: {name} is of Gym's arithmetic, and no solver has the like; give "
            f"one of {name} and solver."
        )
    return Discretized(system, dt, solver, substeps)
