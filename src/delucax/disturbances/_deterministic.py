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
    """No disturbance.

    **Arguments:** `size`: entries per step.

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp

        dlx.disturbances.Zero(2).sequence(None, jnp.arange(3.0))
        ```
    """

    size: int = eqx.field(static=True)

    def __init__(self, size: int):
        self.size = check_count(size, "size", "Zero")

    def sequence(self, key: PRNGKey | None, times: Vector) -> Rows:
        return jnp.zeros((times.shape[0], self.size), times.dtype)


class Constant(AbstractEntrywise):
    """`w[k] = value`.

    **Arguments:**

    - `value`: a number, or a vector of `size` entries.
    - `size`: entries per step; follows from `value` if that is a vector.

    **Raises:** `ValueError` if the size is unknown or does not fit.

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp

        dlx.disturbances.Constant(0.5, size=2).sequence(None, jnp.arange(3.0))
        ```
    """

    value: Real = parameter()
    size: int = eqx.field(default=None, converter=as_size, static=True, kw_only=True)

    def sequence(self, key: PRNGKey | None, times: Vector) -> Rows:
        return self._rows(self.value, times)


def shock(
    value: Any, start: Any, duration: Any, *, size: int | None = None
) -> AbstractDisturbance:
    """A constant push for a while: a `Constant`, `between` two times.

    **Arguments:**

    - `value`: a number, or a vector of `size` entries.
    - `start`, `duration`: in units of time.
    - `size`: entries per step; follows from `value` if that is a vector.

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
    given = {} if size is None else {"size": size}
    return Constant(value, **given).between(start, start + duration)


class Sinusoid(AbstractEntrywise):
    """`w[k] = amplitude sin(2 pi frequency t_k + phase) + offset`.

    **Arguments:** each a number or a vector of `size` entries.

    - `amplitude`.
    - `frequency`: in hertz if time is in seconds.
    - `phase`: in radians, 0 by default.
    - `offset`: 0 by default.
    - `size`: entries per step; follows from the others if one is a vector.

    **Raises:** `ValueError` if the size is unknown or does not fit.

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp

        wind = dlx.disturbances.Sinusoid(jnp.array([0.0, 0.2]), frequency=0.5)
        wind.sequence(None, 0.1 * jnp.arange(5))
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
    """`w[k] = amplitude` in the first part of each period and `-amplitude` in the rest.

    **Arguments:** each a number or a vector of `size` entries.

    - `amplitude`.
    - `period`: in units of time, positive.
    - `duty`: the part of a period at `+amplitude`, from 0 to 1; 0.5 by default.
    - `size`: entries per step; follows from the others if one is a vector.

    A period, or a part of one, within rounding of a whole number of steps is that
    number of steps. The gradient with respect to `period` and `duty` is zero almost
    everywhere.

    **Raises:** `ValueError` if the size is unknown or does not fit, the period is not
    positive, or `duty` is not between 0 and 1; or for a horizon of more than 2^22 steps
    in single precision, whose times are too coarse for the steps.

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp

        dlx.disturbances.Square(0.3, period=2.0, size=1).sequence(None, jnp.arange(4.0))
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
        # In steps where the grid begins at 0; late times give their step less exactly.
        unit = self.period if dt is None else jnp.where(times[0] == 0, dt, self.period)
        eps = coarsest(times, self.period, self.duty)
        at, period = (
            sum(position(t, unit, 0.0, eps)) for t in (times[:, None], self.period)
        )
        # `slack` absorbs rounding error: steps are whole numbers.
        slack = jnp.minimum(2 * eps * (jnp.abs(at) + 1), 0.25)
        phase = at - period * jnp.floor((at + slack) / period)
        w = jnp.where(
            phase < self.duty * period - slack, self.amplitude, -self.amplitude
        )
        w = w if dt is None else jnp.where(jnp.isnan(dt), jnp.nan, w)
        return self._rows(w, times)


class FromArray(AbstractDisturbance):
    """A recorded or hand-made sequence: `w[k] = values[k]`.

    **Arguments:** `values`: shape `(steps, size)`, at least as many steps as the
    horizon it is used for.

    **Raises:** `ValueError` if `values` is not a matrix of finite numbers, or has too
    few steps for the horizon.

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp

        recorded = dlx.disturbances.FromArray(jnp.ones((100, 2)))
        recorded.sequence(None, 0.05 * jnp.arange(50))
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
                f"FromArray: values has {self.values.shape[0]} steps, fewer than the "
                f"horizon of {steps}."
            )
        return self.values[:steps].astype(times.dtype)
