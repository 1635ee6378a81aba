"""The margin that covers a control held over a step."""

import itertools
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from .._jax import is_constant
from .._typing import Array
from ._barriers import Conditions


_MOST = 2_000_000
_AT_ONCE = 4096
_ROUNDS = 200
"""In which the margin grows; each takes in more cells of the grid, or is the last."""


def hold_margin(
    conditions: Conditions,
    dt: float,
    states: tuple[Any, Any],
    controls: tuple[Any, Any],
    times: tuple[Any, Any] | None,
    points: int,
    where: str,
) -> np.ndarray:
    """The least margin of each condition that is `dt` times its fastest fall between
    that margin and zero."""
    dtype = jnp.result_type(float)
    x, u = (jnp.asarray((low + high) / 2, dtype) for low, high in (states, controls))
    zero = jnp.zeros((), dtype)
    varies = not is_constant(lambda t: conditions(t, x, u), zero)
    if varies and times is None:
        raise ValueError(
            f"{where}: times must be given, (start, end), where a barrier or the plant "
            "depends on time."
        )
    span = np.linspace(*times, points) if varies and times is not None else np.zeros(1)
    axes = [span]
    for low, high in (states, controls):
        axes += [np.linspace(a, b, points) for a, b in zip(low, high, strict=True)]
    shape = tuple(len(axis) for axis in axes)
    if np.prod(shape, dtype=float) > _MOST:
        raise ValueError(
            f"{where}: points must give a grid of at most {_MOST} points, got "
            f"{' x '.join(map(str, shape))}: take fewer."
        )
    flat = np.stack([a.ravel() for a in np.meshgrid(*axes, indexing="ij")], 1)
    # A rate is affine in the disturbance, and greatest at a corner.
    corners = np.zeros((1, 0))
    if conditions.disturbance is not None:
        size = conditions.plant.disturbance_size
        most = np.broadcast_to(np.asarray(conditions.disturbance), size)
        corners = np.array(list(itertools.product(*((-b, b) for b in most))))
    found = _falls(conditions, jnp.asarray(flat, dtype), jnp.asarray(corners, dtype))
    fall, c, holds = (np.asarray(a).reshape(*shape, *a.shape[1:]) for a in found)
    safe = _in_cells(holds & np.all(c >= 0, -1), np.logical_or)
    if not safe.any():
        raise ValueError(f"{where}: states must hold a point at which barriers hold.")
    each = [_least(fall[..., j], c[..., j], safe, dt) for j in range(c.shape[-1])]
    if not np.all(np.isfinite(each)):
        raise ValueError(
            f"{where}: states must be a box in which the conditions have derivatives "
            "wherever the barriers hold; one is not finite there."
        )
    return np.array(each)


@eqx.filter_jit
def _falls(conditions: Conditions, flat: Array, corners: Array) -> Any:
    """How fast each condition falls at points of time, state and control, for each of
    the disturbances; the conditions; and whether the barriers hold."""
    n = conditions.plant.state_size
    second = np.array(conditions.degrees) == 2

    def at(z):
        t, x, u = z[0], z[1 : 1 + n], z[1 + n :]
        value, push = jax.linearize(lambda t, x: conditions(t, x, u), t, x)

        def fall(w):
            w = w if conditions.disturbance is not None else conditions.calm(x.dtype)
            return -push(jnp.ones_like(t), conditions.flow(t, x, u, w))

        holds = conditions.values(t, x) >= 0
        if second.any():
            holds = holds & (~second | (conditions.first(t, x) >= 0))
        return jax.vmap(fall)(corners), value, jnp.all(holds)

    return lax.map(at, flat, batch_size=min(_AT_ONCE, len(flat)))


def _least(fall: np.ndarray, c: np.ndarray, safe: np.ndarray, dt: float) -> float:
    """The margin of one condition, from zero up."""
    lowest, margin = _in_cells(c, np.minimum), 0.0
    for _ in range(_ROUNDS):
        met = _corners_of(safe & ~(lowest > margin), c.shape)
        needed = dt * max(_highest(fall, met), 0.0)
        if not needed > margin:
            return needed if np.isnan(needed) else margin
        margin = needed
    return dt * max(_highest(fall, _corners_of(safe, c.shape)), 0.0)


def _in_cells(values: np.ndarray, join: Any) -> np.ndarray:
    """What the corners of each cell of a grid have together."""
    for axis in range(values.ndim):
        if values.shape[axis] > 1:
            ends = np.moveaxis(values, axis, 0)
            values = np.moveaxis(join(ends[1:], ends[:-1]), 0, axis)
    return values


def _corners_of(cells: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """The points that are corners of some cells."""
    for axis, length in enumerate(shape):
        if length > 1:
            cells = np.moveaxis(cells, axis, 0)
            empty = np.zeros((1, *cells.shape[1:]), bool)
            either = np.concatenate([cells, empty]) | np.concatenate([empty, cells])
            cells = np.moveaxis(either, 0, axis)
    return cells


def _highest(fall: np.ndarray, inside: np.ndarray) -> float:
    """The largest value of a smooth function that is known on a grid: between points it
    exceeds the larger by at most an eighth of the square of the step times the second
    derivative, along each axis."""
    if not inside.any():
        return 0.0
    most = np.max(fall[inside])
    for axis in range(inside.ndim):
        if inside.shape[axis] < 3:
            continue
        f, known = np.moveaxis(fall, axis, 0), np.moveaxis(inside, axis, 0)
        known = known[2:] & known[1:-1] & known[:-2]
        if known.any():
            bent = f[2:][known] - 2 * f[1:-1][known] + f[:-2][known]
            most = most + np.max(np.abs(bent)) / 8
    return float(most)
