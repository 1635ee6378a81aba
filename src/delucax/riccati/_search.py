"""The retry strategy of the algebraic Riccati solver: balancing, restarts, and
perturbed problems that tell why there is no solution."""

from collections.abc import Callable
from typing import NamedTuple

import jax
from jaxtyping import Float, Int

from .._jax import entry, stop_gradient, while_loop, xp
from .._results import choose, Result, RESULTS
from .._typing import Array, BoolScalar, Scalar, Square
from ..math._linear_solve import solve
from ..math._lyapunov import MAX_DOUBLINGS
from ..math._norms import one_if_zero, power_of_two, size
from ._arguments import RiccatiData
from ._residual import tolerance


FIRST, BALANCED, SECOND, PERTURBED, UNIT, REGULARISED, DONE = range(7)
"""The kinds of attempt.

- `FIRST`: the problem as given.
- `BALANCED`: after diagonal balancing of the states, which later attempts keep.
- `SECOND`: from another starting point.
- `PERTURBED`: with `Q` less by rounding. If the closed loop is stable by rounding
    alone, the solution of this problem differs much, or there is none.
- `UNIT`: with `Q` and `R` multiples of the identity. This problem has a stabilising
    solution if and only if the pair is stabilisable.
- `REGULARISED`: with `Q` more by the root of rounding. If its closed loop is near the
    boundary of stability, that of the problem is on it.
"""
_NEXT = (
    # Following a success, a failure in badly scaled units, and any other failure.
    #
    # FIRST: a success near the boundary is to be confirmed. A failure is attributed
    # to the scaling if that is bad, else to the starting point.
    (PERTURBED, BALANCED, SECOND),
    # BALANCED: likewise, and the scaling is ruled out.
    (PERTURBED, SECOND, SECOND),
    # SECOND: the last attempt at a solution. The others find out why there is none.
    (PERTURBED, UNIT, UNIT),
    # PERTURBED: the solution is confirmed, or marginal. That may be due to bad scaling;
    # if not, the question is whether the pair is stabilisable.
    (DONE, BALANCED, UNIT),
    # UNIT: of a stabilisable pair the closed loop may be on the boundary. If that is
    # known already, or the pair is not stabilisable, there is nothing more to find out.
    (REGULARISED, DONE, DONE),
    # REGULARISED: the last question.
    (DONE, DONE, DONE),
)
"""The next attempt. Far from the boundary a solution needs no `PERTURBED`."""
_GAP_TOLERANCE = 0.3
"""The largest relative change of the gap under `PERTURBED` of a robust solution."""
_SWEEPS = 100
"""The most sweeps of the balancing."""
_BALANCE_THRESHOLD = 4
"""Units within this many powers of two of each other are left as they are."""


class Candidate(NamedTuple):
    """A candidate for the stabilising solution."""

    X: Square
    residual: Scalar  # after balancing
    unscaled: Scalar  # the residual in the user's units
    bound: Scalar  # spectral radius or abscissa of the closed loop
    gap: Scalar  # its distance from the boundary of stability, positive if stable


class Attempt(NamedTuple):
    """A candidate, and the quantities that decide on it."""

    candidate: Candidate
    rounding: Scalar  # of the gap
    near: BoolScalar  # whether the gap is within reach of rounding of the data
    around: BoolScalar  # the same for the wider margin of `REGULARISED`
    attainable: Scalar  # the balanced residual that rounding of X alone may cause
    bounded: BoolScalar  # whether |X| is well below |Q| / sqrt(eps)
    iterations: Int[Array, ""]


class SearchResult(NamedTuple):
    """The best candidate, and the diagnosis of the other attempts."""

    best: Candidate
    solved: BoolScalar
    stable: BoolScalar
    marginal: BoolScalar  # whether rounding of the data changes or removes the solution
    stabilisable: BoolScalar
    on_boundary: BoolScalar
    balanced: BoolScalar
    well_posed: BoolScalar
    iterations: Int[Array, ""]

    @property
    def X(self) -> Square:
        return self.best.X

    @property
    def differentiable(self) -> BoolScalar:
        return self.stable & xp.all(xp.isfinite(self.X)) & self.well_posed

    @property
    def result(self) -> Result:
        """The status."""
        good = self.solved & ~self.marginal
        close = self.stable & (self.best.residual <= tolerance(self.X.dtype) ** 0.5)
        result = choose(close, RESULTS.not_converged, RESULTS.not_stabilising)
        result = choose(self.marginal | self.on_boundary, RESULTS.on_boundary, result)
        result = choose(self.stabilisable, result, RESULTS.not_stabilisable)
        result = choose(good, RESULTS.successful, result)
        return choose(self.well_posed, result, RESULTS.ill_posed)


