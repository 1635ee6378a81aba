"""The trainings that `synthesise` tries."""

from typing import Any, NamedTuple

import numpy as np


class Attempt(NamedTuple):
    """One policy that [`delucax.training.synthesise`][] tried.

    **Attributes:**

    - `structure`: the structure of the policy, as in [`delucax.training.Synthesis`][].
    - `method`: the training method. `"gradient"` is the gradient of the rollout, and
        `"gradient, 0.5 s"` the same with a damping that has the time constant 0.5 s.
        `"evolution"` is [`delucax.training.evolve`][]. `"none"` is no training.
    - `cost`: the mean cost over 64 initial states that are only used to choose a
        policy. It is the lowest one of all rounds of this training.
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
