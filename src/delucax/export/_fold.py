"""Constant folding with NumPy."""

from collections.abc import Callable
from typing import Any

import numpy as np


def _broadcast(x, *, shape, broadcast_dimensions, **_):
    full = [1] * len(shape)
    for axis, extent in zip(broadcast_dimensions, x.shape, strict=True):
        full[axis] = extent
    return np.broadcast_to(x.reshape(full), shape)


def _pad(x, fill, *, padding_config):
    # A negative margin removes entries.
    shape = [
        low + high + n + max(n - 1, 0) * inside
        for n, (low, high, inside) in zip(x.shape, padding_config, strict=True)
    ]
    out = np.full(shape, fill)
    kept, into = [], []
    for n, size, (low, _, inside) in zip(x.shape, shape, padding_config, strict=True):
        at = low + (inside + 1) * np.arange(n)
        within = (at >= 0) & (at < size)
        kept.append(np.flatnonzero(within))
        into.append(at[within])
    out[np.ix_(*into)] = x[np.ix_(*kept)]
    return out


def _slice(x, *, start_indices, limit_indices, strides):
    steps = strides or (1,) * x.ndim
    ranges = zip(start_indices, limit_indices, steps, strict=True)
    return x[tuple(slice(*r) for r in ranges)]


def _iota(*, dtype, shape, dimension, **_):
    along = np.arange(shape[dimension], dtype=dtype)
    return _broadcast(along, shape=shape, broadcast_dimensions=(dimension,))


def _split(x, *, sizes, axis):
    return np.split(x, np.cumsum(sizes)[:-1], axis)


def _unstack(x, *, axis):
    return list(np.moveaxis(x, axis, 0))


def _select(which, *cases):
    which = which.astype(int)
    if which.ndim == 0:
        return cases[int(which)]
    return np.choose(which, cases)


def _extreme(function, x, axes):
    if x.size:
        return function(x, axes)
    least = -np.inf if x.dtype.kind == "f" else np.iinfo(x.dtype).min
    most = np.inf if x.dtype.kind == "f" else np.iinfo(x.dtype).max
    return function(x, axes, initial=least if function is np.max else most)


def _converted(x, *, new_dtype, **_):
    # For NaN, and beyond the range of the integers, NumPy differs from XLA.
    is_cut = x.dtype.kind not in "iub" and np.dtype(new_dtype).kind in "iu"
    return None if is_cut else x.astype(new_dtype)


def _dynamic_slice(x, *starts, slice_sizes):
    at = [
        int(min(max(s, 0), n - k))
        for s, n, k in zip(starts, x.shape, slice_sizes, strict=True)
    ]
    ranges = zip(at, slice_sizes, strict=True)
    return x[tuple(slice(a, a + k) for a, k in ranges)]


FOLDS: dict[str, Callable[..., Any]] = {
    "abs": np.abs,
    "add": np.add,
    "add_any": np.add,
    "and": np.bitwise_and,
    "broadcast_in_dim": _broadcast,
    "concatenate": lambda *xs, dimension: np.concatenate(xs, dimension),
    "convert_element_type": _converted,
    "cos": np.cos,
    "dynamic_slice": _dynamic_slice,
    "eq": np.equal,
    "exp": lambda x, **_: np.exp(x),
    "ge": np.greater_equal,
    "gt": np.greater,
    "integer_pow": lambda x, *, y: x**y if y >= 0 else 1 / x**-y,
    "iota": _iota,
    "is_finite": np.isfinite,
    "le": np.less_equal,
    "lt": np.less,
    "max": np.maximum,
    "min": np.minimum,
    "mul": np.multiply,
    "ne": np.not_equal,
    "neg": np.negative,
    "not": np.invert,
    "or": np.bitwise_or,
    "pad": _pad,
    "reduce_and": lambda x, *, axes, **_: np.all(x, axes),
    "reduce_max": lambda x, *, axes, **_: _extreme(np.max, x, axes),
    "reduce_min": lambda x, *, axes, **_: _extreme(np.min, x, axes),
    "reduce_or": lambda x, *, axes, **_: np.any(x, axes),
    "reduce_sum": lambda x, *, axes, **_: np.sum(x, axes, x.dtype),
    "reshape": lambda x, *, new_sizes, **_: x.reshape(new_sizes),
    "rev": lambda x, *, dimensions: np.flip(x, dimensions),
    "select_n": lambda *xs, **_: _select(*xs),
    "sign": np.sign,
    "sin": np.sin,
    "slice": _slice,
    "split": _split,
    "sqrt": np.sqrt,
    "square": np.square,
    "squeeze": lambda x, *, dimensions: np.squeeze(x, tuple(dimensions)),
    "stack": lambda *xs, axis: np.stack(xs, axis),
    "sub": np.subtract,
    "tanh": np.tanh,
    "transpose": lambda x, *, permutation: np.transpose(x, permutation),
    "unstack": _unstack,
}


def folded(op: str, values: list[Any], params: Any, dtypes: list[Any]) -> Any:
    """The results of an operation on NumPy arrays, or `None` if NumPy does not compute
    them as XLA does."""
    if op not in FOLDS:
        return None
    with np.errstate(all="ignore"):
        function = FOLDS[op]
        is_plain = isinstance(function, np.ufunc)
        out = function(*values) if is_plain else function(*values, **params)
    if out is None:
        return None
    outs = out if isinstance(out, list) else [out]
    return [np.asarray(o, dtype) for o, dtype in zip(outs, dtypes, strict=True)]


def is_all(value: Any, number: int) -> bool:
    """Whether all entries of an array are equal to `number`."""
    return (
        value.dtype.kind in "iuf" and value.size > 0 and bool(np.all(value == number))
    )
