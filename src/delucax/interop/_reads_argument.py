"""What a function makes of its argument."""

from collections.abc import Callable
from typing import Any

import jax


def reads_first_argument(function: Callable[..., Any], *args: Any) -> bool:
    """Whether anything is computed of the first of `args`, an array."""
    jaxpr = jax.make_jaxpr(function)(*args).jaxpr
    return any(jaxpr.invars[0] is v for e in jaxpr.eqns for v in e.invars)
