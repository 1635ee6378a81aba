"""One code for two array libraries: NumPy if nothing is traced, JAX otherwise.

A design, such as a Riccati equation, is solved once. Compiling it would take a thousand
times as long as solving it. Code that is written with `xp`, `lax` and the loops below
runs on NumPy if all its arguments are concrete arrays, and with JAX under `jax.jit`,
`jax.vmap` and `jax.grad`.

Such code must avoid two differences. NumPy changes an array in place where JAX makes a
new one, so write `a = a + b`, not `a += b`. And NumPy's `where` of two Python numbers
makes an array in double precision.
"""

import functools
from collections.abc import Callable
from contextvars import ContextVar
from typing import Any, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer


_ON_HOST: ContextVar[bool] = ContextVar("delucax_on_host", default=False)

_F = TypeVar("_F", bound=Callable[..., Any])
_C = TypeVar("_C")

_OF_NUMPY = np.ndarray | np.generic


def on_host() -> bool:
    """Whether code runs on NumPy now."""
    return _ON_HOST.get()


def host_unless_traced(function: _F) -> _F:
    """Run a function on NumPy if none of its arguments is traced.

    It then gets NumPy arrays. Its results are JAX arrays in any case.
    """

    @functools.wraps(function)
    def wrapper(*args, **kwargs):
        leaves, structure = jax.tree.flatten((args, kwargs))
        if _ON_HOST.get() or any(isinstance(leaf, Tracer) for leaf in leaves):
            return function(*args, **kwargs)
        args, kwargs = jax.tree.unflatten(structure, map(_to_host, leaves))
        token = _ON_HOST.set(True)
        try:
            # As in JAX, an overflow gives infinity and an invalid operation NaN.
            with np.errstate(all="ignore"):
                value = function(*args, **kwargs)
        finally:
            _ON_HOST.reset(token)
        return _to_device(value)

    return wrapper  # pyright: ignore[reportReturnType]


def _to_host(leaf: Any) -> Any:
    return np.asarray(leaf) if isinstance(leaf, jax.Array) else leaf


def _to_device(tree: Any) -> Any:
    """The tree, with JAX arrays in place of NumPy arrays."""
    arrays, others = eqx.partition(tree, lambda x: isinstance(x, _OF_NUMPY))
    # Not by `jnp.asarray`, which compiles a program for each shape. Copies, because JAX
    # may share the memory of an array that the user changes later.
    copies = jax.tree.map(lambda leaf: leaf.copy(), arrays)
    return eqx.combine(jax.device_put(copies), others)


def compiled_unless_on_host(function: _F) -> _F:
    """`eqx.filter_jit`, or the function itself on NumPy."""
    compiled = eqx.filter_jit(function)

    @functools.wraps(function)
    def wrapper(*args, **kwargs):
        return (function if _ON_HOST.get() else compiled)(*args, **kwargs)

    return wrapper  # pyright: ignore[reportReturnType]


class custom_jvp(jax.custom_jvp):
    """`jax.custom_jvp`, or the function itself on NumPy."""

    def __call__(self, *args: Any) -> Any:
        return self.fun(*args) if _ON_HOST.get() else super().__call__(*args)


class _Operations:
    """Operations of `jax.lax` on NumPy arrays."""

    max = staticmethod(np.maximum)

    @staticmethod
    def reduce_precision(x: Any, exponent_bits: int, mantissa_bits: int) -> Any:
        """`x`, rounded to `mantissa_bits` bits of the mantissa."""
        del exponent_bits
        # The unit of the last bit that is kept, a power of two, which divides exactly.
        unit = np.ldexp(x.dtype.type(1), np.frexp(x)[1] - 1 - mantissa_bits)
        return np.where(np.isfinite(x), np.rint(x / unit) * unit, x)

    @staticmethod
    def cummin(x: Any, *, reverse: bool = False) -> Any:
        """The running minimum along the first axis."""
        step = -1 if reverse else 1
        return np.minimum.accumulate(x[::step])[::step]

    @staticmethod
    def cummax(x: Any, axis: int) -> Any:
        """The running maximum."""
        return np.maximum.accumulate(x, axis)

    @staticmethod
    def custom_linear_solve(matvec: Any, b: Any, solve: Any, **_: Any) -> Any:
        """The solution of `matvec(x) = b`, found by `solve`."""
        return solve(matvec, b)


