"""The attempts that a Riccati solver makes until it has a certified solution or knows
why there is none."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.lax as lax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from .._results import choose, Result, RESULTS
from ..math._size import one_if_zero, size
from ._arguments import RiccatiData


FIRST, BALANCED, SECOND, PERTURBED, UNIT, REGULARISED, DONE = range(7)
"""The kinds of attempt.

- `FIRST`: at the problem.
- `BALANCED`: in units of the states that balance it, which those after it keep.
- `SECOND`: from another start.
- `PERTURBED`: with a state weight less by rounding, of which a solution on the boundary
    makes another or none.
- `UNIT`: with unit weights, which has a solution if and only if the pair is
    stabilisable.
- `REGULARISED`: with a state weight more by the root of rounding, whose loop tells by
    being close to the boundary that the problem's is on it.
"""
_NEXT = (
    # after success, failure in units that do not fit, and other failure of
    (PERTURBED, BALANCED, SECOND),  # FIRST
    (PERTURBED, SECOND, SECOND),  # BALANCED
    (PERTURBED, UNIT, UNIT),  # SECOND
    (DONE, BALANCED, UNIT),  # PERTURBED
    (REGULARISED, DONE, DONE),  # UNIT
    (DONE, DONE, DONE),  # REGULARISED
)
"""What is attempted next. A loop far from the boundary needs no `PERTURBED`."""
_ALIKE = 0.3
"""How much of its distance from the boundary a loop may owe to rounding."""


class Candidate(NamedTuple):
    """What may be the stabilising solution."""

    X: Float[Array, "n n"]
    residual: Float[Array, ""]  # in units that balance the problem
    given: Float[Array, ""]  # the residual in the units that the problem was given in
    bound: Float[Array, ""]  # spectral radius or abscissa of the closed loop
    gap: Float[Array, ""]  # the distance from the boundary, positive if it is stable


class Attempt(NamedTuple):
    """A candidate, and what it takes to judge it."""

    candidate: Candidate
    rounding: Float[Array, ""]  # of the gap
    near: Bool[Array, ""]  # whether the gap is so small that it has to be looked at
    around: Bool[Array, ""]  # whether it is small
    least: Float[Array, ""]  # the residual that rounding of X may leave, if balanced
    modest: Bool[Array, ""]  # whether X is far from what rounding makes of infinity
    iterations: Int[Array, ""]


class SearchResult(NamedTuple):
    """The best candidate, and what the other attempts told."""

    best: Candidate
    solved: Bool[Array, ""]
    stable: Bool[Array, ""]
    fragile: Bool[Array, ""]  # whether data changed by rounding have no such solution
    stabilisable: Bool[Array, ""]
    on_edge: Bool[Array, ""]
    balanced: Bool[Array, ""]
    posed: Bool[Array, ""]
    iterations: Int[Array, ""]

    @property
    def X(self) -> Float[Array, "n n"]:
        return self.best.X

    @property
    def differentiable(self) -> Bool[Array, ""]:
        return self.stable & jnp.all(jnp.isfinite(self.X)) & self.posed

    @property
    def result(self) -> Result:
        """The status."""
        good = self.solved & ~self.fragile
        close = self.stable & (self.best.residual <= tolerance(self.X.dtype) ** 0.5)
        result = choose(close, RESULTS.not_converged, RESULTS.not_stabilising)
        result = choose(self.fragile | self.on_edge, RESULTS.on_boundary, result)
        result = choose(self.stabilisable, result, RESULTS.not_stabilisable)
        result = choose(good, RESULTS.successful, result)
        return choose(self.posed, result, RESULTS.ill_posed)


def tolerance(dtype: Any) -> float:
    """The relative residual up to which an equation counts as solved."""
    return 1e-12 if jnp.finfo(dtype).bits == 64 else 1e-5


def search(
    attempt: Callable[[Int[Array, ""], Bool[Array, ""]], Attempt],
    X: Float[Array, "n n"],
    posed: Bool[Array, ""],
    apart: Bool[Array, ""],
) -> SearchResult:
    """Make attempts of the kinds above, as few as are needed.

    An attempt is of a kind, in balanced units or in those given, which may be `apart`.

    Most problems are solved by the first. In a batch, the others are made if any member
    has need of them.
    """
    dtype = X.dtype
    close = tolerance(dtype)

    def more(carry):
        return carry[0] != DONE

    def body(carry):
        kind, before = carry
        best = before.best
        balanced = before.balanced | (kind == BALANCED)
        new = attempt(kind, balanced)
        at = new.candidate
        stable = at.gap > new.rounding
        # No X of this precision may come closer; a hundred times is looked past.
        enough = jnp.clip(new.least, close, 100 * close)
        # In units that do not fit, a wrong X may leave little.
        unfit = apart & ~balanced
        solved = stable & (at.residual <= enough) & (~unfit | (at.given <= close))
        given = kind <= SECOND
        # Of two that are solved the one with the smaller residual is kept, and of two
        # that are not the first, unless the second alone is stable.
        take = solved & (~before.solved | (at.given < best.given))
        take = given & (take | (kind == FIRST) | stable & ~before.stable)

        survives = stable & (at.residual <= close**0.5)
        # Rounding hides on which side of the boundary the loop is.
        undecided = ~stable & (at.gap >= -new.rounding)
        undecided &= (at.residual <= close) & new.modest
        same = jnp.abs(at.gap - best.gap) <= _ALIKE * best.gap
        fragile = jnp.where(
            kind == PERTURBED, ~(survives & same), before.fragile & ~(given & solved)
        )
        unit = kind == UNIT
        judged, kept = (
            jax.tree.map(lambda now, then: jnp.where(take, now, then), *pair)
            for pair in (((solved, stable), (before.solved, before.stable)), (at, best))
        )
        after = SearchResult(
            kept,
            *judged,
            fragile=fragile,
            stabilisable=jnp.where(
                unit, survives | undecided | judged[1], before.stabilisable
            ),
            on_edge=jnp.where(
                unit,
                undecided,
                jnp.where(kind == REGULARISED, survives & new.around, before.on_edge),
            ),
            balanced=balanced,
            posed=posed,
            iterations=before.iterations + jnp.where(given, new.iterations, 0),
        )
        success = jnp.where(given, solved, ~fragile & (~unit | survives))
        outcome = jnp.where(success, 0, jnp.where(unfit, 1, 2))
        # No index from outside: nothing is clipped, which compiles sooner.
        following = jnp.asarray(_NEXT).at[kind, outcome].get(mode="promise_in_bounds")
        over = given & solved & ~new.near
        return jnp.where(over, DONE, following), after

    number = jnp.asarray(jnp.inf, dtype)
    no, yes = jnp.asarray(False), jnp.asarray(True)
    nothing = SearchResult(
        Candidate(X, residual=number, given=number, bound=number, gap=-number),
        solved=no,
        stable=no,
        fragile=no,
        stabilisable=yes,
        on_edge=no,
        balanced=no,
        posed=posed,
        iterations=jnp.asarray(0),
    )
    start = jnp.where(posed, FIRST, DONE)
    return lax.while_loop(more, body, (start, nothing))[1]


def weights(
    kind: Int[Array, ""], data: RiccatiData
) -> tuple[RiccatiData, Float[Array, ""]]:
    """The problem with the weights of an attempt of this kind, and the size of the
    state weight."""
    Q, R, S = data.Q, data.R, data.S
    n, m, dtype = Q.shape[0], R.shape[0], Q.dtype
    eps = jnp.finfo(dtype).eps
    eye_Q, eye_R = jnp.eye(n, dtype=dtype), jnp.eye(m, dtype=dtype)
    size_Q, size_R = size(Q), size(R)
    scale_R = one_if_zero(size_R)
    scale_Q = jnp.where(size_Q > 0, size_Q, scale_R)
    change = jnp.where(kind == PERTURBED, -10 * n * eps * size_Q, 0)
    change = jnp.where(kind == REGULARISED, eps**0.5 * scale_Q, change)
    unit = kind == UNIT
    Q = jnp.where(unit, scale_Q * eye_Q, Q + change * eye_Q)
    R = jnp.where(unit, scale_R * eye_R, R)
    return data._replace(Q=Q, R=R, S=jnp.where(unit, 0, S)), scale_Q