def search(
    attempt: Callable[[Int[Array, ""], BoolScalar], Attempt],
    X: Square,
    well_posed: BoolScalar,
    badly_scaled: BoolScalar,
) -> SearchResult:
    """Make attempts of the kinds above, as few as are needed.

    `attempt(kind, balanced)` is in balanced or in the user's units, which may be
    `badly_scaled`. Most problems are solved by the first attempt. In a batch, the
    others are made if any member needs them.
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
        # Rounding of X may not allow a smaller residual: up to a hundred times the
        # tolerance is accepted then.
        enough = xp.clip(new.attainable, close, 100 * close)
        # With bad scaling a wrong X can have a small balanced residual.
        unfit = badly_scaled & ~balanced
        solved = stable & (at.residual <= enough) & (~unfit | (at.unscaled <= close))
        unchanged = kind <= SECOND  # the user's problem, not a perturbed one
        # Between two solutions the smaller residual decides. Between two failures the
        # first is kept, unless only the second is stable.
        take = solved & (~before.solved | (at.unscaled < best.unscaled))
        take = unchanged & (take | (kind == FIRST) | stable & ~before.stable)

        # For a perturbed problem a rough solution is enough.
        survives = stable & (at.residual <= close**0.5)
        # Stable or not: the gap is smaller than its rounding.
        undecided = ~stable & (at.gap >= -new.rounding)
        undecided = undecided & (at.residual <= close) & new.bounded
        # The gap of a robust solution hardly changes with Q; that of a marginal one
        # changes by as much as itself.
        # So does that of rounding by chance, but no doubling converges to it.
        same = xp.abs(at.gap - best.gap) <= _GAP_TOLERANCE * best.gap
        same = same & (new.iterations < MAX_DOUBLINGS)
        marginal = before.marginal & ~(unchanged & solved)
        marginal = xp.where(kind == PERTURBED, ~(survives & same), marginal)
        unit = kind == UNIT
        solved_now, stable_now, kept = jax.tree.map(
            lambda now, then: xp.where(take, now, then),
            (solved, stable, at),
            (before.solved, before.stable, best),
        )
        stabilisable = survives | undecided | stable_now
        near_it = survives & new.around
        on_boundary = xp.where(kind == REGULARISED, near_it, before.on_boundary)
        after = before._replace(
            best=kept,
            solved=solved_now,
            stable=stable_now,
            marginal=marginal,
            stabilisable=xp.where(unit, stabilisable, before.stabilisable),
            on_boundary=xp.where(unit, undecided, on_boundary),
            balanced=balanced,
            iterations=before.iterations + xp.where(unchanged, new.iterations, 0),
        )
        # The column of the table.
        success = xp.where(unchanged, solved, ~marginal & (~unit | survives))
        outcome = xp.where(success, 0, xp.where(unfit, 1, 2))
        following = entry(xp.asarray(_NEXT), kind, outcome)
        over = unchanged & solved & ~new.near
        return xp.where(over, DONE, following), after

    most, no = xp.asarray(xp.inf, dtype), xp.asarray(False)
    flags = "solved", "stable", "marginal", "on_boundary", "balanced"
    nothing = SearchResult(
        Candidate(X, residual=most, unscaled=most, bound=most, gap=-most),
        **dict.fromkeys(flags, no),
        stabilisable=xp.asarray(True),
        well_posed=well_posed,
        iterations=xp.asarray(0),
    )
    start = xp.where(well_posed, FIRST, DONE)
    return while_loop(lambda carry: carry[0] != DONE, body, (start, nothing))[1]


def weights(kind: Int[Array, ""], data: RiccatiData) -> tuple[RiccatiData, Scalar]:
    """The data of an attempt of this kind, and the size of the state weight."""
    Q, R, S = data.Q, data.R, data.S
    n, m, dtype = Q.shape[0], R.shape[0], Q.dtype
    eps = xp.finfo(dtype).eps
    # Where `Q` is zero `R` sets the scale.
    eye_Q, eye_R = xp.eye(n, dtype=dtype), xp.eye(m, dtype=dtype)
    size_Q, size_R = size(Q), size(R)
    scale_R = one_if_zero(size_R)
    scale_Q = xp.where(size_Q > 0, size_Q, scale_R)
    # A change of Q by eps is within the rounding of the data. One by the root of eps
    # moves eigenvalues off the boundary by about eps^(1/4).
    change = xp.where(kind == PERTURBED, -10 * n * eps * size_Q, 0)
    change = xp.where(kind == REGULARISED, eps**0.5 * scale_Q, change)
    unit = kind == UNIT
    Q = xp.where(unit, scale_Q * eye_Q, Q + change * eye_Q)
    R = xp.where(unit, scale_R * eye_R, R)
    return data._replace(Q=Q, R=R, S=xp.where(unit, 0, S)), scale_Q


def units(data: RiccatiData) -> Float[Array, "2 n"]:
    """Diagonal balancing: powers of two that scale states and the rows of A, B and E.

    They make the row and the column norms of the Hamiltonian matrix equal, state by
    state: a badly scaled state is lost in the rounding of the others. A state with a
    zero row or column keeps its scale. The rows of a given E then have equal norms.

    Source: Parlett and Reinsch, 1969 (balancing); Benner, 2001 (of a Hamiltonian).
    """
    A, B, Q, R, _, E = stop_gradient(data)
    n, dtype = A.shape[0], A.dtype
    lowest = xp.finfo(dtype).minexp
    plain_A, plain_B = (A, B) if E is None else (solve(E, A), solve(E, B))

    def logarithm(M):
        exponent = xp.log2(M)
        return xp.where(xp.isfinite(exponent), exponent, lowest)

    # The quadratic blocks are products: B R^-1/2 and Q^1/2 have the scale of one state
    # each. All in base-2 logarithms.
    effort = xp.sqrt(_diagonal_sizes(R))
    force = xp.max(xp.abs(plain_B) / one_if_zero(effort), axis=1)
    weight = logarithm(xp.sqrt(_diagonal_sizes(Q)))
    other = ~xp.eye(n, dtype=bool)
    inside, force = logarithm(xp.abs(plain_A) * other), logarithm(force)

    def more(carry):
        k, change, _ = carry
        return (k < _SWEEPS) & (xp.max(xp.abs(change)) > 1 / 4)

    def sweep(carry):
        k, _, d = carry
        moved = inside + d[:, None] - d
        forced, weighed = force + d, weight - d
        # The scale of the cost is free: it is chosen to make both blocks alike.
        rows = xp.maximum(xp.max(moved, axis=1), forced + xp.max(weighed))
        columns = xp.maximum(xp.max(moved, axis=0), weighed + xp.max(forced))
        # Half of the step that each state would take alone, as all move at once.
        change = (columns - rows) / 4
        # A zero row or column, with the logarithm `lowest`, asks for a huge step.
        change = xp.where(xp.abs(change) < -lowest / 8, change, 0)
        return k + 1, change, d + change

    start = xp.zeros(n, dtype)
    *_, d = while_loop(more, sweep, (0, start + 1, start))
    # A factor common to all states has no effect: it is removed to avoid overflow.
    d = d - xp.mean(d)
    f = d
    if E is not None:
        f = -xp.max(logarithm(xp.abs(E)) - d, axis=1)
    both = xp.stack([d, f])
    badly_scaled = xp.any(
        xp.max(both, axis=1) - xp.min(both, axis=1) > _BALANCE_THRESHOLD
    )
    both = xp.where(badly_scaled, both, 0)
    return power_of_two(xp.exp2(both))


def _diagonal_sizes(M):
    # `jnp.diagonal` gathers, which is slower to compile.
    return xp.max(xp.where(xp.eye(len(M), dtype=bool), xp.abs(M), 0), axis=1)


def in_units(by: Float[Array, "2 n"], data: RiccatiData) -> RiccatiData:
    """The data with states and rows scaled `by` these factors."""
    # With the new state z = state x, the cost x'Qx is z'Qz / state^2. The rows of A, B
    # and E have a scale of their own, as each equation may be multiplied by a number.
    A, B, Q, R, S, E = data
    state, row = (unit[:, None] for unit in by)
    across = row / by[0]
    E = None if E is None else E * across
    Q = Q / (state * by[0])
    return RiccatiData(A * across, B * row, Q, R, S / state, E)
