"""Evaluation of vector fields and other functions of time within a solve.

The shape of the returned value is checked. At late times the sum `t + s` is rounded,
and `TimeOffset` corrects for it.
"""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.lax as lax
import jax.numpy as jnp
from jaxtyping import Array

from .._jax import is_constant
from .._typing import RealScalar
from ..systems import AbstractSystem


def evaluate_field(system: AbstractSystem, t: Any, x: Array, u: Array, w: Any) -> Array:
    """The vector field of `system`, with a check of its shape."""
    dx = system.vector_field(t, x, u, w)
    check_returned(dx, x, system, "vector_field")
    return dx


def check_returned(value: Any, x: Array, system: AbstractSystem, method: str) -> None:
    """Raise unless a method of `system` returned an array shaped like the state."""
    shape = getattr(value, "shape", None)
    if shape == x.shape:
        return
    got = f"a {type(value).__name__}" if shape is None else shape
    listed = isinstance(value, tuple | list)
    hint = " Use jnp.stack to make an array of a list." if listed else ""
    raise ValueError(
        f"{type(system).__name__}: {method} must return an array of shape {x.shape}, "
        f"the shape of the state, got {got}.{hint}"
    )


class TimeOffset(eqx.Module):
    """The start time `t` of a solve that counts its own time `s` from 0. It evaluates a
    function of time `f` at `t + s`, corrected for rounding.

    The sum `t + s` is rounded, by up to 0.004 in float32 at a time of 1e5. The rounding
    error `e` can be computed, so `f` is evaluated as `f(t + s) + e f' + e^2 f'' / 2`.
    There is no correction if `f` is constant in time, is not twice
    forward-differentiable, or has derivatives that are not finite.

    Source: Knuth, 1969 (the error of a sum).
    """

    t: Array
    is_corrected: bool = eqx.field(static=True)

    def __init__(self, t: Array, function: Callable[[Array], Array] | None = None):
        self.t = t
        # Double precision needs no correction: it resolves a time of 1e9 to 1e-7.
        rounded = function is not None and _is_rounded(t.dtype)
        self.is_corrected = rounded and _varies(function, t)

    def evaluate(self, s: RealScalar, function: Callable[[Array], Array]) -> Array:
        """`function` at the time `s` after the start."""
        time = self.t + s
        # Callers pass a Python number only for the start, s = 0.
        if not self.is_corrected or not eqx.is_array(s) or not _is_rounded(time.dtype):
            return function(time)
        # Six additions give the error of a rounded sum exactly (TwoSum). It is held
        # constant, because the derivatives with respect to t and s go through `time`.
        t, s, total = lax.stop_gradient((self.t, s, time))
        part = total - t
        off = (t - (total - part)) + (s - part)
        value, change = _change(function, time, off)
        return value + jnp.where(jnp.isfinite(change), change, 0)


def _is_rounded(dtype: Any) -> bool:
    return jnp.finfo(dtype).bits < 64


def _change(function, time, off):
    """`function` at `time`, and its change from there to `time + off`, up to the second
    order, by forward over forward differentiation."""
    slope = lambda time: jax.jvp(function, (time,), (off,))
    (value, first), (_, second) = jax.jvp(slope, (time,), (off,))
    return value, first + second / 2


def _varies(function, t):
    """Whether `function` depends on time, with derivatives that can be computed.

    The derivatives are traced, not compiled. A function that is not differentiable
    raises one of many errors here. Any other error is raised again when the function is
    evaluated.
    """
    # If the function does not depend on time, its traced change is a constant. Values
    # would not tell, because a derivative may happen to be zero at this time.
    try:
        return not is_constant(lambda off: _change(function, t, off)[1], t)
    except Exception:
        return False
