"""Reference signals, as functions of time."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from .._check import as_matrix, check_step, check_vector
from .._module import check_parameters, parameter, positive, shown
from .._typing import Real, RealScalar, Vector
from ..math import sin
from ..math._steps import step_at


class Constant(eqx.Module):
    """A constant reference.

    **Arguments:**

    - `value`: shape `(p,)`.

    **Raises:** `ValueError` if `value` is not a vector of finite numbers.

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp

        dlx.references.Constant(jnp.array([1.0, 0.0]))(0.3)
        ```

        ```text
        Array([1., 0.], dtype=float32)
        ```
    """

    value: Array = parameter()

    __repr__ = shown

    def __check_init__(self):
        check_vector(self.value, "value", "Constant")

    def __call__(self, t: RealScalar) -> Vector:
        """The signal at time `t`."""
        del t
        return self.value


class Sequence(eqx.Module):
    """A reference from an array: `r(t) = values[round(t / dt)]`.

    Before the first time, the reference is the first value. After the last time, it is
    the last value.

    **Arguments:**

    - `values`: shape `(steps, p)`.
    - `dt`: the time between two values, in units of time.

    **Raises:** `ValueError` if `values` is not a matrix of finite numbers, or `dt` is
    not positive.

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp

        steps = dlx.references.Sequence(jnp.array([[0.0], [1.0]]), dt=0.5)
        steps(0.5)
        ```

        ```text
        Array([1.], dtype=float32)
        ```
    """

    values: Array = parameter()
    dt: Real = parameter(constraint=positive)

    __repr__ = shown

    def __check_init__(self):
        check_step(self.dt, "Sequence")
        as_matrix(self.values, "values", "Sequence")
        check_parameters(self)

    def __call__(self, t: RealScalar) -> Vector:
        """The signal at time `t`."""
        count = self.values.shape[0]
        k = step_at(t, self.dt, count, "Sequence")
        # Indexed, not interpolated, because a rollout only evaluates it at its steps.
        return self.values[jnp.clip(k, 0, count - 1)]


class FigureEight(eqx.Module):
    r"""A figure of eight in the plane (the lemniscate of Gerono).

    $$r(t) = c + (a \sin s, b \sin 2 s), \qquad s = 2 \pi t / T$$

    **Arguments:**

    - `period`: $T$, in units of time.
    - `width`, `height`: $a$ and $b$, half of the full width and half of the full height
        of the figure, 1 by default.
    - `centre`: $c$, shape `(2,)`, the origin by default.

    **Raises:** `ValueError` if the period is not positive.

    !!! example

        ```python
        import delucax as dlx

        dlx.references.FigureEight(period=8.0)(1.0)
        ```

        ```text
        Array([0.707, 1.   ], dtype=float32)
        ```
    """

    period: Real = parameter(constraint=positive)
    width: Real = parameter(1.0)
    height: Real = parameter(1.0)
    centre: Array = parameter((0.0, 0.0))

    __repr__ = shown

    def __check_init__(self):
        check_parameters(self)

    def __call__(self, t: RealScalar) -> Vector:
        """The signal at time `t`."""
        s = 2 * np.pi * t / self.period
        return self.centre + jnp.stack([self.width * sin(s), self.height * sin(2 * s)])
