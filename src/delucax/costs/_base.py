"""Stage and final costs, and costs made of functions and of other costs."""

import abc
import functools
import operator
from collections.abc import Callable
from typing import Any, ClassVar

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array

from .._check import check_instance, check_number, check_step
from .._module import (
    as_float_array,
    check_parameters,
    function_field,
    parameter,
    parts_of,
)
from .._typing import Control, Real, RealScalar, State
from ..systems import AbstractPlant


class AbstractCost(eqx.Module):
    """A stage cost `c(t, x, u)` and a final cost.

    A cost is minus a reward. The stage cost is charged at the current state and the
    control that was applied, once per step; the final cost once, at the last state or
    on entering a terminated one.

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
        """The target of the state and that of the control, each `None` where there is
        none; `None` alone, as by default, for a cost without a fixed target.

        A cost made of others has the first target of each that they have. Planners use
        it for their default start; see [`delucax.planning.Start.default`][].
        """
        named = [part.targets for part in parts_of(self, AbstractCost)]
        pairs = [pair for pair in named if pair is not None]
        if not pairs:
            return None
        # The first term that has a target decides, so that a penalty may be added.
        first = lambda values: next((a for a in values if a is not None), None)
        return first(x for x, _ in pairs), first(u for _, u in pairs)

    def set_point(self, plant: AbstractPlant) -> tuple[State, Control] | None:
        """The state and the control to regulate a plant about: the `targets` where
        there are both, else the equilibrium of the plant, else the target that is
        given, with zeros for the other.

        **Arguments:** `plant`: a system or dynamics.

        **Returns:** `(x, u)`; `None` if none of these is defined, or the sizes do not
        fit.
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
        # Whoever uses the point reports a size that does not fit.
        fits = x.shape == (plant.state_size,) and u.shape == (plant.control_size,)
        return (x, u) if fits else None

    # So that a NumPy number times a cost is left to `__rmul__`.
    __array_ufunc__: ClassVar = None

    def __add__(self, other: "AbstractCost") -> "AbstractCost":
        if not isinstance(other, AbstractCost):
            return NotImplemented
        return Sum(self, other)

    def __radd__(self, other: Any) -> "AbstractCost":
        # The built-in `sum` starts at 0.
        return self if isinstance(other, int) and other == 0 else NotImplemented

    def __mul__(self, factor: Any) -> "AbstractCost":
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


class Function(AbstractCost):
    """A cost from functions.

    **Arguments:**

    - `stage`: `(t, x, u) -> scalar`.
    - `final_cost`: `(t, x) -> scalar`; zero by default.

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp

        cost = dlx.costs.Function(lambda t, x, u: jnp.sum(x**2) + jnp.sum(u**2))
        cost(0.0, jnp.ones(2), jnp.zeros(1))
        ```
    """

    stage: Callable[[RealScalar, Array, Array], Array] = function_field()
    final_cost: Callable[[RealScalar, Array], Array] | None = function_field(None)

    def __call__(self, t: RealScalar, x: State, u: Control) -> Array | float:
        return self.stage(t, x, u)

    def final(self, t: RealScalar, x: State) -> Array | float:
        if self.final_cost is None:
            return super().final(t, x)
        return self.final_cost(t, x)


class Sum(AbstractCost):
    """The sum of several costs, `c_1(t, x, u) + ... + c_n(t, x, u)`, and of their final
    costs. `cost + other` makes it.

    **Arguments:** `*terms`: the costs, at least one.

    **Raises:** `ValueError` if no cost is given, or one is not an `AbstractCost`.

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp

        effort = dlx.costs.Function(lambda t, x, u: jnp.sum(jnp.abs(u)))
        cost = dlx.costs.Quadratic(jnp.eye(2), jnp.eye(1)) + 0.1 * effort
        cost(0.0, jnp.ones(2), jnp.ones(1))
        ```
    """

    terms: tuple[AbstractCost, ...]

    def __init__(self, *terms: AbstractCost):
        self.terms = terms

    def __check_init__(self):
        if not self.terms:
            raise ValueError("Sum: at least one cost must be given.")
        for term in self.terms:
            check_instance(term, AbstractCost, "every term", "Sum")

    def __call__(self, t: RealScalar, x: State, u: Control) -> Array:
        return functools.reduce(operator.add, (c(t, x, u) for c in self.terms))

    def final(self, t: RealScalar, x: State) -> Array:
        return functools.reduce(operator.add, (c.final(t, x) for c in self.terms))


class Scaled(AbstractCost):
    """A cost times a number, `factor c(t, x, u)`, and so its final cost.
    `factor * cost` makes it.

    **Arguments:**

    - `cost`: the cost.
    - `factor`: a number; it can be differentiated.

    **Raises:** `ValueError` if `cost` is not one, or `factor` is not a finite number.

    !!! example

        ```python
        import delucax as dlx

        doubled = 2 * dlx.costs.PendulumCost()
        ```
    """

    cost: AbstractCost
    factor: Real = parameter()

    def __check_init__(self):
        check_instance(self.cost, AbstractCost, "cost", "Scaled")
        check_number(self.factor, "factor", "Scaled")

    def __call__(self, t: RealScalar, x: State, u: Control) -> Array:
        return self.factor * self.cost(t, x, u)

    def final(self, t: RealScalar, x: State) -> Array:
        return self.factor * self.cost.final(t, x)


class Rate(AbstractCost):
    """A cost per second, charged for a step of `dt`: `c(t, x, u) dt`.

    The sum approximates the integral over time, so that weights need not change with
    `dt`. The final cost is unchanged.

    **Arguments:**

    - `cost`: the cost per second.
    - `dt`: the step.

    **Raises:** `ValueError` if `dt` is not positive.

    !!! example

        ```python
        import delucax as dlx

        cost = dlx.costs.Rate(dlx.costs.PendulumCost(), dt=0.05)
        ```
    """

    cost: AbstractCost
    dt: Real = parameter()

    def __check_init__(self):
        check_instance(self.cost, AbstractCost, "cost", "Rate")
        check_step(self.dt, "Rate")

    def __call__(self, t: RealScalar, x: State, u: Control) -> Array:
        return self.cost(t, x, u) * self.dt

    def final(self, t: RealScalar, x: State) -> Array:
        return self.cost.final(t, x)