class _Namespace:
    """Two modules with the same functions: one for NumPy, one for JAX."""

    def __init__(self, host: Any, device: Any) -> None:
        self._host, self._device = host, device

    def __getattr__(self, name: str) -> Any:
        return getattr(self._host if _ON_HOST.get() else self._device, name)


xp: Any = _Namespace(np, jnp)
"""`numpy` on the host, else `jax.numpy`."""
lax: Any = _Namespace(_Operations, jax.lax)
"""A part of `jax.lax` for NumPy on the host, else `jax.lax`."""


def while_loop(proceed: Callable[[_C], Any], body: Callable[[_C], _C], start: _C) -> _C:
    """`lax.while_loop`."""
    if not _ON_HOST.get():
        return jax.lax.while_loop(proceed, body, start)
    while proceed(start):
        start = body(start)
    return start


def if_true(needed: Any, function: Callable[[_C], _C], value: _C) -> _C:
    """`function(value)` if `needed`, else `value`. In a batch it is always computed."""
    if _ON_HOST.get():
        return function(value) if needed else value
    return jax.lax.cond(needed, function, lambda value: value, value)


def fori_loop(low: Any, high: Any, body: Callable[[Any, _C], _C], start: _C) -> _C:
    """`lax.fori_loop`."""
    if not _ON_HOST.get():
        return jax.lax.fori_loop(low, high, body, start)
    for k in range(low, high):
        start = body(k, start)
    return start


def scan(body: Callable, start: Any, xs: Any, *, reverse: bool = False) -> Any:
    """`lax.scan` over arrays."""
    if not _ON_HOST.get():
        return jax.lax.scan(body, start, xs, reverse=reverse)
    rows = []
    for here in reversed(_rows(xs)) if reverse else _rows(xs):
        start, row = body(start, here)
        rows.append(row)
    return start, _stacked(rows[::-1] if reverse else rows)


def vmap(function: _F) -> _F:
    """`jax.vmap` over the first axis of every argument."""
    if not _ON_HOST.get():
        return jax.vmap(function)
    mapped: Any = lambda *args: _stacked([function(*row) for row in _rows(args)])
    return mapped


def _rows(tree: Any) -> list:
    """A tree for each row of the arrays."""
    leaves, structure = jax.tree.flatten(tree)
    return [jax.tree.unflatten(structure, row) for row in zip(*leaves, strict=True)]


def _stacked(rows: list) -> Any:
    return jax.tree.map(lambda *leaves: np.stack(leaves), *rows)


def stop_gradient(tree: _C) -> _C:
    """`lax.stop_gradient`."""
    return tree if _ON_HOST.get() else jax.lax.stop_gradient(tree)


def entry(table: Any, *index: Any) -> Any:
    """`table[index]`, for an index that is in bounds."""
    if _ON_HOST.get():
        return table[index]
    # Without clipping, which compiles faster.
    return table.at[index].get(mode="promise_in_bounds")


def numbers(*values: Any, dtype: Any) -> Any:
    """Numbers and booleans as one vector.

    XLA compiles each operand of a concatenation as a program of its own. It compiles
    these selects as one.
    """
    if _ON_HOST.get():
        return np.array([float(value) for value in values], dtype)
    # A constant, because XLA would move comparisons with an iota out of a loop, one by
    # one.
    place = np.arange(len(values))
    vector = jnp.zeros(len(values), dtype)
    for k, value in enumerate(values):
        vector = jnp.where(place == k, jnp.asarray(value, dtype), vector)
    return vector
