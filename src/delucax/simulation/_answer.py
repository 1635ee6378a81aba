"""What a loop asks of a controller's answers, so that a slip is named."""

from typing import Any

import equinox as eqx
import jax
from jaxtyping import Array

from .._controller import AbstractController
from .._results import choose, first_failure, INCIDENTS, Result, RESULTS


def answer(controller: AbstractController, t: Any, y: Any, state: Any) -> Any:
    """`(u, state)`, what the controller answers with."""
    found = controller(t, y, state)
    if not isinstance(found, tuple | list) or len(found) != 2:
        shape = getattr(found, "shape", None)
        got = type(found).__name__ if shape is None else f"an array of shape {shape}"
        raise ValueError(
            f"{type(controller).__name__}: must return (u, state), the state as it was "
            f"given if there is none to keep, got {got}."
        )
    return found


def outcome_of(counts: dict[str, Array], before: dict[str, Array]) -> Result:
    """What became of a controller, by its tallies before a run and after it."""
    outcome = RESULTS.successful
    for name, kind in INCIDENTS.items():
        if name in counts:
            none = counts[name] == before[name]
            outcome = first_failure(outcome, choose(none, RESULTS.successful, kind))
    return outcome


def check_state(controller: AbstractController, first: Any, after: Any) -> None:
    """Raise unless a controller's state is made as the `first` one, that of `init`.

    A loop carries arrays of fixed shapes and dtypes, and nothing else.
    """
    (old, made), (new, remade) = (
        jax.tree_util.tree_flatten_with_path(state) for state in (first, after)
    )
    pairs = [("", first, after)]
    if made == remade:
        pairs = [
            (jax.tree_util.keystr(path), was, now)
            for (path, was), (_, now) in zip(old, new, strict=True)
            if not _same_kind(was, now)
        ]
    for path, was, now in pairs:
        raise ValueError(
            f"{type(controller).__name__}: state{path} must keep the structure, shape "
            f"and dtype that init gives it, {eqx.tree_pformat(was)}, got "
            f"{eqx.tree_pformat(now)}. What changes must be a JAX array from the start."
        )


def _same_kind(was: Any, now: Any) -> bool:
    if eqx.is_array(was) and eqx.is_array(now):
        # A number's dtype follows from what it meets.
        return was.shape == now.shape and (was.dtype == now.dtype or was.weak_type)
    if eqx.is_array(was) or eqx.is_array(now):
        return False
    return was is now or bool(eqx.tree_equal(was, now))
