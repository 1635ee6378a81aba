"""Checks of arguments, with errors that name the argument and what was expected."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array

from ._fields import as_float_array


def is_concrete(x: Any) -> bool:
    """Whether the value of `x` can be looked at now (it is not being traced)."""
    return not isinstance(x, Tracer)


def check_key(key: Any, where: str) -> None:
    """Raise unless `key` is one random key."""
    if eqx.is_array(key):
        if jnp.issubdtype(key.dtype, jax.dtypes.prng_key) and key.shape == ():
            return
        if key.dtype == jnp.uint32 and key.shape == (2,):
            return
        got = f"an array of shape {key.shape} and dtype {key.dtype}"
    else:
        got = repr(key)
    raise ValueError(
        f"{where}: key must be one random key such as jax.random.key(0), got {got}."
    )


def as_vector(value: Any, size: int, name: str, where: str) -> Array:
    """`value` as a floating-point vector of `size` entries, or an error."""
    array = as_float_array(value)
    if not eqx.is_inexact_array(array) or array.shape != (size,):
        got = f"shape {array.shape}" if eqx.is_array(array) else repr(value)
        raise ValueError(f"{where}: {name} must have shape ({size},), got {got}.")
    return array


def as_matrix(value: Any, name: str, where: str, *, ndim: int = 2) -> Array:
    """`value` as a floating-point array of `ndim` axes with finite entries."""
    array = as_float_array(value)
    if not eqx.is_inexact_array(array) or array.ndim != ndim:
        got = f"shape {array.shape}" if eqx.is_array(array) else repr(value)
        raise ValueError(f"{where}: {name} must be a matrix, got {got}.")
    check_finite(array, name, where)
    return array


def symmetric_matrix(value: Any, name: str, where: str) -> Array:
    """`value` as a symmetric matrix of finite entries, or an error.

    An asymmetry of the size of rounding is averaged away.
    """
    matrix = as_matrix(value, name, where)
    if matrix.shape[0] != matrix.shape[1]:
        raise ValueError(f"{where}: {name} must be square, got shape {matrix.shape}.")
    if is_concrete(matrix):
        array = np.asarray(matrix)
        scale = np.max(np.abs(array), initial=0.0)
        slack = 100 * np.finfo(array.dtype).eps * scale
        if np.max(np.abs(array - array.T), initial=0.0) > slack:
            raise ValueError(f"{where}: {name} must be symmetric, got {array}.")
    return (matrix + matrix.T) / 2


def as_bounds(value: Any, where: str) -> tuple[Array, Array] | None:
    """`value` as `(low, high)`, each a number or a vector, or an error."""
    if value is None:
        return None
    if not isinstance(value, tuple | list) or len(value) != 2:
        raise ValueError(f"{where}: bounds must be a pair (low, high), got {value!r}.")
    low, high = (as_float_array(end) for end in value)
    fit = all(eqx.is_inexact_array(end) and end.ndim <= 1 for end in (low, high))
    if not fit or low.ndim == high.ndim == 1 and low.shape != high.shape:
        raise ValueError(
            f"{where}: bounds must be numbers or vectors of one size, got {value!r}."
        )
    if is_concrete(low) and is_concrete(high):
        if not np.all(np.asarray(low) <= np.asarray(high)):
            raise ValueError(
                f"{where}: bounds must have low <= high, got {low} and {high}."
            )
    return low, high


def check_finite(array: Any, name: str, where: str) -> None:
    """Raise if a concrete `array` holds NaN or infinity."""
    if eqx.is_inexact_array(array) and is_concrete(array):
        if not np.all(np.isfinite(np.asarray(array))):
            raise ValueError(f"{where}: {name} must be finite, got {array}.")


def check_positive(value: Any, name: str, where: str) -> None:
    """Raise unless a concrete number is finite and above zero."""
    if not is_concrete(value):
        return
    array = np.asarray(value)
    if not (np.all(np.isfinite(array)) and np.all(array > 0)):
        raise ValueError(f"{where}: {name} must be positive and finite, got {value}.")


def check_count(value: Any, name: str, where: str) -> int:
    """`value` as an int of at least 1."""
    if isinstance(value, bool) or not isinstance(value, int | np.integer) or value < 1:
        raise ValueError(
            f"{where}: {name} must be a whole number of at least 1, got {value!r}."
        )
    return int(value)
