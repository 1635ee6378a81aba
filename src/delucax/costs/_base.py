"""Stage and final costs."""

import abc
from typing import Any, ClassVar

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array

from .._module import as_float_array, check_parameters, parts_of
from .._typing import Control, RealScalar, State
from ..systems import AbstractPlant


class AbstractCost(eqx.Module):
    """A stage cost `c(t, x, u)` and a final cost.

    A cost is minus a reward. The stage cost is charged at the current state and the
    control that was applied, once a step; the final cost once, at the last state or on
    entering a terminated one.

    Add two with `+`, and multiply one by a number with `*`.

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

    @property
    def targets(self) -> tuple[Array | None, Array | None] | None:
        """The state and the control that the cost draws to, each `None` where it is not
        named; `None` alone, as by default, for a cost that draws to no fixed point.

        A cost made of others has the first state and the first control that they name.
        Where planners start by default depends on it; see
        [`delucax.planning.default_start`][].
        """
        named = [part.targets for part in parts_of(self, AbstractCost)]
        pairs = [pair for pair in named if pair is not None]
        if not pairs:
            return None
        first = lambda values: next((a for a in values if a is not None), None)
        return first(x for x, _ in pairs), first(u for _, u in pairs)

    def set_point(self, plant: AbstractPlant) -> tuple[State, Control] | None:
        """The state and the control to regulate a plant about: the `targets` where they
        name both, else the equilibrium of the plant, else the one that is named and
        zeros.

        **Arguments:** `plant`: a system or dynamics.

        **Returns:** `(x, u)`; `None` if neither names one, or they do not fit.
        """
        x, u = targets = self.targets or (None, None)
        if x is None or u is None:
            try:
                x, u = plant.equilibrium()
            except ValueError:
                if self.targets is None:
                    return None
                sizes = plant.state_size, plant.control_size
                x, u = (
                    jnp.zeros(size) if at is None else at
                    for at, size in zip(targets, sizes, strict=True)
                )
        x, u = jnp.asarray(as_float_array(x)), jnp.asarray(as_float_array(u))
        # What does not fit the plant is an error of what uses the point.
        fits = x.shape == (plant.state_size,) and u.shape == (plant.control_size,)
        return (x, u) if fits else None

    # So that a NumPy number times a cost is left to `__rmul__`.
    __array_ufunc__: ClassVar = None

    def __add__(self, other: "AbstractCost") -> "AbstractCost":
        from ._compose import Sum

        if not isinstance(other, AbstractCost):
            return NotImplemented
        return Sum(self, other)

    def __radd__(self, other: Any) -> "AbstractCost":
        # The built-in `sum` starts at 0.
        return self if isinstance(other, int) and other == 0 else NotImplemented

    def __mul__(self, factor: Any) -> "AbstractCost":
        from ._compose import Scaled

        if isinstance(factor, AbstractCost):
            return NotImplemented
        return Scaled(self, factor)

    __rmul__ = __mul__

    @abc.abstractmethod
    def __call__(self, t: RealScalar, x: State, u: Control) -> Array:
        """The stage cost.

        **Arguments:** `t`: time. `x`: state. `u`: control that was applied.

        **Returns:** a scalar.
        """

    def final(self, t: RealScalar, x: State) -> Array:
        """The final cost; 0 by default.

        **Arguments:** `t`: time. `x`: the last state.

        **Returns:** a scalar.
        """
        del t
        return jnp.zeros((), x.dtype)
