"""Status codes, in one enumeration with those of Diffrax, Optimistix and Lineax."""

import contextlib
import functools
import re
from collections.abc import Callable
from typing import Any, TYPE_CHECKING, TypeAlias, TypeVar

import diffrax
import equinox as eqx
import jax
import numpy as np
from jax.core import Tracer
from jaxtyping import Bool

from ._host import on_host
from ._typing import Array


class RESULTS(diffrax.RESULTS):  # pyright: ignore[reportGeneralTypeIssues]
    """The status of a computation: success, or the reason for a failure.

    Test for success with `result == RESULTS.successful`. Read the message with
    `RESULTS[result]`; it is empty for a success.

    `delucax.RESULTS` extends `diffrax.RESULTS`, which extends the `RESULTS` of
    Optimistix and Lineax, so that the message is kept if a solver of one of these
    libraries fails.
    """

    diverged = "The states or costs became NaN or infinite."
    stage_not_solved = (
        "The stages of an implicit solver were not solved. Take more substeps or a "
        "smaller dt, or give its root finder other tolerances or more steps."
    )
    beyond_precision = (
        "The solver reached max_steps. Its rtol is below the precision of the state, "
        "so more steps may not help. Increase rtol, or compute in float64."
    )
    not_stabilisable = (
        "The pair (A, B) is not stabilisable: the control does not reach a mode that "
        "does not decay, or reaches it less than the rounding of the data."
    )
    not_stabilising = (
        "There is no stabilising solution. Either the cost does not detect an unstable "
        "mode, or the cost is unbounded below."
    )
    on_boundary = (
        "The closed loop is on the boundary of stability, up to rounding. Either the "
        "cost does not detect a mode there, or a slightly smaller weight would make "
        "the cost unbounded below, or the precision is too low to tell."
    )
    ill_posed = (
        "The problem is not well posed: a number is not finite, a weight is not "
        "definite, the descriptor matrix is singular, or the equation is singular."
    )
    not_separated = (
        "The spectra of the coefficients cannot be separated by a vertical line (in "
        "discrete time, by a circle about 0), and the equation is too large to be "
        "solved as one linear system."
    )
    not_converged = "The iteration did not converge within its step limit."
    unexciting = (
        "The data do not identify all parameters: there are too few, or they excite "
        "the system too little."
    )
    no_descent = (
        "No step lowered the cost, although the gradient is not zero. The problem may "
        "not be smooth there, or the tolerance may be below rounding."
    )
    events_changed = (
        "The iteration did not converge, because the events along the trajectory "
        "change from one iterate to the next. The best plan may be where an event "
        "appears or moves to another interval. You get the best plan so far; another "
        "start may lead to a better one."
    )
    too_many_events = (
        "More than max_events events fell in one interval. The state is held after the "
        "last. Events may accumulate, or a reset may leave its guard at zero. Raise "
        "max_events, take a smaller dt, add a mode in which the guard is not enabled, "
        "or list an event that only reports a crossing in crossing_events."
    )
    beyond_guard = (
        "A state is beyond an enabled guard at the start of an interval or after a "
        "reset, so its event cannot fire. Start on the other side of the guard, or "
        "disable the event there with `enabled`."
    )
    grazing = (
        "A guard touches zero and hardly crosses it, so the derivatives of its event "
        "are NaN."
    )
    unknown_action = (
        "A controller returned an integer action that the environment does not have. "
        "The actions are 0, 1 and so on, one for each row of its `actions`."
    )
    unknown_mode = "The mode of a state is not one of the modes of its system."
    plan_failed = (
        "At least one plan of the controller did not succeed. "
        "`trajectory.incident_counts` has the number of such plans, if `keep` holds "
        '"incidents", as by default.'
    )
    estimate_failed = (
        "At least one estimate of the controller failed. "
        "`trajectory.incident_counts` has the number of such estimates, if `keep` "
        'holds "incidents", as by default.'
    )
    filter_failed = (
        "A safety filter found no control that keeps its barriers, at least once. "
        "`trajectory.incident_counts` has the number of times, if `keep` holds "
        '"incidents", as by default.'
    )
    update_refused = (
        "At least one update of a learner was not finite and was not made. "
        "`trajectory.incident_counts` has the number of such updates, if `keep` holds "
        '"incidents", as by default.'
    )
    delay_beyond_memory = (
        "A delay is negative, or longer than the memory of the dynamics. Construct the "
        "dynamics with a longer memory, or keep the delay within it."
    )
    no_equilibrium = (
        "There is no equilibrium near the guess: the smallest residual there is not "
        "zero. Fix fewer states and controls, or start from another guess."
    )
    infeasible = (
        "The problem has no solution: the cost has no unique minimum over the control, "
        "or gamma is below the smallest level that a controller can attain."
    )
    no_feasible_point = "The constraints cannot all hold: no point satisfies them."
    unbounded = (
        "The cost is unbounded below: it falls without end along a direction that "
        "satisfies the constraints."
    )
    inaccurate = (
        "Rounding ended the iteration close to the tolerance, but not within it. Take "
        "a larger tolerance, scale the data, or compute in float64."
    )


if TYPE_CHECKING:
    Result: TypeAlias = Any
else:
    Result = type(diffrax.RESULTS.successful)
"""An item of `RESULTS`, or of Diffrax's; the type of every `result` field."""


