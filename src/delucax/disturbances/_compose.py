"""Disturbances made of others."""

import functools
import operator
from typing import Any

import jax.numpy as jnp
import jax.random as jr
from jaxtyping import Array

from .._check import check_instance, check_key, check_range
from .._module import parameter
from .._typing import PRNGKey, Vector
from ..math._steps import reached, step_between
from ._base import AbstractDisturbance, Rows
from ._deterministic import Constant


class Sum(AbstractDisturbance):
    """The sum of several disturbances, each drawn with a key of its own.

    **Arguments:** `*terms`: disturbances of one size.

    **Raises:** `ValueError` if there are none, if one is no disturbance, or if sizes
    differ.

    !!! example

        ```python
        import delucax as dlx

        both = dlx.disturbances.Sum(
            dlx.disturbances.Gaussian(0.1, size=2),
            dlx.disturbances.Constant(0.5, size=2),
        )
        ```
    """

    terms: tuple[AbstractDisturbance, ...]

    def __init__(self, *terms: AbstractDisturbance):
        self.terms = terms

    def __check_init__(self):
        for term in self.terms:
            check_instance(term, AbstractDisturbance, "every term", "Sum")
        sizes = [term.size for term in self.terms]
        if len(set(sizes)) != 1:
            raise ValueError(f"Sum: terms must be of one size, got sizes {sizes}.")

    @property
    def size(self) -> int:
        """The size that the terms share."""
        return self.terms[0].size

    def sequence(self, key: PRNGKey | None, times: Vector) -> Rows:
        n = len(self.terms)
        if key is not None:
            check_key(key, "Sum")
        keys = [None] * n if key is None else list(jr.split(key, n))
        drawn = (w.sequence(k, times) for w, k in zip(self.terms, keys, strict=True))
        return functools.reduce(operator.add, drawn)


class Window(AbstractDisturbance):
    """A disturbance inside a time window, `start <= t < stop`, and zero outside.

    An end within rounding of the time of a step is that step's: a window of 5 steps
    acts on 5. Elsewhere the times are compared as they are.

    **Arguments:**

    - `disturbance`: the one inside.
    - `start`, `stop`: the ends of the window, in units of time.

    **Raises:** `ValueError` if `disturbance` is not one, or `stop` is before `start`;
    in a horizon of more than 2^22 steps in single precision, whose times do not tell
    the steps apart.

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp

        gust = dlx.disturbances.Window(
            dlx.disturbances.Sinusoid(0.2, frequency=1.0, size=2), start=3.0, stop=6.0
        )
        gust.sequence(None, 0.5 * jnp.arange(20))
        ```
    """

    disturbance: AbstractDisturbance
    start: Array = parameter()
    stop: Array = parameter()

    def __check_init__(self):
        check_instance(self.disturbance, AbstractDisturbance, "disturbance", "Window")
        check_range(self.stop, "stop", "Window", self.start)

    @property
    def size(self) -> int:
        """That of the disturbance inside."""
        return self.disturbance.size

    def sequence(self, key: PRNGKey | None, times: Vector) -> Rows:
        w = self.disturbance.sequence(key, times)
        dt = step_between(times, "Window")
        inside = reached(times, self.start, dt) & ~reached(times, self.stop, dt)
        w = jnp.where(inside[:, None], w, jnp.zeros((), w.dtype))
        return w if dt is None else jnp.where(jnp.isnan(dt), jnp.nan, w)


def shock(value: Any, start: Any, duration: Any, *, size: int | None = None) -> Window:
    """A constant push for a while: a `Window` of a `Constant`.

    **Arguments:**

    - `value`: a number, or a vector of `size` entries.
    - `start`, `duration`: in units of time.
    - `size`: entries a step; follows from `value` if that is a vector.

    **Returns:** the disturbance.

    **Raises:** `ValueError` if the size is unknown or does not fit, or `duration` is
    negative.

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp

        push = dlx.disturbances.shock(jnp.array([0.0, 0.5]), start=5.0, duration=0.5)
        ```
    """
    check_range(duration, "duration", "shock")
    return Window(Constant(value, size=size), start, start + duration)
