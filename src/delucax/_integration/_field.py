"""Vector fields and other functions of time, as a solve evaluates them.

The shape of what a field returns is checked. At late times the sum `t + s` is rounded,
which is corrected.
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
    """The vector field of `system`, with its shape checked."""
    dx = system.vector_field(t, x, u, w)
    check_returned(dx, x, system, "vector_field")
    return dx


def check_returned(value: Any, x: Array, system: AbstractSystem, method: str) -> None:
    """Raise unless what a method of `system` returned has the shape of the state."""
    shape = getattr(value, "shape", None)
    if shape == x.shape:
        return
    got = f"a {type(value).__name__}" if shape is None else shape
    listed = isinstance(value, tuple | list)
    hint = " (jnp.stack makes an array of a list)" if listed else ""
    raise ValueError(
        f"{type(system).__name__}: {method} must return an array of shape {x.shape}, "
        f"as the state has, got {got}{hint}."
    )


class TimeOffset(eqx.Module):
    """The start `t` of a solve that counts its own time `s` from 0, for one function of
    time `f`.

    The sum `t + s` is rounded, and its rounding error `e` is known (in float32, at 1e5,
    it is up to 0.004): `f` is evaluated as `f(t + s) + e f' + e^2 f'' / 2`. A function
    that is constant in time, not twice forward-differentiable, or without finite
    derivatives is evaluated without correction.

    Source: Knuth, 1969 (the error of a sum).
    """

    t: Array
    is_corrected: bool = eqx.field(static=True)

    def __init__(self, t: Array, function: Callable[[Array], Array] | None = None):
        self.t = t
        # In double precision a time of 1e9 is still known to 1e-7.
        rounded = function is not None and _is_rounded(t.dtype)
        self.is_corrected = rounded and _varies(function, t)

    def evaluate(self, s: RealScalar, function: Callable[[Array], Array]) -> Array:
        """`function` at the time `s` after the start."""
        time = self.t + s
        # An s that is a Python number is 0: the start itself.
        if not self.is_corrected or not eqx.is_array(s) or not _is_rounded(time.dtype):
            return function(time)
        # The error of a rounded sum is a number itself, found exactly by six additions
        # (TwoSum). It is a constant: the derivative with respect to t and s is that of
        # `time`, in which both stand.
        t, s, total = lax.stop_gradient((self.t, s, time))
        part = total - t
        off = (t - (total - part)) + (s - part)
        value, change = _change(function, time, off)
        return value + jnp.where(jnp.isfinite(change), change, 0)


def _is_rounded(dtype: Any) -> bool:
    return jnp.finfo(dtype).bits < 64


def _change(function, time, off):
    """`function` at `time`, and by how much it is another at `time + off`: the terms of
    first and second order, by a derivative along `off` of a derivative along it."""
    slope = lambda time: jax.jvp(function, (time,), (off,))
    (value, first), (_, second) = jax.jvp(slope, (time,), (off,))
    return value, first + second / 2


def _varies(function, t):
    """Whether `function` has derivatives with respect to time that are not all zero.

    They are traced, not compiled. A function that is not differentiable raises one of
    many errors here; any other error of it is raised again when it is evaluated.
    """
    # A derivative of zero is a constant of the program. (Values cannot tell, because a
    # derivative may be zero at this time alone.)
    try:
        return not is_constant(lambda off: _change(function, t, off)[1], t)
    except Exception:
        return False
