"""The derivative rule of the planners that converge to a stationary point."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax

from .._check import is_concrete
from .._jax import by_lanes, hoisted
from ..math._linear_solve import full_precision
from ..math._small import products_whole
from ._problem import Problem
from ._start import Start


def implicit(
    where: str, iterate: Callable[..., Any], tangents: Callable[..., dict[str, Any]]
) -> Callable[[Problem, Start, Any], Any]:
    """`iterate(problem, start, options)` with derivatives with respect to the problem.

    They are `tangents(out, given, varied, rest, change)`, by the names of the fields of
    the outcome; the other fields have none. `given` are the arguments of `iterate`.
    `varied` and `rest` are the parts of the problem with and without a tangent, so that
    nothing else is differentiated; `change` is the tangent.
    """

    @eqx.filter_custom_jvp
    def outcome(iteration: Any, *given: Any) -> Any:
        return by_lanes(iteration, *given[:-1])

    @outcome.def_jvp
    @full_precision
    def rule(primals: Any, derivatives: Any) -> Any:
        closed_over, change, *_ = derivatives
        *given, traced = primals[1:]
        if traced or jax.tree.leaves(closed_over):
            raise ValueError(
                f"{where}: the dynamics, the cost or a constraint closes over a number "
                "that is differentiated, or that a transformation outside traces. Make "
                "it a field of a module, a `delucax.parameter()`."
            )
        out = outcome(*primals)
        # A tangent of None is known to be zero.
        zeros = jax.tree.map(lambda _: None, out)
        if not jax.tree.leaves(change):
            return out, zeros
        has_tangent = jax.tree.map(
            lambda t, p: t is not None, change, given[0], is_leaf=lambda t: t is None
        )
        varied, rest = eqx.partition(given[0], has_tangent)
        with products_whole():
            changes = tangents(out, given, varied, rest, change)
        return out, zeros._replace(**changes)

    def solve(problem: Problem, start: Start, options: Any) -> Any:
        # Traced here: a derivative repeats the program, not the tracing of it.
        iteration = hoisted(iterate, problem, start, options)
        # The derivative, traced elsewhere, would meet it as a tracer that has escaped.
        traced = not all(map(is_concrete, jax.tree.leaves(iteration)))
        return outcome(iteration, problem, start, options, traced)

    return solve
