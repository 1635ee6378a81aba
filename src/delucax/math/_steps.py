"""Times as steps of a grid.

A time `k dt` is rounded, and so is the time that it is compared with. Times are
therefore compared by their numbers of steps, which are whole numbers if the times are
meant to be equal.
"""

from typing import Any, NamedTuple, TypeVar

import jax
import jax.lax as lax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from .._check import is_concrete
from .._host import host_unless_traced, xp
from .._typing import Vector


_T = TypeVar("_T")


def most_steps(dtype: Any) -> int:
    """The number of steps that times of this precision resolve: 2^22 in float32."""
    return 2 ** (jnp.finfo(dtype).nmant - 1)


def check_steps(count: int, dtype: Any, what: str, where: str) -> None:
    """Raise if times of this precision do not resolve `count` steps."""
    most = most_steps(dtype)
    if count > most:
        name = jnp.dtype(dtype).name
        raise ValueError(
            f"{where}: {what} must have at most {most} steps, because {name} cannot "
            f"tell the times of more steps apart, got {count}. Use double precision "
            "(JAX_ENABLE_X64=1) or a shorter horizon."
        )


def step_at(t: Any, dt: Any, count: int, where: str) -> Array:
    """The step to which time `t` belongs, `round(t / dt)`, in a horizon of `count`.

    A NaN time gives step -1, before the first.
    """
    steps = t / dt
    check_steps(count, jnp.result_type(steps), "the horizon", where)
    return jnp.where(jnp.isnan(steps), -1, jnp.round(steps)).astype(int)


def row_at(tree: _T, k: Array) -> _T:
    """Row `k` of each array; NaN before the first row and after the last."""
    row = lambda a: a.at[k].get(mode="fill", wrap_negative_indices=False)
    return jax.tree.map(row, tree)


class Position(NamedTuple):
    """A time in steps: the nearest whole number, and the distance from it."""

    whole: Array
    off: Array


def position(t: Any, dt: Any, origin: Any, eps: float) -> Position:
    """The position of `t` in steps of `dt` from `origin`.

    It counts as on a step if a rounding by `eps` of the times and of `dt` explains its
    distance from the step. The quotient is computed in two parts, because its own
    rounding would be as large as those.
    """
    t, dt, origin = (lax.stop_gradient(jnp.asarray(a)) for a in (t, dt, origin))
    dtype = jnp.result_type(t, dt, origin)
    t, dt, origin = (a.astype(dtype) for a in (t, dt, origin))
    info, since = jnp.finfo(dtype), t - origin
    # The coarse quotient is a whole number. Its product with each part of dt is exact.
    coarse = lax.reduce_precision(since / dt, info.nexp, info.nmant // 2 - 1)
    coarse = jnp.round(coarse)
    high = lax.reduce_precision(dt, info.nexp, (info.nmant + 1) // 2)
    fine = (since - coarse * high - coarse * (dt - high)) / dt
    nearest = jnp.round(fine)
    size = (jnp.abs(t) + jnp.abs(origin)) / dt + 1
    on_step = jnp.abs(fine - nearest) <= jnp.minimum(2 * eps * size, 0.5)
    return Position(coarse + nearest, jnp.where(on_step, 0, fine - nearest))


def coarsest(*arrays: Array) -> float:
    """The relative rounding of the least precise array."""
    return max(float(jnp.finfo(a.dtype).eps) for a in arrays)


@host_unless_traced
def step_between(times: Vector, where: str) -> Any:
    """The step of a grid of times; `None` for a single time.

    It is the first step. If the grid does not start at 0 it is the average step,
    because the difference of two late times is rounded. If the precision of the times
    is too coarse for the steps, it is NaN, or an error if the times are concrete.
    """
    check_steps(times.shape[0], times.dtype, "the horizon", where)
    if times.shape[0] == 1:
        return None
    # The average spreads the rounding of late times over all steps.
    average = (times[-1] - times[0]) / (times.shape[0] - 1)
    dt = xp.where(times[0] == 0, times[1], average)
    last = xp.maximum(xp.abs(times[0]), xp.abs(times[-1]))
    apart = last <= most_steps(times.dtype) * dt
    if is_concrete(apart) and not np.all(apart):
        raise ValueError(
            f"{where}: times in {times.dtype.name} are too coarse for steps of "
            f"{dt:.3g} at {last:.6g}. Use double precision (JAX_ENABLE_X64=1), or "
            "times from 0."
        )
    return xp.where(apart, dt, xp.nan)


def reached(times: Array, mark: Array, dt: Any) -> Array:
    """Which of `times`, a grid with step `dt`, are at `mark` or later."""
    if dt is None:
        return times >= mark
    eps = coarsest(times, mark)
    at_time, at_mark = (position(t, dt, times[0], eps) for t in (times, mark))
    return (at_time.whole - at_mark.whole) + (at_time.off - at_mark.off) >= 0
