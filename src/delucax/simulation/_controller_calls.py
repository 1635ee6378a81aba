"""Calls of a controller in a closed loop, with checks of what it returns."""

import types
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, PyTree

from .._controller import AbstractController
from .._results import choose, first_failure, INCIDENTS, Result, RESULTS
from .._typing import RealScalar


def call_controller(
    controller: AbstractController, t: RealScalar, y: Array, state: PyTree
) -> tuple[Array, PyTree]:
    """The control and the new state that the controller returns."""
    returned: Any = controller(t, y, state)
    if not isinstance(returned, tuple | list) or len(returned) != 2:
        got = type(returned).__name__
        if isinstance(returned, jax.Array):
            got = f"an array of shape {returned.shape}"
        raise ValueError(
            f"{type(controller).__name__}: __call__ must return (u, state), got {got}. "
            "If the controller has no state, return the given state unchanged."
        )
    u, after = returned
    return u, after


def check_control(u: Any, source: Any, size: int, taker: str) -> None:
    """Raise unless the control `u`, returned by `source`, has the size that `taker`
    needs."""
    if jnp.shape(u) != (size,):
        is_function = isinstance(source, types.FunctionType)
        name = source.__name__ if is_function else type(source).__name__
        raise ValueError(
            f"{name}: the control must have shape ({size},), as the {taker} needs it, "
            f"got shape {jnp.shape(u)}."
        )


def controller_result(counts: dict[str, Array], before: dict[str, Array]) -> Result:
    """The result from a controller's incident counters, `before` a run and after it."""
    result = RESULTS.successful
    for name, kind in INCIDENTS.items():
        if name in counts:
            none = counts[name] == before[name]
            result = first_failure(result, choose(none, RESULTS.successful, kind))
    return result


def check_state(controller: AbstractController, first: PyTree, after: PyTree) -> None:
    """Raise unless a controller's state keeps the structure of the `first`, of `init`.

    A compiled loop carries arrays of fixed shapes and dtypes, and nothing else.
    """
    (old, structure), (new, structure_after) = (
        jax.tree_util.tree_flatten_with_path(state) for state in (first, after)
    )
    changed = [((), first, after)]
    if structure == structure_after:
        leaves = zip(old, new, strict=True)
        changed = [(path, a, b) for (path, a), (_, b) in leaves if not _same_kind(a, b)]
    for path, before, now in changed:
        raise ValueError(
            f"{type(controller).__name__}: state{jax.tree_util.keystr(path)} must keep "
            "the structure, shape and dtype that init gives it, "
            f"{eqx.tree_pformat(before)}, got {eqx.tree_pformat(now)}. In init, use "
            "JAX arrays for all that changes."
        )


def _same_kind(before: Any, now: Any) -> bool:
    if eqx.is_array(before) != eqx.is_array(now):
        return False
    if not eqx.is_array(before):
        return before is now or bool(eqx.tree_equal(before, now))
    # A weakly typed number may get another dtype from the first operation on it.
    same_dtype = before.dtype == now.dtype or before.weak_type
    return before.shape == now.shape and same_dtype
