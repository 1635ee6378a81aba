"""The registry of tasks by name."""

import importlib
from collections.abc import Callable
from typing import Any

from .._message import did_you_mean
from ._environment import Environment


TASKS = {
    "_classic_control": "acrobot cartpole mountain_car mountain_car_discrete pendulum",
    "_hard": "cartpole_swing_up double_pendulum_cart drift furuta quadrotor_flip "
    "reactor_start_up slung_load",
    "_hybrid": "bouncing_ball compass_gait rimless_wheel stick_slip thermostat "
    "valve_with_stops",
    "_linear": "cartpole_linear lds",
    "_regulation": "cstr double_integrator lorenz mass_spring_damper neural "
    "permanent_magnet_motor two_tank van_der_pol",
    "_robots": "dynamic_bicycle kinematic_bicycle planar_quadrotor quadrotor reacher",
}
"""The tasks of this package, by the module that defines them."""
_LUNGS = """
    balloon_lung delay_lung double_compartment learned_lung single_compartment
""".split()
# The Deluca paper's names for these tasks start with "classic/".
_CLASSIC = "acrobot cartpole mountain_car pendulum planar_quadrotor reacher".split()

# From names to entry points.
_REGISTRY: dict[str, str] = {
    **{
        name: f"delucax.environments:{name}"
        for names in TASKS.values()
        for name in names.split()
    },
    **{f"classic/{name}": f"delucax.environments:{name}" for name in _CLASSIC},
    **{name: f"delucax.lung:{name}" for name in _LUNGS},
    **{f"lung/{name}": f"delucax.lung:{name}" for name in _LUNGS},
}


def make(name: str, **kwargs: Any) -> Environment:
    """Make a registered task by its name.

    **Arguments:**

    - `name`: such as `"pendulum"`. The names of the Deluca paper, such as
        `"classic/pendulum"`, work too. [`delucax.environments.registered`][] lists all.
    - `**kwargs`: keyword arguments for the function that makes the task, such as
        [`delucax.environments.pendulum`][].

    **Returns:** a [`delucax.Environment`][].

    **Raises:** `ValueError` on an unknown name, or if the function does not return an
    environment.

    !!! example

        ```python
        import delucax as dlx

        env = dlx.make("pendulum", length=1.2)
        env.state_size, env.control_size, env.horizon
        ```

        ```text
        (2, 1, 200)
        ```
    """
    env = _function_of(name)(**kwargs)
    if not isinstance(env, Environment):
        raise ValueError(
            f"make: the entry point {_REGISTRY[name]!r} of {name!r} must return an "
            f"Environment, got {type(env).__name__}."
        )
    return env


def _function_of(name: str) -> Callable[..., Any]:
    """The function that makes a task."""
    if not isinstance(name, str) or name not in _REGISTRY:
        names = sorted(_REGISTRY)
        raise ValueError(
            f"make: no task is called {name!r}; "
            f"{did_you_mean(str(name), names, cutoff=0.4)} "
            f"All names: {', '.join(names)}."
        )
    module, _, function = _REGISTRY[name].partition(":")
    try:
        return getattr(importlib.import_module(module), function)
    except (ImportError, AttributeError) as error:
        raise ValueError(
            f"make: the entry point {_REGISTRY[name]!r} of {name!r} cannot be "
            f"imported: {error}."
        ) from error


def register(name: str, entry_point: str) -> None:
    """Register a task, so that [`delucax.make`][] can make it by its name.

    **Arguments:**

    - `name`: the name of the task.
    - `entry_point`: `"module:function"`. The module is imported when the task is first
        made. The function must return a [`delucax.Environment`][].

    **Raises:** `ValueError` if the entry point is not of the form `"module:function"`,
    or if another task has this name.

    !!! example

        ```python
        import delucax as dlx

        dlx.register("my_pendulum", "delucax.environments:pendulum")
        env = dlx.make("my_pendulum")
        ```
    """
    if not isinstance(name, str) or not name:
        raise ValueError(f"register: name must be a non-empty string, got {name!r}.")
    module, _, function = str(entry_point).partition(":")
    if not module or not function.isidentifier():
        raise ValueError(
            "register: entry_point must be 'module:function', such as "
            f"'my_package.tasks:rocket', got {entry_point!r}."
        )
    if _REGISTRY.get(name, entry_point) != entry_point:
        raise ValueError(
            f"register: name must be new, got {name!r}, which is already registered as "
            f"{_REGISTRY[name]!r}."
        )
    _REGISTRY[name] = entry_point


def registered() -> tuple[str, ...]:
    """The names of the registered tasks, which [`delucax.make`][] knows.

    **Returns:** a tuple of strings, sorted.

    !!! example

        ```python
        import delucax as dlx

        dlx.environments.registered()[:3]
        ```

        ```text
        ('acrobot', 'balloon_lung', 'bouncing_ball')
        ```
    """
    return tuple(sorted(_REGISTRY))
