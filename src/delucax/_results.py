"""Outcomes of a solve, in one enumeration with Diffrax's and Lineax's own."""

from collections.abc import Callable
from typing import Any, TYPE_CHECKING, TypeAlias, TypeVar

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
from jax.core import Tracer
from jaxtyping import Array, Bool


class RESULTS(diffrax.RESULTS):  # pyright: ignore[reportGeneralTypeIssues]
    """What became of a computation.

    Extends `diffrax.RESULTS` (which extends those of Optimistix and Lineax), so that
    a failure deep inside a solve surfaces with its own words. `RESULTS[result]` is the
    message; `result == RESULTS.successful` tells whether all went well.
    """

    diverged = "The states or costs became NaN or infinite."
    stage_not_solved = (
        "The stages of an implicit solver were not solved: take more substeps or a "
        "smaller dt, or give its root finder other tolerances or more steps."
    )
    beyond_precision = (
        "The solver ran out of steps. Its rtol is below the precision of the state, so "
        "more steps may not help: give a larger rtol, or compute in float64."
    )
    not_stabilisable = (
        "The pair (A, B) is not stabilisable: no control moves some mode that does not "
        "decay, or so weakly that rounding of the data hides it."
    )
    not_stabilising = (
        "There is no stabilising solution: the cost may not see an unstable mode, or "
        "have no minimum."
    )
    on_boundary = (
        "The closed loop is on the boundary of stability, up to rounding: a mode there "
        "is not seen by the cost, or a slightly smaller weight would leave the cost "
        "without a minimum, or the precision is too low to tell."
    )
    ill_posed = (
        "The data are not those of a well-posed problem: not finite, a weight that is "
        "not definite, a singular descriptor matrix, or a singular equation."
    )
    not_separated = (
        "The spectra are not on two sides of a line (of a circle about 0, in discrete "
        "time), and the equation is too large to be solved as one linear system."
    )
    not_converged = "The iteration did not converge within its step limit."
    unexciting = (
        "The data are too few, or excite too little, to tell all parameters: some "
        "direction among them is not identifiable. With throw=False the fit is "
        "returned, and says which."
    )
    no_descent = (
        "No step lowered the cost, although the gradient is not zero: the problem may "
        "not be smooth there, or the tolerance may be below rounding."
    )
    plan_failed = (
        'A plan of the controller did not succeed. Where "incidents" are in `keep`, '
        "as by default, `trajectory.incident_counts` says how many did not."
    )
    update_refused = (
        'An update of a learner was not finite and was not made. Where "incidents" '
        "are in `keep`, as by default, `trajectory.incident_counts` says how many were "
        "not."
    )
    no_equilibrium = (
        "There is no equilibrium near the guess: the least residual there is not zero. "
        "Fix fewer states and controls, or start from another guess."
    )
    infeasible = (
        "The problem has no solution: the cost has no unique minimum over the control, "
        "the constraints cannot all hold, or gamma is below the least level that any "
        "controller attains."
    )


if TYPE_CHECKING:
    Result: TypeAlias = Any
else:
    Result = type(RESULTS.successful)
"""An item of `RESULTS`; the type of every `result` field."""


INCIDENTS = {
    "refused_update": RESULTS.update_refused,
    "failed_plan": RESULTS.plan_failed,
}
"""What a run becomes by what a controller counts."""


def promote(result: Result) -> Result:
    """A result of Diffrax, Optimistix or Lineax, as one of `RESULTS`."""
    return result if isinstance(result, RESULTS) else RESULTS.promote(result)


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
    # argmax of booleans is the first that holds, and the first entry if none does.
    failed = results != RESULTS.successful
    return jax.tree.map(lambda r: r[jnp.argmax(failed)], results)


def or_none(result: Result) -> Result | None:
    """`None` for what is statically a success, so that loops need not carry it."""
    return None if result is RESULTS.successful else result


_T = TypeVar("_T")


def raise_if(failed: Bool[Array, ""], value: _T, message: str) -> _T:
    """`value`, or an error: now if it is concrete, else at run time."""
    return eqx.error_if(value, failed, message)


def raise_on_failure(
    solution: Any,
    where: str,
    throw: bool = True,
    it: str = "the solution",
    facts: Callable[[], str] = lambda: "",
) -> Any:
    """`solution`, or an error if its `result` is a failure and `throw` holds: now if
    it is concrete, else at run time.

    `it` names the solution in the error; `facts` says more of a concrete failure.
    """
    if not throw:
        return solution
    result = solution.result
    failed = result != RESULTS.successful
    if isinstance(failed, Tracer):
        # As `result.error_if` does, with the name before each message.
        words = [f"{where}: {m}" for m in result._enumeration._index_to_message]
        return eqx.branched_error_if(solution, failed, result._value, words)
    if failed:
        words = (
            f"{where}: {RESULTS[result]}",
            facts(),
            f"Pass throw=False to look at {it}.",
        )
        raise RuntimeError(" ".join(filter(None, words)))
    return solution
