"""The derivative rule of planners that converge to a stationary point."""

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
    """Give `iterate(problem, start, options)` derivatives with respect to the problem.

    `tangents(out, given, varied, rest, change)` returns the tangents by the names of
    the fields of the outcome. The other fields have tangents of zero. `given` are the
    arguments of `iterate`. `varied` is the part of the problem that has a tangent,
    `rest` the other part, and `change` the tangent.
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
                "this number a field of a module, with `delucax.parameter()`."
            )
        out = outcome(*primals)
        # A tangent of None means zero.
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
        # Trace here, so that a derivative does not trace the iteration again.
        iteration = hoisted(iterate, problem, start, options)
        # A tracer that the iteration closes over would have escaped in the derivative.
        traced = not all(map(is_concrete, jax.tree.leaves(iteration)))
        return outcome(iteration, problem, start, options, traced)

    return solve
