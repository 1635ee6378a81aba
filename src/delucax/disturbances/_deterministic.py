"""Disturbances that are known functions of time."""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from .._check import as_matrix, check_count, check_range
from .._module import parameter, positive
from .._typing import PRNGKey, Real, Vector
from ..math import sin
from ..math._steps import coarsest, position, step_between
from ._base import AbstractDisturbance, AbstractEntrywise, as_size, Rows


class Zero(AbstractDisturbance):
    """No disturbance: zeros.

    **Arguments:**

    - `size`: the number of entries of the disturbance at each step.

    **Raises:** `ValueError` if `size` is below 1.

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp

        dlx.disturbances.Zero(2).sequence(None, jnp.arange(3.0))
        ```

        ```text
        Array([[0., 0.],
               [0., 0.],
               [0., 0.]], dtype=float32)
        ```
    """

    size: int = eqx.field(static=True)

    def __init__(self, size: int):
        self.size = check_count(size, "size", "Zero")

    def sequence(self, key: PRNGKey | None, times: Vector) -> Rows:
        return jnp.zeros((times.shape[0], self.size), times.dtype)


class Constant(AbstractEntrywise):
    """A constant disturbance, the same at every step.

    **Arguments:**

    - `value`: a number, or shape `(size,)`.
    - `size`: the number of entries of the disturbance at each step. You may leave out
        `size` if `value` is a vector.

    **Raises:** `ValueError` if the size is unknown or does not fit.

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp

        dlx.disturbances.Constant(0.5, size=2).sequence(None, jnp.arange(3.0))
        ```

        ```text
        Array([[0.5, 0.5],
               [0.5, 0.5],
               [0.5, 0.5]], dtype=float32)
        ```
    """

    value: Real = parameter()
    size: int = eqx.field(default=None, converter=as_size, static=True, kw_only=True)

    def sequence(self, key: PRNGKey | None, times: Vector) -> Rows:
        return self._rows(self.value, times)


def shock(
    value: Any, start: Any, duration: Any, *, size: int | None = None
) -> AbstractDisturbance:
    """A push: a disturbance that is constant for a while, and zero before and after.

    **Arguments:**

    - `value`: a number, or shape `(size,)`.
    - `start`: the time at which the push starts, in units of time.
    - `duration`: how long the push lasts, in units of time.
    - `size`: the number of entries of the disturbance at each step. You may leave out
        `size` if `value` is a vector.

    **Returns:** the disturbance.

    **Raises:** `ValueError` if the size is unknown or does not fit, or `duration` is
    negative.

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp

        push = dlx.disturbances.shock(jnp.array([0.0, 0.5]), start=1.0, duration=2.0)
        push.sequence(None, jnp.arange(4.0))
        ```

        ```text
        Array([[0. , 0. ],
               [0. , 0.5],
               [0. , 0.5],
               [0. , 0. ]], dtype=float32)
        ```
    """
    check_range(duration, "duration", "shock")
    given = {} if size is None else {"size": size}
    return Constant(value, **given).between(start, start + duration)


class Sinusoid(AbstractEntrywise):
    r"""A sine wave.

    $$w_k = a \sin(2 \pi f t_k + \phi) + b$$

    **Arguments:** every argument except `size` is a number or has shape `(size,)`.

    - `amplitude`: $a$.
    - `frequency`: the frequency $f$, in hertz if time is in seconds.
    - `phase`: $\phi$ [rad], 0 by default.
    - `offset`: $b$, 0 by default.
    - `size`: the number of entries of the disturbance at each step. You may leave out
        `size` if another argument is a vector.

    **Raises:** `ValueError` if the size is unknown or does not fit.

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp

        wind = dlx.disturbances.Sinusoid(jnp.array([0.0, 0.2]), frequency=0.5)
        wind.sequence(None, 0.1 * jnp.arange(5))
        ```

        ```text
        Array([[0.   , 0.   ],
               [0.   , 0.062],
               [0.   , 0.118],
               [0.   , 0.162],
               [0.   , 0.19 ]], dtype=float32)
        ```
    """

    amplitude: Real = parameter()
    frequency: Real = parameter()
    phase: Real = parameter(0.0)
    offset: Real = parameter(0.0)
    size: int = eqx.field(default=None, converter=as_size, static=True, kw_only=True)

    def sequence(self, key: PRNGKey | None, times: Vector) -> Rows:
        return self._wave(times)

    @eqx.filter_jit
    def _wave(self, times: Vector) -> Rows:
        angle = 2 * np.pi * self.frequency * times[:, None] + self.phase
        return self._rows(self.amplitude * sin(angle) + self.offset, times)


