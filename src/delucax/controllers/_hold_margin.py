"""The margin of a barrier condition for a control that is held over a step."""

import itertools
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from .._check import as_bounds, check_count, check_step, finite_vector
from .._jax import is_constant
from .._typing import Array
from ..systems import AbstractSystem
from ._barriers import Conditions


_MOST = 2_000_000
_AT_ONCE = 4096
_ROUNDS = 100
"""The most rounds in which the limits grow, as more cells of the grid come in."""
_FEW = 5
"""The rounds in which the limits shrink. The limits are valid after each of them."""


def hold_margin(
    conditions: Conditions,
    bounds: Any,
    dt: Any,
    states: Any,
    points: int,
    times: tuple[Any, Any] | None,
    where: str,
) -> Array:
    """Half of `dt` times the fastest fall of the change of each barrier.

    Only points from which the barrier may reach zero within a step count.
    """
    if not isinstance(conditions.plant, AbstractSystem):
        raise ValueError(
            f"{where}: plant must be in continuous time, an AbstractSystem, got "
            f"{type(conditions.plant).__name__}."
        )
    check_step(dt, where)
    check_count(points, "points", where, 3)
    n, m = conditions.plant.state_size, conditions.control_size
    if bounds is None or not all(np.all(np.isfinite(end)) for end in bounds):
        raise ValueError(
            f"{where}: bounds of the controls must be given and finite, got {bounds}."
        )
    if not isinstance(states, tuple | list) or len(states) != 2:
        raise ValueError(f"{where}: states must be a pair (low, high).")
    ends = [finite_vector(end, n, "states", where) for end in states]
    as_bounds(tuple(ends), where, "states", n)
    whole = lambda end, size: np.broadcast_to(np.asarray(end, float), (size,))
    controls = tuple(whole(end, m) for end in bounds)
    with jax.ensure_compile_time_eval():
        decay = np.asarray(conditions.last_decay)
        if not dt * np.max(decay) <= 1:
            raise ValueError(
                f"{where}: dt must be at most 1 / decay, got dt {dt} and decay "
                f"{np.max(decay)}."
            )
        box = tuple(whole(end, n) for end in ends)
        margins = _margins(conditions, float(dt), box, controls, times, points, where)
        return jnp.asarray(margins, conditions.decay.dtype)


def _margins(
    conditions: Conditions,
    dt: float,
    states: tuple[Any, ...],
    controls: tuple[Any, ...],
    times: tuple[Any, Any] | None,
    points: int,
    where: str,
) -> np.ndarray:
    dtype = jnp.result_type(float)
    x, u = (jnp.asarray((low + high) / 2, dtype) for low, high in (states, controls))
    zero = jnp.zeros((), dtype)
    varies = not is_constant(lambda t: conditions(t, x, u), zero)
    if varies and times is None:
        raise ValueError(
            f"{where}: times must be given, (start, end), because a barrier or the "
            "plant depends on time."
        )
    if times is not None:
        pair = np.asarray(times, float)
        if pair.shape != (2,) or not np.all(np.isfinite(pair)) or pair[0] > pair[1]:
            raise ValueError(
                f"{where}: times must be two finite numbers (start, end), got {times}."
            )
    span = np.linspace(*times, points) if varies and times is not None else np.zeros(1)
    axes = [span]
    for low, high in (states, controls):
        axes += [np.linspace(a, b, points) for a, b in zip(low, high, strict=True)]
    shape = tuple(len(axis) for axis in axes)
    if np.prod(shape, dtype=float) > _MOST:
        raise ValueError(
            f"{where}: points must give a grid of at most {_MOST} points, got "
            f"{' x '.join(map(str, shape))}. Choose fewer points."
        )
    flat = np.stack([a.ravel() for a in np.meshgrid(*axes, indexing="ij")], 1)
    # A rate is affine in the disturbance, so it is greatest at a corner.
    corners = np.zeros((1, 0))
    if conditions.disturbance is not None:
        size = conditions.plant.disturbance_size
        most = np.broadcast_to(np.asarray(conditions.disturbance), size)
        corners = np.array(list(itertools.product(*((-b, b) for b in most))))
    on_grid = _falls(conditions, jnp.asarray(flat, dtype), jnp.asarray(corners, dtype))
    fall, change, psi, holds = (
        np.asarray(a).reshape(*shape, *a.shape[1:]) for a in on_grid
    )
    safe = _in_cells(holds, np.logical_or)
    if not safe.any():
        raise ValueError(
            f"{where}: states must have a point at which all barriers hold, but they "
            "hold at no point of the grid."
        )
    rates = [
        _fastest(fall[..., j], change[..., j], psi[..., j], safe, decay, dt)
        for j, decay in enumerate(np.asarray(conditions.last_decay).tolist())
    ]
    if not np.all(np.isfinite(rates)):
        raise ValueError(
            f"{where}: states must be a box in which the derivatives of the conditions "
            "are finite at all points at which the barriers hold, but one is not."
        )
    return dt * np.array(rates) / 2


