"""Faster compilation of large programs."""

import functools
import os
from collections.abc import Callable
from typing import Any, TypeVar

import equinox as eqx
import jax
from jax.core import Tracer


_F = TypeVar("_F", bound=Callable[..., Any])

_LEVEL = "xla_backend_optimization_level"
_OPTIONS: dict[str, Any] = {_LEVEL: 1, "xla_llvm_disable_expensive_passes": True}


def quickly_compiled(function: _F) -> _F:
    """`eqx.filter_jit` with LLVM's quick passes, on CPU and outside of another
    `jax.jit`, where JAX allows it.

    A program with some hundred kernels then compiles in about three quarters of the
    time, and runs up to a tenth slower. An optimisation level in `XLA_FLAGS` is kept.
    """
    whole = eqx.filter_jit(function)
    # Any, because the overloads of `filter_jit` lack the options of `jax.jit`.
    compiled: Any = eqx.filter_jit
    quick = compiled(function, compiler_options=_OPTIONS)

    @functools.wraps(function)
    def wrapper(*args, **kwargs):
        inside = isinstance(jax.device_put(0.0), Tracer)
        chosen = _LEVEL in os.environ.get("XLA_FLAGS", "")
        if inside or chosen or jax.default_backend() != "cpu":
            return whole(*args, **kwargs)
        return quick(*args, **kwargs)

    return wrapper  # pyright: ignore[reportReturnType]
