"""The trainings that `synthesise` tries."""

from typing import Any, NamedTuple

import numpy as np


class Attempt(NamedTuple):
    """One policy that [`delucax.training.synthesise`][] tried.

    **Attributes:**

    - `structure`: the structure of the policy, as in [`delucax.training.Synthesis`][].
    - `method`: the training method. `"gradient"` follows the gradient of the rollout.
        `"gradient, 0.5 s"` does the same, but damps the gradient with a time constant
        of 0.5 s. `"evolution"` is [`delucax.training.evolve`][]. `"none"` is no
        training.
    - `cost`: the mean cost over 64 initial states that are only used to choose a
        policy. If the training had several rounds, `cost` is the lowest mean cost of
        all rounds.
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


class Candidate(NamedTuple):
    """A policy in training: the method of its last gain (`"none"` before training), its
    costs, and the learning rates of the methods that did not gain at the first rate."""

    structure: str
    method: str
    policy: Any
    costs: np.ndarray
    rates: dict[str, float] = {}
