"""The trainings that `synthesise` tries."""

from typing import NamedTuple

import numpy as np

from .._controller import AbstractController


class Attempt(NamedTuple):
    """One training that [`delucax.training.synthesise`][] tried.

    **Attributes:**

    - `structure`: the structure of the policy, as in [`delucax.training.Synthesis`][].
    - `method`: the training method, such as `"gradient"` or `"evolution"`.
    - `cost`: the mean cost over the initial states on which policies are chosen.
    - `seconds`: the time that the training took, including compilation [s].

    !!! example

        ```python
        import delucax as dlx

        attempt = dlx.training.Attempt("network", "evolution", 12.5, 3.0)
        attempt.method, attempt.cost
        ```

        ```text
        ('evolution', 12.5)
        ```
    """

    structure: str
    method: str
    cost: float
    seconds: float


class Line(NamedTuple):
    """A policy in training: the method of its last gain (`"none"` before training), and
    its costs."""

    structure: str
    method: str
    policy: AbstractController
    costs: np.ndarray
