"""Packages whose names are imported at first use."""

import importlib
import sys
from collections.abc import Callable
from typing import Any


def lazily(
    package: str, places: dict[str, str]
) -> tuple[Callable[[str], Any], Callable[[], list[str]]]:
    """`__getattr__` and `__dir__` of a package that imports names when they are used.

    **Arguments:** `package`: its name. `places`: the names that each module of it
        gives, by that of the module.
    """
    module_of = {name: place for place in places for name in places[place].split()}

    def get(name: str) -> Any:
        if name not in module_of:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        module = importlib.import_module(f"{package}.{module_of[name]}")
        return getattr(module, name)

    return get, lambda: sorted({*vars(sys.modules[package]), *module_of})
