"""What a loss returns."""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array


def cost_and_metrics(value: Any, where: str) -> tuple[Array, dict[str, Array]]:
    """The scalar and the metrics of what a loss returned, checked."""
    is_pair = isinstance(value, tuple | list) and len(value) == 2
    cost, metrics = value if is_pair else (value, {})
    if not isinstance(metrics, dict):
        got = "an array" if eqx.is_array(metrics) else type(metrics).__name__
        raise ValueError(
            f"{where}: loss must return a scalar, or a scalar and a dictionary of "
            f"metrics, got {got} for the metrics."
        )
    metrics = {name: _scalar(metric, where, name) for name, metric in metrics.items()}
    cost = _scalar(cost, where, None)
    if not jnp.issubdtype(cost.dtype, jnp.floating):
        raise ValueError(
            f"{where}: loss must return a floating-point scalar, got dtype "
            f"{cost.dtype}."
        )
    return cost, metrics


def _scalar(value: Any, where: str, name: str | None) -> Array:
    what = "loss must return" if name is None else f"metric {name!r} must be"
    try:
        array = jnp.asarray(value)
    except (TypeError, ValueError):
        raise ValueError(
            f"{where}: {what} a scalar, got {type(value).__name__}."
        ) from None
    if array.shape != ():
        raise ValueError(f"{where}: {what} a scalar, got shape {array.shape}.")
    return array