class Square(AbstractEntrywise):
    """A square wave: `+amplitude` in the first part of each period, `-amplitude` in the
    rest.

    If rounding is the only reason why a period is not a whole number of steps, the
    period lasts exactly that number of steps. The first part of a period is rounded in
    the same way. The gradient with respect to `period` and `duty` is zero almost
    everywhere.

    **Arguments:** every argument except `size` is a number or has shape `(size,)`.

    - `amplitude`: half the difference between the two values of the wave.
    - `period`: in units of time, positive.
    - `duty`: the fraction of the period at `+amplitude`, from 0 to 1; 0.5 by default.
    - `size`: the number of entries of the disturbance at each step. You may leave out
        `size` if another argument is a vector.

    **Raises:** `ValueError` if the size is unknown or does not fit, the period is not
    positive, or `duty` is not between 0 and 1. `sequence` also raises a `ValueError` if
    the horizon has more than 2^22 steps in single precision, because the times are then
    too coarse to resolve a step.

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp

        dlx.disturbances.Square(0.3, period=2.0, size=1).sequence(None, jnp.arange(4.0))
        ```

        ```text
        Array([[ 0.3],
               [-0.3],
               [ 0.3],
               [-0.3]], dtype=float32)
        ```
    """

    amplitude: Real = parameter()
    period: Real = parameter(constraint=positive)
    duty: Real = parameter(0.5)
    size: int = eqx.field(default=None, converter=as_size, static=True, kw_only=True)

    def __check_init__(self):
        check_range(self.duty, "duty", "Square", 0, 1)

    def sequence(self, key: PRNGKey | None, times: Vector) -> Rows:
        return self._wave(times, step_between(times, "Square"))

    @eqx.filter_jit
    def _wave(self, times: Vector, dt: Any) -> Rows:
        # A grid that starts at 0 is counted in steps, which is exact. The step of a
        # later grid is only known to rounding.
        unit = self.period if dt is None else jnp.where(times[0] == 0, dt, self.period)
        eps = coarsest(times, self.period, self.duty)
        at, period = (
            sum(position(t, unit, 0.0, eps)) for t in (times[:, None], self.period)
        )
        # `slack` absorbs the rounding of whole numbers of steps.
        slack = jnp.minimum(2 * eps * (jnp.abs(at) + 1), 0.25)
        phase = at - period * jnp.floor((at + slack) / period)
        w = jnp.where(
            phase < self.duty * period - slack, self.amplitude, -self.amplitude
        )
        w = w if dt is None else jnp.where(jnp.isnan(dt), jnp.nan, w)
        return self._rows(w, times)


class FromArray(AbstractDisturbance):
    """A recorded or hand-made sequence: `w[k] = values[k]`.

    **Arguments:**

    - `values`: an array of shape `(steps, size)`, with at least as many steps as the
        horizon.

    **Raises:** `ValueError` at construction if `values` is not a matrix of finite
    numbers, and in `sequence` if `values` has fewer steps than the horizon.

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp

        recorded = dlx.disturbances.FromArray([[0.0, 0.1], [0.2, 0.3], [0.4, 0.5]])
        recorded.sequence(None, 0.05 * jnp.arange(2))
        ```

        ```text
        Array([[0. , 0.1],
               [0.2, 0.3]], dtype=float32)
        ```
    """

    values: Array = parameter()

    def __check_init__(self):
        as_matrix(self.values, "values", "FromArray")

    @property
    def size(self) -> int:
        """The number of columns of `values`."""
        return self.values.shape[1]

    @property
    def recorded_steps(self) -> int:
        """The number of rows of `values`."""
        return self.values.shape[0]

    def sequence(self, key: PRNGKey | None, times: Vector) -> Rows:
        steps = times.shape[0]
        if self.values.shape[0] < steps:
            raise ValueError(
                f"FromArray: values must have at least {steps} steps, the length of "
                f"the horizon, got {self.values.shape[0]}."
            )
        return self.values[:steps].astype(times.dtype)
