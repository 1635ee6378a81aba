"""The ends of the spaces of an environment, and the kind of its actions."""

from typing import Any

import jax.numpy as jnp
import numpy as np

from .._check import check_bool, is_concrete
from ..environments import Environment


# Samples are drawn of an action space.
LARGEST_ACTION = 1e3


def has_discrete_actions(env: Environment, discrete: bool | None, where: str) -> bool:
    """Whether actions are indices into the table of `actions`: by default if there is
    one."""
    if discrete is None:
        return env.actions is not None
    if check_bool(discrete, "discrete", where) and env.actions is None:
        raise ValueError(
            f"{where}: discrete needs a table of actions in the environment, which has "
            "none."
        )
    return bool(discrete)


def finite_ends(bounds: Any, size: int, largest: float) -> tuple[Any, Any]:
    """`(low, high)` of a box, of NumPy where they are known. A side without a bound
    ends at the largest number."""
    low, high = (-np.inf, np.inf) if bounds is None else bounds
    numpy = np if is_concrete(low) and is_concrete(high) else jnp
    finite = lambda end: numpy.nan_to_num(end, posinf=largest, neginf=-largest)
    low, high = (numpy.broadcast_to(finite(end), (size,)) for end in (low, high))
    return low, high
