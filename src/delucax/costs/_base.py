"""The base class of costs, and costs made of functions or of other costs."""

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
    shown,
)
from .._typing import Control, Real, RealScalar, State
from ..systems import AbstractPlant


class AbstractCost(eqx.Module):
    r"""A cost: a stage cost $c(t, x, u)$ and a final cost.

    A cost is minus a reward. The stage cost is charged once per step, for the current
    state and the applied control. The final cost is charged once: at the last state, or
    at the state that terminates the episode.

    To define your own cost, subclass `AbstractCost` and write `__call__`, which returns
    the stage cost. Override `final` to add a final cost. Add two costs with `+`, and
    multiply a cost by a number with `*`.

    **Raises:** `ValueError` at construction if a [`delucax.parameter`][] is not finite
    or violates its constraint.

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp

        class Effort(dlx.AbstractCost):
            def __call__(self, t, x, u):
                return jnp.sum(u**2)

        Effort()(0.0, jnp.zeros(2), jnp.ones(1))
        ```

        ```text
        Array(1., dtype=float32)
        ```
    """

    __repr__ = shown

    def __check_init__(self):
        check_parameters(self)

    @property
    def targets(self) -> tuple[Array | None, Array | None] | None:
        """The targets `(x, u)` of the cost: the state and the control at which it is
        smallest. `x` or `u` is `None` if the cost has no target for it. For a cost
        without any fixed target, `targets` is a single `None`; this is the default.

        A cost made of other costs takes the first target that one of them has. Planners
        use the targets for their default initial plan; see
        [`delucax.planning.Start.default`][].
        """
        named = [part.targets for part in parts_of(self, AbstractCost)]
        pairs = [pair for pair in named if pair is not None]
        if not pairs:
            return None
        # The first term with a target decides, so that a penalty may be added to it.
        first = lambda values: next((a for a in values if a is not None), None)
        return first(x for x, _ in pairs), first(u for _, u in pairs)

    def set_point(self, plant: AbstractPlant) -> tuple[State, Control] | None:
        """The state and the control about which to regulate a plant.

        The set point is the `targets` of the cost if the cost has both a target state
        and a target control. Otherwise it is the equilibrium of the plant. If the plant
        defines no equilibrium either, it is the one target that the cost has, with
        zeros for the other one.

        **Arguments:** `plant`: a system or dynamics.

        **Returns:** `(x, u)`, shapes `(n,)` and `(m,)`; or `None` if the cost has no
        target and the plant no equilibrium, or if the sizes do not fit the plant.
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
        # None, not an error: the caller reports what it needs the point for.
        fits = x.shape == (plant.state_size,) and u.shape == (plant.control_size,)
        return (x, u) if fits else None

    # Without this, a NumPy number times a cost would not call `__rmul__`.
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

        **Arguments:** `t`: time, a scalar. `x`: state, shape `(n,)`. `u`: control that
            was applied, shape `(m,)`.

        **Returns:** a scalar.
        """

    def final(self, t: RealScalar, x: State) -> Array:
        """The final cost; 0 by default.

        **Arguments:** `t`: time, a scalar. `x`: the last state, shape `(n,)`.

        **Returns:** a scalar.
        """
        del t
        return jnp.zeros((), x.dtype)


class Function(AbstractCost):
    """A cost made of functions.

    **Arguments:**

    - `stage`: the stage cost, a function `(t, x, u) -> scalar`.
    - `final_cost`: the final cost, a function `(t, x) -> scalar`; zero by default.

    **Raises:** `ValueError` if `stage` or `final_cost` is not a function.

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp

        cost = dlx.costs.Function(lambda t, x, u: jnp.sum(x**2) + jnp.sum(u**2))
        cost(0.0, jnp.ones(2), jnp.zeros(1))
        ```

        ```text
        Array(2., dtype=float32)
        ```
    """

    stage: Callable[[RealScalar, Array, Array], Array] = function_field(of="t, x, u")
    final_cost: Callable[[RealScalar, Array], Array] | None = function_field(
        None, of="t, x"
    )

    def __call__(self, t: RealScalar, x: State, u: Control) -> Array | float:
        return self.stage(t, x, u)

    def final(self, t: RealScalar, x: State) -> Array | float:
        if self.final_cost is None:
            return super().final(t, x)
        return self.final_cost(t, x)


class Sum(AbstractCost):
    r"""The sum of several costs, $c_1(t, x, u) + \dots + c_n(t, x, u)$. Final costs are
    summed too. `cost + other` makes one.

    **Arguments:**

    - `*terms`: the costs, at least one.

    **Raises:** `ValueError` if no cost is given, or if an argument is not an
    `AbstractCost`.

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp

        effort = dlx.costs.Function(lambda t, x, u: jnp.sum(jnp.abs(u)))
        cost = dlx.costs.Quadratic(jnp.eye(2), jnp.eye(1)) + 0.1 * effort
        cost(0.0, jnp.ones(2), jnp.ones(1))
        ```

        ```text
        Array(3.1, dtype=float32)
        ```
    """

    terms: tuple[AbstractCost, ...]

    def __init__(self, *terms: AbstractCost):
        self.terms = terms

    def __check_init__(self):
        if not self.terms:
            raise ValueError("Sum: terms must be at least one cost, got none.")
        for term in self.terms:
            check_instance(term, AbstractCost, "every term", "Sum")

    def __call__(self, t: RealScalar, x: State, u: Control) -> Array:
        return functools.reduce(operator.add, (c(t, x, u) for c in self.terms))

    def final(self, t: RealScalar, x: State) -> Array:
        return functools.reduce(operator.add, (c.final(t, x) for c in self.terms))


class Scaled(AbstractCost):
    r"""A cost times a number, $a\, c(t, x, u)$. The final cost is scaled too.
    `factor * cost` makes one.

    **Arguments:**

    - `cost`: the cost, a [`delucax.AbstractCost`][].
    - `factor`: $a$, a number. You can differentiate with respect to `factor`.

    **Raises:** `ValueError` if `cost` is not a cost, or `factor` is not a finite
    number.

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp

        doubled = 2 * dlx.costs.PendulumCost()
        doubled(0.0, jnp.array([0.5, 0.0]), jnp.zeros(1))
        ```

        ```text
        Array(0.5, dtype=float32)
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
    r"""A cost per unit of time, multiplied by the time step: $c(t, x, u)\, \Delta t$.

    The sum over the steps approximates an integral over time, so you can change `dt`
    without changing the weights. The final cost is unchanged.

    **Arguments:**

    - `cost`: the cost per unit of time, a [`delucax.AbstractCost`][].
    - `dt`: the time step $\Delta t$, in units of time.

    **Raises:** `ValueError` if `cost` is not a cost, or `dt` is not positive.

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp

        cost = dlx.costs.Rate(dlx.costs.PendulumCost(), dt=0.05)
        cost(0.0, jnp.array([0.5, 0.0]), jnp.zeros(1))
        ```

        ```text
        Array(0.0125, dtype=float32)
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
