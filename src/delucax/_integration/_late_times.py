"""Functions of time at a short time after a late one."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.lax as lax
import jax.numpy as jnp
from jaxtyping import Array

from .._typing import RealScalar


class Start(eqx.Module):
    """The time at which a solve's own begins, for one function of time.

    The sum `t + s` is rounded, and its rounding error `e` is known: a function `f` of
    time is `f(t + s) + e f' + e^2 f'' / 2`. That is for functions that vary with time
    (in float32, at 1e5, `e` is up to 0.004); any other is evaluated as it is, and so is
    one that has no two derivatives forwards, or none that is finite.

    Source: Knuth, 1969 (the error of a sum).
    """

    t: Array
    is_corrected: bool = eqx.field(static=True)

    def __init__(self, t: Array, function: Callable[[Array], Array] | None = None):
        self.t = t
        rounded = function is not None and _is_rounded(t.dtype)
        self.is_corrected = rounded and _varies(function, t)

    def after(self, s: RealScalar, function: Callable[[Array], Array]) -> Array:
        """`function` at `s` after the start."""
        time = self.t + s
        # An s that is a Python number is 0: the start itself.
        if not self.is_corrected or not eqx.is_array(s) or not _is_rounded(time.dtype):
            return function(time)
        t, s, total = lax.stop_gradient((self.t, s, time))
        part = total - t
        off = (t - (total - part)) + (s - part)
        value, change = _change(function, time, off)
        return value + jnp.where(jnp.isfinite(change), change, 0)


def _is_rounded(dtype: Any) -> bool:
    return jnp.finfo(dtype).bits < 64


def _change(function, time, off):
    """`function` at `time`, and by how much it is another at `time + off`."""

    def slope(time):
        return jax.jvp(function, (time,), (off,))

    (value, first), (_, second) = jax.jvp(slope, (time,), (off,))
    return value, first + second / 2


def _varies(function, t):
    """Whether `function` has derivatives with respect to time that are not all zero.

    They are traced and not compiled. A function without them raises one of many errors;
    what is wrong with the function itself raises when it is evaluated.
    """
    try:
        traced = jax.make_jaxpr(lambda t, off: _change(function, t, off)[1])(t, t)
    except Exception:
        return False
    reached = {id(traced.jaxpr.invars[1])}
    for equation in traced.jaxpr.eqns:
        if any(id(v) in reached for v in equation.invars):
            reached.update(map(id, equation.outvars))
    return any(id(v) in reached for v in traced.jaxpr.outvars)
