"""The decorator that makes tasks from systems, and uniform initial states."""

import functools
import inspect
from collections.abc import Callable, Iterable
from typing import Annotated, Any, get_args, TypeAlias

import diffrax
import equinox as eqx
import jax.numpy as jnp
import jax.random as jr
import numpy as np

from .._check import (
    as_bounds,
    as_float_array,
    check_instance,
    check_key,
    check_keywords,
    check_number,
    check_positive,
    check_range,
    check_step,
    keywords_of,
)
from .._jax import host_unless_traced, xp
from .._module import function_field, parameter, shown
from .._typing import Array, BoolScalar, PRNGKey, Real, State, Time, Vector
from ..costs import Arrival
from ..dynamics import AbstractDynamics, Discretized
from ..systems import AbstractSystem
from ._environment import Environment


class UniformState(eqx.Module):
    """An initial state that is drawn uniformly from a box.

    Pass a `UniformState` as the `initial_state` of a [`delucax.Environment`][].

    **Arguments:**

    - `low`, `high`: the corners of the box, each of shape `(n,)`.

    **Raises:** `ValueError` if the corners differ in size or `low` is above `high`.

    !!! example

        ```python
        import delucax as dlx
        import jax
        import jax.numpy as jnp

        start = dlx.environments.UniformState(-jnp.ones(2), jnp.ones(2))
        start(jax.random.key(0)).shape
        ```

        ```text
        (2,)
        ```
    """

    low: Real = parameter()
    high: Real = parameter()

    __repr__ = shown

    def __check_init__(self):
        size = np.size(self.low)
        as_bounds((self.low, self.high), "UniformState", "low and high", size)

    def __call__(self, key: PRNGKey) -> Array:
        """A state drawn with `key`."""
        check_key(key, "UniformState")
        unit = jr.uniform(key, self.low.shape, self.low.dtype)
        return self.low + (self.high - self.low) * unit


@host_unless_traced
def box(spread: Any, centre: Any = 0.0) -> tuple[Array, Array]:
    """The corners of the box within `spread` of `centre`, both numbers or lists."""
    dtype = jnp.result_type(float)
    spread, centre = xp.asarray(spread, dtype), xp.asarray(centre, dtype)
    return centre - spread, centre + spread


class StateFeatures(eqx.Module):
    """The `encode` of a task: a function of the whole state.

    With a sensor of its own a task has observations of another size, of which this
    function would read entries that do not exist.
    """

    function: Callable[[State], Vector] = function_field(of="x")
    state_names: tuple[str, ...] = eqx.field(static=True)

    __repr__ = shown

    def __call__(self, x: State) -> Vector:
        if jnp.shape(x) != (len(self.state_names),):
            raise ValueError(
                f"encode: the features of this task are computed from its states "
                f"({', '.join(self.state_names)}), got an observation of shape "
                f"{jnp.shape(x)}. If the sensors show something else, give the "
                "environment another encode, such as lambda y: y. If the observation "
                "is encoded already, remove the features of the controller."
            )
        return self.function(x)


_CHANGES_OBSERVATIONS = frozenset(
    "disturbance dynamics encode initial_state sensor_noise terminated".split()
)
"""Arguments of `Environment` that may invalidate the observation bounds of a task."""


def once(ended: Callable[[Time, State], BoolScalar], cost: Any) -> Arrival:
    """A cost that is charged once, at the end of an episode."""
    return Arrival(ended, step_cost=0.0, arrival_cost=cost)


