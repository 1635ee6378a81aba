"""One text for two array libraries: NumPy where nothing is traced, else JAX.

A design such as a Riccati equation is solved once, and compiling it would take a
thousand times as long as solving it. So what is written with `xp` and the loops below
runs on NumPy when all its arguments are concrete arrays, and compiled under `jax.jit`,
`jax.vmap` and `jax.grad`.
"""

import functools
from collections.abc import Callable
from contextvars import ContextVar
from typing import Any, TypeVar

import equinox as eqx
import jax
import jax.lax as lax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer


_ON_HOST: ContextVar[bool] = ContextVar("delucax_on_host", default=False)

_F = TypeVar("_F", bound=Callable[..., Any])
_C = TypeVar("_C")


def on_host() -> bool:
    """Whether NumPy computes."""
    return _ON_HOST.get()


class _Namespace:
    """`numpy` or `jax.numpy`, whichever computes."""

    def __getattr__(self, name: str) -> Any:
        return getattr(np if _ON_HOST.get() else jnp, name)


xp: Any = _Namespace()


def host_unless_traced(function: _F) -> _F:
    """Compile a function with `eqx.filter_jit`, but run it with NumPy if no argument is
    traced. Its results are JAX's arrays in both cases.

    A function so wrapped may call another one.
    """
    compiled = eqx.filter_jit(function)

    @functools.wraps(function)
    def wrapper(*args, **kwargs):
        if _ON_HOST.get():
            return function(*args, **kwargs)
        if any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves((args, kwargs))):
            return compiled(*args, **kwargs)
        args, kwargs = jax.tree.map(_to_host, (args, kwargs))
        token = _ON_HOST.set(True)
        try:
            # As in JAX: what overflows is infinite, what is undefined NaN.
            with np.errstate(all="ignore"):
                value = function(*args, **kwargs)
        finally:
            _ON_HOST.reset(token)
        return jax.tree.map(_to_device, value)

    return wrapper  # pyright: ignore[reportReturnType]


def _to_host(leaf: Any) -> Any:
    return np.asarray(leaf) if isinstance(leaf, jax.Array) else leaf


def _to_device(leaf: Any) -> Any:
    return jnp.asarray(leaf) if isinstance(leaf, np.ndarray | np.generic) else leaf


def while_loop(proceed: Callable[[_C], Any], body: Callable[[_C], _C], start: _C) -> _C:
    """`lax.while_loop`."""
    if not _ON_HOST.get():
        return lax.while_loop(proceed, body, start)
    while proceed(start):
        start = body(start)
    return start


def fori_loop(low: int, high: int, body: Callable[[Any, _C], _C], start: _C) -> _C:
    """`lax.fori_loop`."""
    if not _ON_HOST.get():
        return lax.fori_loop(low, high, body, start)
    for k in range(low, high):
        start = body(k, start)
    return start


def scan(body: Callable, start: Any, xs: Any, *, reverse: bool = False) -> Any:
    """`lax.scan`, of a given length."""
    if not _ON_HOST.get():
        return lax.scan(body, start, xs, reverse=reverse)
    steps = range(len(jax.tree.leaves(xs)[0]))
    rows = []
    for k in reversed(steps) if reverse else steps:
        start, row = body(start, jax.tree.map(lambda leaf, k=k: leaf[k], xs))
        rows.append(row)
    if reverse:
        rows.reverse()
    return start, jax.tree.map(lambda *leaves: np.stack(leaves), *rows)


def vmap(function: _F) -> _F:
    """`jax.vmap` over the first axis of every argument."""
    if not _ON_HOST.get():
        return jax.vmap(function)

    def mapped(*args):
        rows = [function(*row) for row in zip(*args, strict=True)]
        return jax.tree.map(lambda *leaves: np.stack(leaves), *rows)

    return mapped  # pyright: ignore[reportReturnType]


def stop_gradient(tree: _C) -> _C:
    """`lax.stop_gradient`."""
    return tree if _ON_HOST.get() else lax.stop_gradient(tree)


def numbers(*values: Any, dtype: Any) -> Any:
    """Numbers and flags as one vector.

    XLA compiles each operand of a concatenation as a program of its own, and these
    selects as one.
    """
    if _ON_HOST.get():
        return np.array([float(value) for value in values], dtype)
    # A constant: comparisons with an iota would be moved out of a loop, one by one.
    place = np.arange(len(values))
    vector = jnp.zeros(len(values), dtype)
    for k, value in enumerate(values):
        vector = jnp.where(place == k, jnp.asarray(value, dtype), vector)
    return vector
