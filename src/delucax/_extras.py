"""Import of optional dependencies."""

import importlib
from typing import Any


def extra(module: str, name: str) -> Any:
    """The module, which the optional extra `name` installs.

    **Raises:** `ImportError` that names the extra, if the module is not there.
    """
    try:
        return importlib.import_module(module)
    except ImportError as error:
        raise ImportError(
            f'{module} is not installed: pip install "delucax[{name}]".'
        ) from error