Fields: TypeAlias = dict[str, Any]
"""Arguments of `Environment`, by name."""
# The options of a task have these annotations; `task` checks them.
Number: TypeAlias = Annotated[Array | float | int, check_number]
Positive: TypeAlias = Annotated[Array | float | int, check_positive]
Limit: TypeAlias = Annotated[Array | float | int, check_range]


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
) -> Callable[[Callable[..., Fields]], Callable[..., Environment]]:
    """A decorator that turns a function into a task: a function that returns an
    `Environment`.

    The decorated function maps a system (with `gym`, the dynamics) and options to
    arguments of `Environment`. The task takes

    - a system, or the arguments of its class;
    - the options, which it checks by their annotations;
    - `dt`, `horizon`, `solver` and `substeps`;
    - the arguments of `gym`;
    - the arguments of `Environment`, which override those of the function.

    The documentation of these arguments is added to the function's docstring.

    **Arguments:**

    - `kind`: the class of the system.
    - `dt`, `horizon`, `solver`, `substeps`: defaults of the task.
    - `gym`: a function of a system, `dt` and limits to the dynamics by Gym's
        integrator. It is used unless a solver is given.
    - `arguments`: a function of more options to arguments of the system.
    - `accepts`: the class of accepted systems; `kind` by default.
    """
    default_solver, accepts = solver, accepts or kind
    arithmetic = () if gym is None else (gym,)
    derived = inspect.signature(arguments).parameters
    default_name = "[`delucax.dynamics.RK4`][] by default"
    if gym is not None:
        default_name = "which replaces Gym's integrator and its limits; none by default"
    elif solver is not None:
        default_name = f"`diffrax.{type(solver).__name__}()` by default"

    def decorate(build: Callable[..., Fields]) -> Callable[..., Environment]:
        where = build.__name__
        # The first parameter is the system or the dynamics. The others are options, and
        # the annotation of each holds its check (alone, or in a union).
        _, *options = inspect.signature(build).parameters.values()
        checks = [
            (option.name, check, option.default)
            for option in options
            for part in (option.annotation, *get_args(option.annotation))
            for check in getattr(part, "__metadata__", ())
        ]

        def make(
            system: Any = None,
            *,
            dt: Any = dt,
            horizon: int = horizon,
            solver: diffrax.AbstractSolver | None = None,
            substeps: int = substeps,
            **others: Any,
        ) -> Environment:
            """- `system`: a [`delucax.systems.{kind}`][]; by default it is built from
                the other keyword arguments.
            - `dt`: the control interval{unit}, {dt} by default.
            - `horizon`: the number of steps per episode, {horizon} by default.
            - `solver`: a Diffrax solver, {solver}.
            - `substeps`: the number of solver steps per control interval, {substeps} by
                default.
            - `**others`: arguments of [`delucax.systems.{kind}`][] or
                [`delucax.Environment`][], such as `disturbance`.

            **Returns:** the [`delucax.Environment`][].

            **Raises:** `ValueError` on invalid numbers, or on arguments that exclude
            each other: a system and arguments of its class, or a solver and limits of
            Gym's integrator. A task with Gym's integrator also raises a `ValueError` if
            `substeps` is given without a `solver`.
            """
            check_keywords(others, where, make, kind, *arithmetic, Environment)
            check_step(dt, where)
            # Each takes its own arguments; those of Environment are left.
            chosen = _taken(others, [option.name for option in options])
            special = _taken(others, derived)
            special = {n: v for n, v in special.items() if v is not None}
            constants = _taken(others, keywords_of(kind))
            limits = {} if gym is None else _taken(others, keywords_of(gym))

            if system is None:
                system = kind(**(constants | arguments(**special)))
            elif special or constants:
                names = ", ".join([*special, *constants])
                raise ValueError(f"{where}: pass a system or its {names}, not both.")
            check_instance(system, accepts, "system", where)

            if gym is None or solver is not None:
                for name in limits:
                    raise ValueError(
                        f"{where}: {name} applies only to Gym's integrator. Pass "
                        f"{name} or a solver, not both."
                    )
                dynamics = Discretized(system, dt, solver or default_solver, substeps)
            elif substeps != 1:
                raise ValueError(f"{where}: substeps needs a solver, such as RK4().")
            else:
                dynamics = gym(system, dt, **limits)

            for name, check, default in checks:
                if (value := chosen.get(name, default)) is not default:
                    check(value, name, where)
                    if isinstance(value, list | tuple):
                        chosen[name] = as_float_array(value)
            fields: Fields = dict(dynamics=dynamics, horizon=horizon)
            fields |= build(system if gym is None else dynamics, **chosen)
            if "encode" in fields:
                names = dynamics.state_names
                fields["encode"] = StateFeatures(fields["encode"], names)
            # The bounds of the observations only hold for the unchanged task.
            if not _CHANGES_OBSERVATIONS.isdisjoint(others):
                fields["observation_bounds"] = None
            return Environment(**(fields | others))

        # Documentation and the check of keywords read this signature: the arguments of
        # `make`, with the options after the system.
        signature = inspect.signature(make)
        system, *rest = signature.parameters.values()
        system = system.replace(annotation=accepts | None)
        parameters = [system, *map(_plain, options), *derived.values(), *rest]
        numbers = dict(dt=dt, horizon=horizon, substeps=substeps)
        unit = f" [{kind.time_unit}]" if kind.time_unit else ""
        names = dict(kind=kind.__name__, unit=unit, solver=default_name)
        shared = (inspect.getdoc(make) or "").format(**numbers, **names)
        functools.update_wrapper(make, build)
        # Documentation tools would read the signature of `build` through this.
        del vars(make)["__wrapped__"]
        # The shared arguments follow the options, before the source.
        own, source, rest = (inspect.getdoc(build) or "").partition("\n\nSource:")
        make.__doc__ = f"{own}\n{shared}{source}{rest}"
        vars(make)["__signature__"] = signature.replace(parameters=parameters)
        return make

    return decorate


def _plain(option: inspect.Parameter) -> inspect.Parameter:
    """The option, without the check in its annotation."""
    if hasattr(option.annotation, "__metadata__"):
        return option.replace(annotation=option.annotation.__origin__)
    return option


def _taken(arguments: dict[str, Any], names: Iterable[str]) -> dict[str, Any]:
    """Pop the arguments of these `names`."""
    return {name: arguments.pop(name) for name in names if name in arguments}
