"""Packages that import their names at first use."""

import importlib
import sys
from collections.abc import Callable
from typing import Any


def lazily(
    package: str, places: dict[str, str]
) -> tuple[Callable[[str], Any], Callable[[], list[str]]]:
    """The `__getattr__` and `__dir__` of a package that imports its names at first use.

    **Arguments:** `package`: the name of the package. `places`: for each of its
        modules, the names that it provides, separated by spaces.
    """
    module_of = {name: place for place in places for name in places[place].split()}

    def get(name: str) -> Any:
        if name not in module_of:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        module = importlib.import_module(f"{package}.{module_of[name]}")
        return getattr(module, name)

    return get, lambda: sorted({*vars(sys.modules[package]), *module_of})
