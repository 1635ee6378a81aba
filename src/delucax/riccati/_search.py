"""The attempts that a Riccati solver makes until it has a certified solution or knows
why there is none: their order, and the weights and units of each."""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.lax as lax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from .._results import choose, Result, RESULTS
from .._typing import BoolScalar, Scalar, Square
from ..math._linear_solve import solve
from ..math._norms import one_if_zero, power_of_two, size
from ._arguments import RiccatiData
from ._residual import tolerance


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
_SWEEPS = 100
_APART = 4
"""Units that are no more powers of two apart are left as they are."""


class Candidate(NamedTuple):
    """What may be the stabilising solution."""

    X: Square
    residual: Scalar  # in units that balance the problem
    given: Scalar  # the residual in the units that the problem was given in
    bound: Scalar  # spectral radius or abscissa of the closed loop
    gap: Scalar  # the distance from the boundary, positive if it is stable


class Attempt(NamedTuple):
    """A candidate, and what it takes to judge it."""

    candidate: Candidate
    rounding: Scalar  # of the gap
    near: BoolScalar  # whether the gap is so small that it has to be looked at
    around: BoolScalar  # whether it is small
    least: Scalar  # the residual that rounding of X may leave, if balanced
    modest: BoolScalar  # whether X is far from what rounding makes of infinity
    iterations: Int[Array, ""]


class SearchResult(NamedTuple):
    """The best candidate, and what the other attempts told."""

    best: Candidate
    solved: BoolScalar
    stable: BoolScalar
    fragile: BoolScalar  # whether data changed by rounding have no such solution
    stabilisable: BoolScalar
    on_edge: BoolScalar
    balanced: BoolScalar
    posed: BoolScalar
    iterations: Int[Array, ""]

    @property
    def X(self) -> Square:
        return self.best.X

    @property
    def differentiable(self) -> BoolScalar:
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


def search(
    attempt: Callable[[Int[Array, ""], BoolScalar], Attempt],
    X: Square,
    posed: BoolScalar,
    apart: BoolScalar,
) -> SearchResult:
    """Make attempts of the kinds above, as few as are needed.

    An attempt is of a kind, in balanced units or in those given, which may be `apart`.

    Most problems are solved by the first. In a batch, the others are made if any member
    has need of them.
    """
    dtype = X.dtype
    close = tolerance(dtype)

    def body(carry):
        kind, before = carry
        # One attempt, whose kind is data: a branch for each would be compiled for each,
        # and under vmap all of them run.
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

        # Of a problem that was changed a rough solution tells enough.
        survives = stable & (at.residual <= close**0.5)
        # Rounding hides on which side of the boundary the loop is.
        undecided = ~stable & (at.gap >= -new.rounding)
        undecided &= (at.residual <= close) & new.modest
        # The gap of a loop inside the boundary changes little with the weight; that of
        # one that only rounding keeps off it changes by as much as it is.
        same = jnp.abs(at.gap - best.gap) <= _ALIKE * best.gap
        fragile = jnp.where(
            kind == PERTURBED, ~(survives & same), before.fragile & ~(given & solved)
        )
        unit = kind == UNIT
        solved_now, stable_now, kept = jax.tree.map(
            lambda now, then: jnp.where(take, now, then),
            (solved, stable, at),
            (before.solved, before.stable, best),
        )
        after = before._replace(
            best=kept,
            solved=solved_now,
            stable=stable_now,
            fragile=fragile,
            stabilisable=jnp.where(
                unit, survives | undecided | stable_now, before.stabilisable
            ),
            on_edge=jnp.where(
                unit,
                undecided,
                jnp.where(kind == REGULARISED, survives & new.around, before.on_edge),
            ),
            balanced=balanced,
            iterations=before.iterations + jnp.where(given, new.iterations, 0),
        )
        # The row of the table: of a changed problem it is no failure to have no
        # stabilising solution, but an answer.
        success = jnp.where(given, solved, ~fragile & (~unit | survives))
        outcome = jnp.where(success, 0, jnp.where(unfit, 1, 2))
        # No index from outside: nothing is clipped, which compiles sooner.
        following = jnp.asarray(_NEXT).at[kind, outcome].get(mode="promise_in_bounds")
        over = given & solved & ~new.near
        return jnp.where(over, DONE, following), after

    most, no = jnp.asarray(jnp.inf, dtype), jnp.asarray(False)
    flags = "solved", "stable", "fragile", "on_edge", "balanced"
    nothing = SearchResult(
        Candidate(X, residual=most, given=most, bound=most, gap=-most),
        **dict.fromkeys(flags, no),
        stabilisable=jnp.asarray(True),
        posed=posed,
        iterations=jnp.asarray(0),
    )
    start = jnp.where(posed, FIRST, DONE)
    return lax.while_loop(lambda carry: carry[0] != DONE, body, (start, nothing))[1]


