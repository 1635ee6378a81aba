"""Outcomes of a solve, in one enumeration with Diffrax's and Lineax's own."""

from typing import Any, TYPE_CHECKING, TypeAlias

import diffrax
import jax
import jax.numpy as jnp
from jaxtyping import Array


class RESULTS(diffrax.RESULTS):  # pyright: ignore[reportGeneralTypeIssues]
    """What became of a computation.

    Extends `diffrax.RESULTS` (which extends those of Optimistix and Lineax), so that
    a failure deep inside a solve surfaces with its own words. `RESULTS[result]` is the
    message; `result == RESULTS.successful` tells whether all went well.
    """

    diverged = "The states or costs became NaN or infinite."
    not_stabilising = (
        "No stabilising solution was found: the pair (A, B) may not be stabilisable, "
        "or an unstable mode may not be seen by the cost."
    )
    not_converged = "The iteration did not converge within its step limit."


if TYPE_CHECKING:
    Result: TypeAlias = Any
else:
    Result = type(RESULTS.successful)
"""An item of `RESULTS`; the type of every `result` field."""


def promote(result: Result) -> Result:
    """A result of Diffrax, Optimistix or Lineax, as one of `RESULTS`."""
    if isinstance(result, RESULTS):
        return result
    return RESULTS.promote(result)


def choose(condition: Array, first: Any, second: Any) -> Result:
    """`first` where the condition holds, else `second`."""
    return RESULTS.where(condition, first, second)


def first_failure(first: Result, second: Result) -> Result:
    """`first` where it is a failure, else `second`.

    A result that is statically known to be a success costs nothing.
    """
    if first is RESULTS.successful:
        return second
    if second is RESULTS.successful:
        return first
    return choose(first != RESULTS.successful, first, second)


def first_of(results: Result | None) -> Result:
    """The first failure among stacked results; success if there is none to look at."""
    if results is None:
        return RESULTS.successful
    failed = results != RESULTS.successful
    return jax.tree.map(lambda r: r[jnp.argmax(failed)], results)


def or_none(result: Result) -> Result | None:
    """`None` for what is statically a success, so that loops need not carry it."""
    return None if result is RESULTS.successful else result