class _Item(Result):
    """An item of `RESULTS` that prints its name and its message.

    The items of a batch are items again: `results[i]`, and `for result in results`.
    """

    def __getitem__(self, index):
        return jax.tree.map(lambda r: r[index], self)

    def __iter__(self):
        # Without it, Python would index until an `IndexError`, which JAX never raises.
        return (self[i] for i in range(len(self._value)))

    def __repr__(self):
        if isinstance(self._value, Tracer):
            return "<RESULTS: traced>"
        names = list(RESULTS._name_to_item)
        codes, counts = np.unique(np.asarray(self._value), return_counts=True)
        if np.ndim(self._value):  # of a batch
            each = (f"{n} {names[code]}" for code, n in zip(codes, counts, strict=True))
            return f"<RESULTS: {', '.join(each)}>"
        message = RESULTS[self]
        return f"<RESULTS.{names[codes[0]]}{': ' if message else ''}{message}>"


def _print_names() -> None:
    """Make `RESULTS`, and its functions that make items, hold items of that class."""

    def ours(make: Callable[..., Any]) -> Any:
        def made(*args):
            item = make(*args)
            return item if isinstance(item, _Item) else _Item(item._value, RESULTS)

        return staticmethod(functools.wraps(make)(made))

    items: Any = RESULTS._name_to_item
    items |= {name: _Item(item._value, RESULTS) for name, item in items.items()}
    for make in (RESULTS.promote, RESULTS.where):
        setattr(RESULTS, make.__name__, ours(make))


_print_names()


INCIDENTS = {
    "refused_update": RESULTS.update_refused,
    "failed_plan": RESULTS.plan_failed,
    "failed_estimate": RESULTS.estimate_failed,
    "failed_filter": RESULTS.filter_failed,
}
"""The status of a rollout in which a controller counted an incident of this name."""


def promote(result: Result) -> Result:
    """A result of Diffrax, Optimistix or Lineax, as one of `RESULTS`."""
    return result if isinstance(result, RESULTS) else RESULTS.promote(result)


def choose(condition: Array, first: Any, second: Any) -> Result:
    """The result `first` where the condition holds, else `second`."""
    if on_host():
        return first if condition else second
    return RESULTS.where(condition, first, second)


def first_failure(first: Result, second: Result) -> Result:
    """`first` where it is a failure, else `second`.

    A result that is statically a success adds nothing to the program.
    """
    if first is RESULTS.successful:
        return second
    if second is RESULTS.successful:
        return first
    return choose(first != RESULTS.successful, first, second)


def first_of(results: Result | None) -> Result:
    """The first failure along the leading axis; success if there is none."""
    if results is None:
        return RESULTS.successful
    # `argmax` of booleans is the first true one, or the first entry if none is.
    failed = results._value != RESULTS.successful._value
    return jax.tree.map(lambda r: r[failed.argmax()], results)


def or_none(result: Result) -> Result | None:
    """`None` if the result is statically a success, so that loops need not carry it."""
    return None if result is RESULTS.successful else result


def error_if(
    result: Result, value: Any, failed: Any, words: Callable[[str], str]
) -> Any:
    """`value`, or if `failed` an error with the message of `result` in these words: now
    if all is concrete, else at run time."""
    index: Any = result._value
    messages = [words(m) for m in result._enumeration._index_to_message]
    if isinstance(index, Tracer) or isinstance(failed, Tracer):
        return eqx.branched_error_if(value, failed, index, messages)
    if failed:
        raise RuntimeError(messages[int(index)])
    return value


@contextlib.contextmanager
def plain_errors(where: str):
    """An error of a compiled program is raised again with its message alone.

    Its own text holds the lines of the call that was compiled, which may be an earlier
    one, and hides the message among them.
    """
    try:
        yield
    except RuntimeError as error:
        if said := _SAID.search(str(error)):
            raise RuntimeError(f"{where}: {said[1]}") from None
        raise


_SAID = re.compile(r"EquinoxRuntimeError: (.*?)\n\n-+\n", re.DOTALL)
_T = TypeVar("_T")


def raise_if(failed: Bool[Array, ""], value: _T, message: str) -> _T:
    """`value`, or an error if `failed`: now if that is concrete, else at run time."""
    if isinstance(failed, Tracer):
        return eqx.error_if(value, failed, message)
    if failed:
        raise RuntimeError(message)
    return value


def raise_on_failure(
    solution: Any,
    where: str,
    throw: bool = True,
    it: str | None = "the solution",
    facts: Callable[[], str] = lambda: "",
) -> Any:
    """`solution`, or if `throw` is true, an error if its `result` is a failure: now if
    that is concrete, else at run time.

    `it` names the solution in the error; it is None if the caller has no `throw`.
    `facts` adds details if the result is concrete.
    """
    if not throw:
        return solution
    result = solution.result
    if isinstance(result._value, Tracer):
        failed = result != RESULTS.successful
        return error_if(result, solution, failed, lambda why: f"{where}: {why}")
    # Compared by NumPy, because JAX would compile a program.
    if np.asarray(result._value) != RESULTS.successful._value:
        words = (
            f"{where}: {RESULTS[result]}",
            facts(),
            it and f"Pass throw=False to look at {it}.",
        )
        raise RuntimeError(" ".join(filter(None, words)))
    return solution
