"""The names that the commands `list` and `run` know."""

import inspect
from typing import Any

from .. import controllers
from .._controller import AbstractController
from ..environments import registered


SUITES = {"scoreboard": "delucax.studies._scoreboard"}
"""Experiments that come with the library: their modules."""


def task_names() -> tuple[str, ...]:
    """The named tasks, each once."""
    return tuple(name for name in registered() if "/" not in name)


def list_names() -> None:
    """Print the names of tasks, controllers and suites."""
    members = vars(controllers).items()
    names = [name for name, member in members if _makes_controller(member)]
    print('Tasks, for delucax.make("..."):')
    _print_columns(task_names())
    print("\nControllers, in delucax.controllers:")
    _print_columns(sorted(names, key=str.lower))
    print("\nSuites, for python -m delucax run ...:")
    _print_columns(tuple(SUITES))


def _makes_controller(member: Any) -> bool:
    """Whether it is a controller, or a function that makes one."""
    is_function = inspect.isfunction(member)
    made = inspect.signature(member).return_annotation if is_function else member
    is_controller = inspect.isclass(made) and issubclass(made, AbstractController)
    return is_controller and not inspect.isabstract(member)


def _print_columns(names: list[str] | tuple[str, ...]) -> None:
    width = max(map(len, names)) + 2
    count = max(1, 78 // width)
    rows = -(-len(names) // count)
    for k in range(rows):
        print("  " + "".join(name.ljust(width) for name in names[k::rows]).rstrip())
