"""Signals to follow, as functions of time."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from .._check import as_matrix, check_step, check_vector
from .._module import check_parameters, parameter, positive
from .._typing import Real, RealScalar, Vector
from ..math import sin
from ..math._steps import step_at


class Constant(eqx.Module):
    """`r(t) = value`.

    **Arguments:** `value`: a vector.

    **Raises:** `ValueError` if `value` is not a finite vector.

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp

        dlx.references.Constant(jnp.array([1.0, 0.0]))(0.3)
        ```
    """

    value: Array = parameter()

    def __check_init__(self):
        check_vector(self.value, "value", "Constant")

    def __call__(self, t: RealScalar) -> Vector:
        """The signal at time `t`."""
        del t
        return self.value


class Sequence(eqx.Module):
    """`r(t) = values[round(t / dt)]`; the last value is held after the end, and the
    first one before the start.

    **Arguments:**

    - `values`: shape `(steps, p)`.
    - `dt`: the time between values.

    **Raises:** `ValueError` if `values` is not a matrix of finite numbers, or `dt` is
    not positive.

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp

        steps = dlx.references.Sequence(jnp.array([[0.0], [1.0]]), dt=0.5)
        steps(0.5)
        ```
    """

    values: Array = parameter()
    dt: Real = parameter(constraint=positive)

    def __check_init__(self):
        check_step(self.dt, "Sequence")
        as_matrix(self.values, "values", "Sequence")
        check_parameters(self)

    def __call__(self, t: RealScalar) -> Vector:
        """The signal at time `t`."""
        count = self.values.shape[0]
        k = step_at(t, self.dt, count, "Sequence")
        # Indexed, not interpolated: a rollout asks at the steps alone.
        return self.values[jnp.clip(k, 0, count - 1)]


class FigureEight(eqx.Module):
    """The curve of Gerono: `r(t) = centre + (width sin(s), height sin(2 s))`,
    `s = 2 pi t / period`.

    **Arguments:**

    - `period`: the period of the curve.
    - `width`, `height`: half the extent to each side, 1 by default.
    - `centre`: shape `(2,)`, the origin by default.

    **Raises:** `ValueError` if the period is not positive.

    !!! example

        ```python
        import delucax as dlx

        dlx.references.FigureEight(period=8.0)(1.0)
        ```
    """

    period: Real = parameter(constraint=positive)
    width: Real = parameter(1.0)
    height: Real = parameter(1.0)
    centre: Array = parameter((0.0, 0.0))

    def __check_init__(self):
        check_parameters(self)

    def __call__(self, t: RealScalar) -> Vector:
        """The signal at time `t`."""
        s = 2 * np.pi * t / self.period
        return self.centre + jnp.stack([self.width * sin(s), self.height * sin(2 * s)])
