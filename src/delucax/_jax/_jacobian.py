"""Jacobians in whichever mode a function has."""

from collections.abc import Callable
from typing import Any

import jax


def jacobian(
    f: Callable[..., Any], argnums: int | tuple[int, ...] = 0
) -> Callable[..., Any]:
    """The Jacobian of `f` in forward mode, or in reverse where a solver inside has only
    that."""

    def derivative(*args):
        try:
            return jax.jacfwd(f, argnums)(*args)
        except TypeError as error:
            if "forward-mode" not in str(error):
                raise
            return jax.jacrev(f, argnums)(*args)

    return derivative
