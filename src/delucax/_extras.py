"""Import of optional dependencies."""

import importlib
from typing import Any


def extra(module: str, name: str) -> Any:
    """Import a module that the optional extra `name` installs.

    **Raises:** `ImportError` if the module is not installed; it says how to install it.
    """
    try:
        return importlib.import_module(module)
    except ImportError as error:
        raise ImportError(
            f'{module} is not installed. Run: pip install "delucax[{name}]"'
        ) from error
