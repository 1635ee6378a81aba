"""Rewrite a problem with unknowns as a problem whose first state is partly free.

Unknown parameters and the duration become additional states, which stay constant.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from .._module import by_path, get_path, with_values
from .._results import Result
from .._typing import RealScalar
from ..costs import AbstractCost
from ..dynamics import AbstractDynamics
from ..qp import Soft
from ._constraints import Constraints, SoftConstraint
from ._problem import FreeStart, Problem
from ._start import Start
from ._unknowns import bounds_by_path, parts_of


class Carried(eqx.Module):
    """The additional states: values at paths in the parts of the problem, in units of
    their guesses."""

    parts: dict[str, Any]
    t0: Array
    low: Array
    high: Array
    guess: Array
    unit: Array
    paths: tuple[str, ...] = eqx.field(static=True)
    shapes: tuple[tuple[int, ...], ...] = eqx.field(static=True)
    size: int = eqx.field(static=True)
    """The number of states of the original problem, which come first."""

    def values(self, carried: Array) -> dict[str, Array]:
        """The values of the unknowns, by their paths."""
        shapes = dict(zip(self.paths, self.shapes, strict=True))
        return by_path(carried * self.unit, shapes)

    def opened(self, k: RealScalar, X: Array) -> tuple[dict[str, Any], Array, Array]:
        """The parts of the problem, the time and the original state at step `k`."""
        parts = with_values(self.parts, self.values(X[self.size :]))
        return parts, self.t0 + k * parts["dynamics"].dt, X[: self.size]


def carried_by(problem: Problem, horizon: int) -> Carried:
    """The additional states of a problem, with their bounds and guesses."""
    parts, named = parts_of(problem), bounds_by_path(problem, horizon)
    dtype, shapes = problem.x0.dtype, []
    columns = [jnp.zeros((3, 0), dtype)]
    for path, pair in named.items():
        value = get_path(parts, path)
        shapes.append(value.shape)
        fill = lambda a, v=value: jnp.broadcast_to(jnp.asarray(a, dtype), v.shape)
        columns.append(jnp.stack([jnp.ravel(fill(a)) for a in (*pair, value)]))
    low, high, guess = jnp.concatenate(columns, axis=1)
    # In units of the guess, so that no unknown is tiny compared with the states.
    width = high - low
    width = jnp.where(jnp.isfinite(width) & (width > 0), width, 1)
    unit = jax.lax.stop_gradient(jnp.where(guess == 0, width, jnp.abs(guess)))
    rest = low / unit, high / unit, jnp.clip(guess, low, high) / unit, unit
    size = problem.dynamics.state_size
    return Carried(parts, problem.t0, *rest, tuple(named), tuple(shapes), size)


class _Dynamics(AbstractDynamics):
    """The dynamics with the additional states. Their time is the number of steps."""

    carried: Carried
    dt: Array

    @property
    def _inside(self) -> AbstractDynamics:
        return self.carried.parts["dynamics"]

    @property
    def state_names(self) -> tuple[str, ...]:
        count = self.carried.guess.shape[0]
        more = (f"unknown[{i}]" for i in range(count))
        return (*self._inside.state_names, *more)

    @property
    def control_names(self) -> tuple[str, ...]:
        return self._inside.control_names

    @property
    def disturbance_size(self) -> int:
        return self._inside.disturbance_size

    def advance(
        self, t: RealScalar, x: Array, u: Array, w: Array | None
    ) -> tuple[Array, Result]:
        parts, t, own = self.carried.opened(t, x)
        after, result = parts["dynamics"].advance(t, own, u, w)
        return jnp.concatenate([after, x[self.carried.size :]]), result


class _Cost(AbstractCost):
    """The cost as a function of the additional states too."""

    carried: Carried

    def __call__(self, t: RealScalar, x: Array, u: Array) -> Any:
        parts, t, x = self.carried.opened(t, x)
        return parts["cost"](t, x, u)

    def final(self, t: RealScalar, x: Array) -> Any:
        parts, t, x = self.carried.opened(t, x)
        return parts["cost"].final(t, x)


class _Constraint(eqx.Module):
    """A constraint as a function of the additional states too."""

    carried: Carried
    field: str = eqx.field(static=True)
    name: str = eqx.field(static=True)

    def __call__(self, k: RealScalar, X: Array, *controls: Array) -> Any:
        parts, t, x = self.carried.opened(k, X)
        return parts["constraints"].named(self.field)[self.name](t, x, *controls)


class _Difference(eqx.Module):
    """The `difference` of states, and subtraction for the additional states."""

    carried: Carried
    function: Any

    def __call__(self, x: Array, x_ref: Array) -> Array:
        n = self.carried.size
        return jnp.concatenate([self.function(x[:n], x_ref[:n]), x[n:] - x_ref[n:]])


def _constraints(given: Constraints, carried: Carried) -> Constraints:
    """The constraints of the problem with the additional states."""
    fields: dict[str, Any] = dict(controls=given.controls)
    for field in ("inequality", "equality", "final_inequality", "final_equality"):
        wrapped = {}
        for name, function in given.named(field).items():
            wrapped[name] = _Constraint(carried, field, name)
            if isinstance(function, SoftConstraint):
                weights = function.linear, function.quadratic
                wrapped[name] = SoftConstraint(wrapped[name], *weights)
        fields[field] = wrapped or None
    value, count = given.states, carried.guess.shape[0]
    if value is not None:
        soft = isinstance(value, Soft)
        ends = (value.low, value.high) if soft else value
        wide = [
            _widened(a, carried.size, count, s * jnp.inf)
            for a, s in zip(ends, (-1, 1), strict=True)
        ]
        if soft:
            weights = value.linear, value.quadratic
            wide += [_widened(a, carried.size, count, 0.0) for a in weights]
        fields["states"] = Soft(*wide) if soft else tuple(wide)
    return Constraints(**fields)


def _widened(array: Any, size: int, count: int, fill: float) -> Array:
    """Extend bounds of the states by `count` entries, with the value `fill`."""
    array = jnp.asarray(array)
    if array.ndim == 0:
        array = jnp.broadcast_to(array, (size,))
    rest = jnp.full((*array.shape[:-1], count), fill, array.dtype)
    return jnp.concatenate([array, rest], axis=-1)


def with_carried(
    problem: Problem, start: Start, states: Array | None
) -> tuple[Problem, Start, Array | None, Carried]:
    """The problem with the unknowns as additional states, its start, its guess of the
    states, and the description of the additional states."""
    unknowns, dynamics = problem.unknowns, problem.dynamics
    assert unknowns is not None
    carried = carried_by(problem, start.horizon)
    n, dtype = carried.size, problem.x0.dtype
    names = dynamics.state_names
    ends = [jnp.asarray(pair, dtype) for pair in unknowns.start.values()]
    entries = [names.index(name) for name in unknowns.start]
    free = (*entries, *range(n, n + carried.guess.shape[0]))
    low, high = jnp.stack(ends, axis=1) if ends else jnp.zeros((2, 0), dtype)
    first = FreeStart(
        jnp.concatenate([low, carried.low]),
        jnp.concatenate([high, carried.high]),
        free,
    )
    x0 = jnp.concatenate([problem.x0, carried.guess])
    x0 = x0.at[np.array(free)].set(jnp.clip(x0[np.array(free)], first.low, first.high))
    also = lambda a: jnp.concatenate(
        [a, jnp.broadcast_to(carried.guess, (*a.shape[:-1], *carried.guess.shape))],
        axis=-1,
    )
    wide = problem.constraints and _constraints(problem.constraints, carried)
    own = problem.difference
    whole = Problem(
        _Dynamics(carried, jnp.ones((), dtype)),
        _Cost(carried),
        x0,
        jnp.zeros((), dtype),
        problem.w,
        problem.bounds,
        own and _Difference(carried, own),
        wide,
        free=first,
    )
    gains = start.gains
    if gains is not None:
        none = [(0, 0)] * (gains.ndim - 1)
        gains = jnp.pad(gains, (*none, (0, carried.guess.shape[0])))
    guess = start.states if start.states is None else also(start.states)
    wider = Start(start.controls, guess, gains, start.multipliers)
    return whole, wider, states if states is None else also(states), carried
