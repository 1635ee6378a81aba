"""Arguments of the finite-horizon problems: matrices with or without a time axis."""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from .._check import as_matrix, check_count, check_finite, is_concrete, symmetric_matrix
from .._message import shortened
from .._module import as_float_array


def in_time(
    where: str,
    horizon: Any,
    matrices: dict[str, tuple[Any, tuple[str, ...]]],
    sizes: dict[str, int] | None = None,
) -> tuple[dict[str, Array], int]:
    """Each argument with a leading time axis, in one precision; and the horizon.

    `matrices` holds `name: (value, axes)`, an axis being named by its size (`"n"`);
    the sizes are those of the first argument that has them. What is `None` is zero.
    """
    sizes = {} if sizes is None else dict(sizes)
    given, steps = {}, {}
    for name, (value, axes) in matrices.items():
        if value is None:
            continue
        array = as_float_array(value)
        ndim = len(axes)
        if not eqx.is_inexact_array(array) or array.ndim not in (ndim, ndim + 1):
            got = f"shape {array.shape}" if eqx.is_array(array) else shortened(value)
            shape = ", ".join(axes) + ("," if ndim == 1 else "")
            raise ValueError(
                f"{where}: {name} must have shape ({shape}), or that with a leading "
                f"time axis, got {got}."
            )
        check_finite(array, name, where)
        _check_sizes(where, name, array.shape[array.ndim - ndim :], axes, sizes)
        if array.ndim > ndim:
            steps[name] = array.shape[0]
        given[name] = array
    T = _length(where, horizon, steps)
    dtype = common_dtype(where, given)
    whole = {}
    for name, (_, axes) in matrices.items():
        shape = (T, *(sizes[axis] for axis in axes))
        array = given.get(name, jnp.zeros((), dtype))
        whole[name] = jnp.broadcast_to(array.astype(dtype), shape)
    return whole, T


def common_dtype(where: str, given: dict[str, Array]):
    """The real precision that all can be held in."""
    dtype = jnp.result_type(*given.values())
    if not jnp.issubdtype(dtype, jnp.floating):
        raise ValueError(f"{where}: {', '.join(given)} must be real, got {dtype}.")
    return dtype


def _check_sizes(where, name, shape, axes, sizes):
    for axis, size in zip(axes, shape, strict=True):
        sizes.setdefault(axis, size)
    wanted = tuple(sizes[axis] for axis in axes)
    if shape != wanted:
        raise ValueError(
            f"{where}: {name} must have shape {wanted} to fit the other arguments, "
            f"got {shape}."
        )
    if 0 in shape:
        raise ValueError(f"{where}: {name} must not be empty, got shape {shape}.")


def _length(where, horizon, steps):
    """The number of steps, on which all that have a time axis must agree."""
    if horizon is not None:
        horizon = check_count(horizon, "horizon", where)
    if len(set(steps.values())) > 1 or 0 in steps.values():
        raise ValueError(
            f"{where}: leading time axes must have one length of at least 1, got "
            f"{steps}."
        )
    if not steps:
        if horizon is None:
            raise ValueError(
                f"{where}: horizon must be given where no argument has a time axis."
            )
        return horizon
    name, T = next(iter(steps.items()))
    if horizon not in (None, T):
        raise ValueError(
            f"{where}: horizon must be the length of the time axis of {name} ({T}), "
            f"got {horizon}."
        )
    return T


def symmetric_stack(value: Any, name: str, where: str) -> Array:
    """`value` as a symmetric matrix, or a stack of them."""
    array = as_float_array(value)
    if not eqx.is_inexact_array(array) or array.ndim != 3:
        return symmetric_matrix(value, name, where)
    as_matrix(array, name, where, ndim=3)
    if array.shape[1] != array.shape[2]:
        raise ValueError(f"{where}: {name} must be square, got shape {array.shape}.")
    turned = jnp.swapaxes(array, 1, 2)
    if is_concrete(array):
        entries = np.asarray(array)
        scale = np.max(np.abs(entries), axis=(1, 2), initial=0.0)
        off = np.abs(entries - np.swapaxes(entries, 1, 2))
        slack = 100 * np.finfo(entries.dtype).eps * scale
        if np.any(np.max(off, axis=(1, 2), initial=0.0) > slack):
            raise ValueError(f"{where}: {name} must be symmetric at each step.")
    return (array + turned) / 2


def final_weight(value: Any, n: int, where: str, dtype: Any) -> Array:
    """The final weight, zero if none is given, or an error."""
    if value is None:
        return jnp.zeros((n, n), dtype)
    final = symmetric_matrix(value, "final", where)
    if final.shape != (n, n):
        raise ValueError(
            f"{where}: final must have shape {(n, n)} to fit A, got {final.shape}."
        )
    return final.astype(dtype)


def check_shapes(where: str, given: dict[str, Array]) -> None:
    """Raise unless the matrices fit each other."""
    n, m = given["A"].shape[0], given["B"].shape[1]
    shapes = {"A": (n, n), "B": (n, m), "Q": (n, n), "R": (m, m), "S": (n, m)}
    if "D" in given:
        shapes["D"] = (n, given["D"].shape[1])
    for name, matrix in given.items():
        if matrix.shape != shapes[name] or 0 in matrix.shape:
            raise ValueError(
                f"{where}: {name} must have shape {shapes[name]} to fit the other "
                f"matrices, got {matrix.shape}."
            )


def checked_times(times: Any, where: str) -> Array:
    """`times` as an increasing vector of at least two, or an error."""
    array = as_float_array(times)
    if not eqx.is_inexact_array(array) or array.ndim != 1 or array.shape[0] < 2:
        got = f"shape {array.shape}" if eqx.is_array(array) else shortened(times)
        raise ValueError(f"{where}: times must be at least two numbers, got {got}.")
    check_finite(array, "times", where)
    if is_concrete(array) and not np.all(np.diff(np.asarray(array)) > 0):
        raise ValueError(f"{where}: times must increase, got {array}.")
    return array
