"""Stage and final costs."""

import abc

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array

from .._fields import check_parameters
from .._typing import RealScalar


class AbstractCost(eqx.Module):
    """A stage cost `c(t, x, u)` and a final cost.

    A cost is minus a reward. The stage cost is charged at the current state and the
    control that was applied, once a step; the final cost once, at the last state or on
    entering a terminated one.

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp

        class Effort(dlx.AbstractCost):
            def __call__(self, t, x, u):
                return jnp.sum(u**2)

        Effort()(0.0, jnp.zeros(2), jnp.ones(1))
        ```
    """

    def __check_init__(self):
        check_parameters(self)

    @abc.abstractmethod
    def __call__(self, t: RealScalar, x: Array, u: Array) -> Array:
        """The stage cost.

        **Arguments:** `t`: time. `x`: state. `u`: control that was applied.

        **Returns:** a scalar.
        """

    def final(self, t: RealScalar, x: Array) -> Array:
        """The final cost; 0 by default.

        **Arguments:** `t`: time. `x`: the last state.

        **Returns:** a scalar.
        """
        del t
        return jnp.zeros((), x.dtype)
