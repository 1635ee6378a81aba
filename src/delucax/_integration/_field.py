"""The vector field of a system, with the shape of what it returns checked."""

from typing import Any

from jaxtyping import Array

from ..systems import AbstractSystem


def evaluate_field(system: AbstractSystem, t: Any, x: Array, u: Array, w: Any) -> Array:
    """The vector field of `system`, with its shape checked."""
    dx = system.vector_field(t, x, u, w)
    check_returned(dx, x, system, "vector_field")
    return dx


def check_returned(value: Any, x: Array, system: AbstractSystem, method: str) -> None:
    """Raise unless what a method of `system` returned has the shape of the state."""
    shape = getattr(value, "shape", None)
    if shape == x.shape:
        return
    got = f"a {type(value).__name__}" if shape is None else shape
    listed = isinstance(value, tuple | list)
    hint = " (jnp.stack makes an array of a list)" if listed else ""
    raise ValueError(
        f"{type(system).__name__}: {method} must return an array of shape {x.shape}, "
        f"as the state has, got {got}{hint}."
    )
