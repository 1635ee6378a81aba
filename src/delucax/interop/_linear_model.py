"""Linear models out of matrices that others hold."""

from typing import Any

import numpy as np

from ..dynamics import LinearDynamics
from ..systems import LinearSystem


def check_no_feed_through(D: Any, where: str) -> None:
    """Raise if `D` is not zero."""
    if np.any(D):
        raise ValueError(
            f"{where}: D must be zero, as the models here have no feed-through, got "
            f"{D.tolist()}."
        )


def linear_model(
    A: Any, B: Any, C: Any, E: Any, dt: float, **names: Any
) -> LinearSystem | LinearDynamics:
    """A system if the step is 0, which says continuous time; else dynamics."""
    if dt == 0:
        return LinearSystem(A, B, C, E, **names)
    return LinearDynamics(A, B, C, E, dt=dt, **names)