def weights(kind: Int[Array, ""], data: RiccatiData) -> tuple[RiccatiData, Scalar]:
    """The problem with the weights of an attempt of this kind, and the size of the
    state weight."""
    Q, R, S = data.Q, data.R, data.S
    n, m, dtype = Q.shape[0], R.shape[0], Q.dtype
    eps = jnp.finfo(dtype).eps
    # Where a weight is zero the other one sets the scale.
    eye_Q, eye_R = jnp.eye(n, dtype=dtype), jnp.eye(m, dtype=dtype)
    size_Q, size_R = size(Q), size(R)
    scale_R = one_if_zero(size_R)
    scale_Q = jnp.where(size_Q > 0, size_Q, scale_R)
    # Less by some rounding errors of Q: data that are the same to the user. More by the
    # root of rounding: eigenvalues on the boundary then leave it by about eps^(1/4).
    change = jnp.where(kind == PERTURBED, -10 * n * eps * size_Q, 0)
    change = jnp.where(kind == REGULARISED, eps**0.5 * scale_Q, change)
    unit = kind == UNIT
    Q = jnp.where(unit, scale_Q * eye_Q, Q + change * eye_Q)
    R = jnp.where(unit, scale_R * eye_R, R)
    return data._replace(Q=Q, R=R, S=jnp.where(unit, 0, S)), scale_Q


def units(data: RiccatiData) -> Float[Array, "2 n"]:
    """Powers of two, by which the states and the rows of A, B and E are multiplied.

    In them a row of the Hamiltonian matrix is as large as its column: what moves a
    state, other states and controls, is as large as what the state moves, other states
    and costs. A state in a unit that does not fit is lost in the rounding of the
    others. States that nothing moves, or that move nothing, keep their units. The rows
    of an E that is given are then as large as each other.

    Source: Parlett and Reinsch, 1969 (balancing); Benner, 2001 (of a Hamiltonian).
    """
    A, B, Q, R, _, E = lax.stop_gradient(data)
    n, dtype = A.shape[0], A.dtype
    lowest = jnp.finfo(dtype).minexp
    plain_A, plain_B = (A, B) if E is None else (solve(E, A), solve(E, B))

    def logarithm(M):
        exponent = jnp.log2(M)
        return jnp.where(jnp.isfinite(exponent), exponent, lowest)

    # In units of the controls in which their weights are one, and of the cost such that
    # a state's weight is the square of a length: all in logarithms, base 2.
    effort = jnp.sqrt(_diagonal_sizes(R))
    force = jnp.max(jnp.abs(plain_B) / one_if_zero(effort), axis=1)
    weight = logarithm(jnp.sqrt(_diagonal_sizes(Q)))
    other = ~jnp.eye(n, dtype=bool)
    inside, force = logarithm(jnp.abs(plain_A) * other), logarithm(force)

    def more(carry):
        k, change, _ = carry
        return (k < _SWEEPS) & (jnp.max(jnp.abs(change)) > 1 / 4)

    def sweep(carry):
        k, _, d = carry
        moved = inside + d[:, None] - d
        forced, weighed = force + d, weight - d
        # The size of the cost is free: that at which both have the same weight.
        rows = jnp.maximum(jnp.max(moved, axis=1), forced + jnp.max(weighed))
        columns = jnp.maximum(jnp.max(moved, axis=0), weighed + jnp.max(forced))
        # Half of the step that each state would take alone.
        change = (columns - rows) / 4
        # It is huge where a side has only zeros, whose logarithm stands as `lowest`.
        change = jnp.where(jnp.abs(change) < -lowest / 8, change, 0)
        return k + 1, change, d + change

    start = jnp.zeros(n, dtype)
    *_, d = lax.while_loop(more, sweep, (0, start + 1, start))
    # A unit common to all states changes nothing: no overflow is to come of it.
    d -= jnp.mean(d)
    f = d
    if E is not None:
        f = -jnp.max(logarithm(jnp.abs(E)) - d, axis=1)
    both = jnp.stack([d, f])
    apart = jnp.any(jnp.max(both, axis=1) - jnp.min(both, axis=1) > _APART)
    both = jnp.where(apart, both, 0)
    return power_of_two(jnp.exp2(both))


def _diagonal_sizes(M):
    # `jnp.diagonal` gathers, which is slower to compile.
    return jnp.max(jnp.where(jnp.eye(len(M), dtype=bool), jnp.abs(M), 0), axis=1)


def in_units(by: Float[Array, "2 n"], data: RiccatiData) -> RiccatiData:
    """The data of the equation with states and rows that are `by` times these."""
    # The new state is z = state x, so that x'Qx is z'Q z / state^2. The rows of A and E
    # may have another unit: an equation may be multiplied by any number.
    A, B, Q, R, S, E = data
    state, row = (unit[:, None] for unit in by)
    across = row / by[0]
    E = None if E is None else E * across
    Q = Q / (state * by[0])
    return RiccatiData(A * across, B * row, Q, R, S / state, E)
