"""Arguments that every planner takes, checked."""

import numbers
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array

from .._check import as_bounds, as_vector, check_count, check_finite, check_instance
from .._message import shortened
from .._module import as_float_array, as_module
from ..costs import AbstractCost
from ..dynamics import AbstractDynamics
from ._constraints import Constraints
from ._plan import Plan
from ._problem import Problem
from ._start import as_start, control_at_rest, controls_of, default_start, Start


def as_problem(
    dynamics: Any,
    cost: Any,
    x0: Any,
    controls: Any,
    t0: Any,
    w: Any,
    bounds: Any,
    difference: Any,
    constraints: Any,
    where: str,
) -> tuple[Problem, Start]:
    """The problem, and what to start from, or an error."""
    check_instance(dynamics, AbstractDynamics, "dynamics", where)
    check_instance(cost, AbstractCost, "cost", where)
    m = dynamics.control_size
    x0 = as_vector(x0, dynamics.state_size, "x0", where)
    check_finite(x0, "x0", where)
    t0 = as_float_array(t0)
    if not eqx.is_inexact_array(t0) or t0.shape != ():
        raise ValueError(f"{where}: t0 must be a number, got {shortened(t0)}.")
    check_finite(t0, "t0", where)
    if isinstance(controls, Plan):
        controls = Start(controls.controls, controls.states, controls.gains)
    dtype = x0.dtype
    if isinstance(controls, Start):
        start = as_start(controls, dynamics.state_size, m, "controls", where)
    elif isinstance(controls, numbers.Integral):
        T = check_count(controls, "controls (the horizon)", where)
        start = default_start(dynamics, cost, T, t0)
    else:
        start = Start(as_sequence(controls, None, m, "controls", where))
    if not isinstance(controls, numbers.Integral):
        dtype = jnp.result_type(x0, start.controls)
    T = controls_of(start).shape[0]
    if w is not None:
        w = as_sequence(w, T, dynamics.disturbance_size, "w", where)
    if difference is not None and not callable(difference):
        raise ValueError(f"{where}: difference must be a function, got {difference!r}.")
    if constraints is not None and not isinstance(constraints, Constraints):
        raise ValueError(
            f"{where}: constraints must be delucax.planning.Constraints, got "
            f"{type(constraints).__name__}."
        )
    low = high = None
    ends = as_bounds(bounds, where)
    if ends is not None:
        for end in ends:
            if end.shape not in ((), (m,)):
                raise ValueError(
                    f"{where}: bounds must be numbers or vectors of {m} entries, one "
                    f"for each control, got shape {end.shape}."
                )
        low, high = (jnp.broadcast_to(end, (m,)).astype(dtype) for end in ends)
    problem = Problem(
        dynamics,
        cost,
        x0.astype(dtype),
        t0.astype(dtype),
        w,
        low,
        high,
        as_module(difference),
        constraints,
    )
    return problem, jax.tree.map(lambda a: a.astype(dtype), start)


def at_rest(dynamics: Any, cost: Any, controls: Any, where: str) -> Any:
    """The controls for states that are given: those at rest for a number of steps."""
    if isinstance(controls, Start | Plan):
        raise ValueError(
            f"{where}: states go with an array of controls or a number of steps, got "
            f"{type(controls).__name__}."
        )
    if not isinstance(controls, numbers.Integral):
        return controls
    T = check_count(controls, "controls (the horizon)", where)
    return jnp.tile(control_at_rest(dynamics, cost), (T, 1))


def as_sequence(
    value: Any, steps: int | None, size: int, name: str, where: str
) -> Array:
    """`value` as a finite array of `steps` rows of `size` entries, or an error."""
    array = as_float_array(value)
    fits = eqx.is_inexact_array(array) and array.ndim == 2 and array.shape[1] == size
    if not fits or steps is not None and array.shape[0] != steps:
        got = f"shape {array.shape}" if eqx.is_array(array) else shortened(value)
        rows = "steps" if steps is None else steps
        raise ValueError(
            f"{where}: {name} must have shape ({rows}, {size}), got {got}."
        )
    if array.shape[0] == 0:
        raise ValueError(f"{where}: {name} must have at least one step, got horizon 0.")
    check_finite(array, name, where)
    return array