@eqx.filter_jit
def _falls(conditions: Conditions, flat: Array, corners: Array) -> Any:
    """The fall of the change of `psi`, the change, `psi`, and whether barriers hold.

    All are evaluated at the points `(t, x, u)`, the fall for each of the disturbances.
    """
    n = conditions.plant.state_size

    def at(z):
        t, x, u = z[0], z[1 : 1 + n], z[1 + n :]
        decay = conditions.last_decay.astype(x.dtype)
        changed = lambda t, x: conditions(t, x, u) - decay * conditions.last(t, x)
        change, push = jax.linearize(changed, t, x)

        def fall(w):
            w = (
                w
                if conditions.disturbance is not None
                else conditions.no_disturbance(x.dtype)
            )
            return -push(jnp.ones_like(t), conditions.flow(t, x, u, w))

        values, psi = conditions.values(t, x), conditions.last(t, x)
        return jax.vmap(fall)(corners), change, psi, jnp.all((values >= 0) & (psi >= 0))

    return lax.map(at, flat, batch_size=min(_AT_ONCE, len(flat)))


def _fastest(
    fall: np.ndarray,
    change: np.ndarray,
    psi: np.ndarray,
    safe: np.ndarray,
    decay: float,
    dt: float,
) -> float:
    """The fastest fall of the change of `psi`, on the way to `psi = 0` within a step.

    Go back in time from `psi = 0`: `psi` is at most `dt` times its own fastest fall,
    and its change is at most `dt` times the fall that is sought. Both limits are raised
    from zero until they are consistent. Go forward from the sample: the change is at
    least `-decay psi`, less the same amount. This lowers both limits, and they stay
    valid.
    """
    low, high = (_in_cells(change, join) for join in (np.minimum, np.maximum))
    near = _in_cells(psi, np.minimum)

    def measured(rate, reach, least):
        cells = safe & ~(near > reach) & ~(low > dt * rate) & ~(high < least)
        inside = _corners_of(cells, change.shape)
        return max(_highest(fall, inside), 0.0), dt * max(
            _highest(-change, inside), 0.0
        )

    rate = reach = 0.0
    for _ in range(_ROUNDS):
        now = measured(rate, reach, -np.inf)
        if not (now[0] > rate or now[1] > reach):
            break
        rate, reach = max(now[0], rate), max(now[1], reach)
    else:
        rate, reach = measured(np.inf, np.inf, -np.inf)
    now = rate, reach
    for _ in range(_FEW):
        now = measured(rate, reach, -decay * reach - dt * rate)
        rate, reach = min(now[0], rate), min(now[1], reach)
    # `max` and `min` may drop a NaN.
    return rate if np.all(np.isfinite(now)) else np.nan


def _in_cells(values: np.ndarray, join: Any) -> np.ndarray:
    """The values at the corners of each cell of a grid, joined."""
    for axis in range(values.ndim):
        if values.shape[axis] > 1:
            ends = np.moveaxis(values, axis, 0)
            values = np.moveaxis(join(ends[1:], ends[:-1]), 0, axis)
    return values


def _corners_of(cells: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """The points that are corners of some of the cells."""
    for axis, length in enumerate(shape):
        if length > 1:
            cells = np.moveaxis(cells, axis, 0)
            empty = np.zeros((1, *cells.shape[1:]), bool)
            either = np.concatenate([cells, empty]) | np.concatenate([empty, cells])
            cells = np.moveaxis(either, 0, axis)
    return cells


def _highest(fall: np.ndarray, inside: np.ndarray) -> float:
    """The largest value of a smooth function that is known at the points of a grid.

    Along each axis, a function exceeds the larger of two neighbours by at most an
    eighth of the second difference.
    """
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
