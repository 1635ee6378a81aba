"""Disturbances inside a window of time."""

from typing import Any

import jax.numpy as jnp
from jaxtyping import Array

from .._check import check_instance, check_range
from .._module import parameter
from .._typing import PRNGKey, Vector
from ..math._steps import reached, step_between
from ._base import AbstractDisturbance, Rows
from ._deterministic import Constant


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
