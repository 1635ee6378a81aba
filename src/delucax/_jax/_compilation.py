"""Large programs, compiled for a short wait."""

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
    """`eqx.filter_jit`, by LLVM's quick passes where JAX allows that: on CPU, and not
    inside another `jax.jit`.

    A program of some hundred kernels then compiles in about three quarters of the time
    and runs up to a tenth slower. A level in `XLA_FLAGS` is kept.
    """
    whole = eqx.filter_jit(function)
    # The overloads of `filter_jit` leave out the options of `jax.jit`, which it takes.
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
