"""Tasks by name."""

import difflib
import importlib
import inspect
from collections.abc import Callable, Mapping
from typing import Any

from ._environment import Environment


_REGISTRY: dict[str, str] = {
    "acrobot": "delucax.environments:acrobot",
    "classic/acrobot": "delucax.environments:acrobot",
    "cartpole": "delucax.environments:cartpole",
    "classic/cartpole": "delucax.environments:cartpole",
    "cartpole_linear": "delucax.environments:cartpole_linear",
    "mountain_car": "delucax.environments:mountain_car",
    "classic/mountain_car": "delucax.environments:mountain_car",
    "mountain_car_discrete": "delucax.environments:mountain_car_discrete",
    "pendulum": "delucax.environments:pendulum",
    "classic/pendulum": "delucax.environments:pendulum",
    "lds": "delucax.environments:lds",
    "planar_quadrotor": "delucax.environments:planar_quadrotor",
    "classic/planar_quadrotor": "delucax.environments:planar_quadrotor",
    "reacher": "delucax.environments:reacher",
    "classic/reacher": "delucax.environments:reacher",
    "double_integrator": "delucax.environments:double_integrator",
    "mass_spring_damper": "delucax.environments:mass_spring_damper",
    "van_der_pol": "delucax.environments:van_der_pol",
    "lorenz": "delucax.environments:lorenz",
    "quadrotor": "delucax.environments:quadrotor",
    "kinematic_bicycle": "delucax.environments:kinematic_bicycle",
    "dynamic_bicycle": "delucax.environments:dynamic_bicycle",
    "two_tank": "delucax.environments:two_tank",
    "cstr": "delucax.environments:cstr",
    "permanent_magnet_motor": "delucax.environments:permanent_magnet_motor",
    "neural": "delucax.environments:neural",
    "balloon_lung": "delucax.lung:balloon_lung",
    "lung/balloon_lung": "delucax.lung:balloon_lung",
    "delay_lung": "delucax.lung:delay_lung",
    "lung/delay_lung": "delucax.lung:delay_lung",
    "single_compartment": "delucax.lung:single_compartment",
    "lung/single_compartment": "delucax.lung:single_compartment",
    "double_compartment": "delucax.lung:double_compartment",
    "lung/double_compartment": "delucax.lung:double_compartment",
    "learned_lung": "delucax.lung:learned_lung",
    "lung/learned_lung": "delucax.lung:learned_lung",
}


_MOVES_WHAT_IS_SEEN = {
    "disturbance",
    "dynamics",
    "encode",
    "initial_state",
    "sensor_noise",
    "terminated",
}


def make(name: str, **kwargs: Any) -> Environment:
    """The task of that name.

    **Arguments:**

    - `name`: such as `"pendulum"`; the paper's names (`"classic/pendulum"`) work too.
    - `**kwargs`: passed to the function that makes the task.

    **Returns:** an [`delucax.Environment`][].

    **Raises:** `ValueError` on an unknown name, with the close ones, or if what was
    registered makes no environment.

    !!! example

        ```python
        import delucax as dlx

        env = dlx.make("pendulum", length=1.2)
        ```
    """
    if not isinstance(name, str) or name not in _REGISTRY:
        names = sorted(_REGISTRY)
        close = difflib.get_close_matches(str(name), names, n=3, cutoff=0.4) or names
        raise ValueError(
            f"make: no task is called {name!r}; did you mean "
            f"{' or '.join(repr(n) for n in close)}? All names: {', '.join(names)}."
        )
    module, _, function = _REGISTRY[name].partition(":")
    try:
        task = getattr(importlib.import_module(module), function)
    except (ImportError, AttributeError) as error:
        raise ValueError(
            f"make: {name!r} is registered as {_REGISTRY[name]!r}, which cannot be "
            f"imported: {error}."
        ) from error
    env = task(**kwargs)
    if not isinstance(env, Environment):
        raise ValueError(
            f"make: {name!r} must be an Environment, but {_REGISTRY[name]!r} returned "
            f"{type(env).__name__}."
        )
    return env


def horizon_of(name: str) -> int:
    """The horizon of one of our own tasks, unless another is given."""
    module, _, function = _REGISTRY[name].partition(":")
    task = getattr(importlib.import_module(module), function)
    return inspect.signature(task).parameters["horizon"].default


def finish(
    task: Callable[..., Environment],
    arguments: Mapping[str, Any],
    given: Mapping[str, Any],
    *shared: Callable[..., Environment],
) -> Environment:
    """The environment of a task that takes what else there is to give of one; `shared`
    are functions that take other arguments of the task.

    The task's `observation_bounds` hold for the task as it is: they are left out where
    something is given that moves what is seen.

    **Raises:** `ValueError` if one of `given` is no argument of `Environment`, with the
    close ones, the task's own among them.
    """
    known = inspect.signature(Environment).parameters
    takers = task, *shared
    own = [p for f in takers for p in inspect.signature(f).parameters.values()]
    for name in given:
        if name not in known:
            names = [p.name for p in own if p.kind is not p.VAR_KEYWORD]
            names = list(dict.fromkeys([*names, *known]))
            close = difflib.get_close_matches(name, names, n=3) or names
            raise ValueError(
                f"{task.__name__}: no argument is called {name!r}; did you mean "
                f"{' or '.join(repr(n) for n in close)}?"
            )
    arguments = {**arguments, **given}
    if not _MOVES_WHAT_IS_SEEN.isdisjoint(given) and "observation_bounds" not in given:
        arguments["observation_bounds"] = None
    return Environment(**arguments)


def register(name: str, entry_point: str) -> None:
    """Add a task that [`delucax.make`][] finds.

    **Arguments:**

    - `name`: what to call it.
    - `entry_point`: `"module:function"`, imported when the task is first made; the
        function returns an [`delucax.Environment`][].

    **Raises:** `ValueError` if the entry point is not of that form, or if the name is
    taken by another.

    !!! example

        ```python
        import delucax as dlx

        dlx.register("my_pendulum", "delucax.environments:pendulum")
        env = dlx.make("my_pendulum")
        ```
    """
    if not isinstance(name, str) or not name:
        raise ValueError(
            f"register: name must be a string that is not empty, got {name!r}."
        )
    module, _, function = str(entry_point).partition(":")
    if not module or not function.isidentifier():
        raise ValueError(
            "register: entry_point must be 'module:function', such as "
            f"'my_package.tasks:rocket', got {entry_point!r}."
        )
    if _REGISTRY.get(name, entry_point) != entry_point:
        raise ValueError(f"register: {name!r} is already {_REGISTRY[name]!r}.")
    _REGISTRY[name] = entry_point


def registered() -> tuple[str, ...]:
    """The names that [`delucax.make`][] knows.

    !!! example

        ```python
        import delucax as dlx

        dlx.environments.registered()
        ```
    """
    return tuple(sorted(_REGISTRY))
