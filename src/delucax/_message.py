"""Values and names as error messages show them."""

import difflib
from collections.abc import Iterable
from typing import Any

import jax
import numpy as np
from jax.core import Tracer


_MOST = 120
"""The largest number of characters of a value in a message."""


def shortened(value: Any) -> str:
    """A value as an error message shows it, in a line or two."""
    if hasattr(value, "to_numpy"):  # tables and their columns
        return f"a {type(value).__name__} (`.to_numpy()` makes it an array)"
    is_array = isinstance(value, np.ndarray | jax.Array)
    text = str(value) if is_array else repr(value)
    if len(text) <= _MOST:
        return text
    if is_array and not isinstance(value, Tracer):
        return f"an array of shape {value.shape} and dtype {value.dtype}"
    return f"{' '.join(text[:_MOST].split())}... (a {type(value).__name__})"


def did_you_mean(name: str, names: Iterable[str], cutoff: float = 0.6) -> str:
    """The ending `did you mean ...?` of an error about an unknown name."""
    names = list(names)
    close = difflib.get_close_matches(name, names, n=3, cutoff=cutoff) or names
    return f"did you mean {' or '.join(map(repr, close)) or 'none'}?"
