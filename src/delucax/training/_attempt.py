"""What a search for a policy tries."""

from typing import NamedTuple

import numpy as np

from .._controller import AbstractController


class Attempt(NamedTuple):
    """One training that was tried.

    **Attributes:** `structure` of the policy; `method`; `cost`, the mean over the
    starts on which policies are chosen; `seconds`, with compilation.

    !!! example

        ```python
        import delucax as dlx

        attempt = dlx.training.Attempt("network", "evolution", 12.5, 3.0)
        attempt.method, attempt.cost
        ```
    """

    structure: str
    method: str
    cost: float
    seconds: float


class Line(NamedTuple):
    """A policy that one method trains, and its costs, `None` before the training."""

    structure: str
    method: str
    policy: AbstractController
    costs: np.ndarray | None = None
