"""The retry strategy of the algebraic Riccati solver: balancing, restarts, and
perturbed problems that show why there is no solution."""

from collections.abc import Callable
from typing import Any, NamedTuple

from jaxtyping import Float, Int

from .._jax import entry, numbers, stop_gradient, while_loop, xp
from .._results import choose, Result, RESULTS
from .._typing import Array, BoolScalar, Scalar
from ..math._linear_solve import solve
from ..math._lyapunov import MAX_DOUBLINGS
from ..math._norms import one_if_zero, power_of_two, size
from ._arguments import RiccatiData
from ._residual import tolerance


FIRST, SECOND, PERTURBED, UNIT, REGULARISED, DONE = range(6)
"""The kinds of attempt.

- `FIRST`: the given problem.
- `SECOND`: the given problem from another starting point.
- `PERTURBED`: with a `Q` that is smaller by rounding. If the closed loop is stable only
    because of rounding, the solution of this problem differs much or does not exist.
- `UNIT`: with `Q` and `R` multiples of the identity. This problem has a stabilising
    solution if and only if the pair is stabilisable.
- `REGULARISED`: with a `Q` that is larger by the square root of rounding. If the closed
    loop of this problem is near the boundary of stability, the closed loop of the given
    problem is on it.
"""
_NEXT = (
    # (after a failure, after a success)
    #
    # FIRST: PERTURBED confirms a success near the boundary.
    (SECOND, PERTURBED),
    # SECOND: the last attempt at a solution. The others find out why there is none.
    (UNIT, PERTURBED),
    # PERTURBED: the solution is confirmed, or it is marginal. Then UNIT finds out
    # whether the pair is stabilisable.
    (UNIT, DONE),
    # UNIT: if the pair is stabilisable, the closed loop may be on the boundary. If that
    # is known already, or the pair is not stabilisable, the diagnosis is complete.
    (DONE, REGULARISED),
    # REGULARISED: the last attempt.
    (DONE, DONE),
)
"""The next attempt. A solution far from the boundary is accepted without it."""
_GAP_TOLERANCE = 0.3
"""The largest relative change of the gap of a robust solution in `PERTURBED`."""
_SWEEPS = 100
"""The largest number of balancing sweeps."""
_BALANCE_THRESHOLD = 4
"""Units that differ by at most this many powers of two are not changed."""


class Attempt(NamedTuple):
    """A candidate for the stabilising solution, and the quantities to judge it.

    `point` holds the matrices of the candidate, one below the other.
    """

    point: Array
    residual: Scalar  # in balanced units
    unscaled: Scalar  # in the user's units
    bound: Scalar  # spectral radius or abscissa of the closed loop
    gap: Scalar  # its distance from the boundary of stability, positive if stable
    rounding: Scalar  # of the gap
    near: BoolScalar  # whether rounding of the data may change the sign of the gap
    around: BoolScalar  # the same with the wider margin of `REGULARISED`
    attainable: Scalar  # the residual that rounding of X alone may cause
    bounded: BoolScalar  # whether |X| is below |Q| / sqrt(eps)
    iterations: Int[Array, ""]


class Verdict(NamedTuple):
    """The quantities of the best candidate, and the diagnosis from the other attempts.

    Flags are 0 or 1, so that all quantities fit one array. One array in the loop
    compiles faster than an array for each of them.
    """

    kind: Scalar  # of the next attempt
    residual: Scalar
    unscaled: Scalar
    bound: Scalar
    gap: Scalar
    solved: Scalar
    stable: Scalar
    marginal: Scalar  # whether rounding of the data changes or removes the solution
    stabilisable: Scalar
    on_boundary: Scalar
    iterations: Scalar

    def result(self, well_posed: BoolScalar) -> Result:
        """The status."""
        stable, marginal = self.stable > 0, self.marginal > 0
        close = stable & (self.residual <= tolerance(self.residual.dtype) ** 0.5)
        result = choose(close, RESULTS.not_converged, RESULTS.not_stabilising)
        on_boundary = marginal | (self.on_boundary > 0)
        result = choose(on_boundary, RESULTS.on_boundary, result)
        result = choose(self.stabilisable > 0, result, RESULTS.not_stabilisable)
        good = (self.solved > 0) & ~marginal
        result = choose(good, RESULTS.successful, result)
        return choose(well_posed, result, RESULTS.ill_posed)


def search(
    attempt: Callable[[Int[Array, ""]], Attempt], point: Array, well_posed: BoolScalar
) -> tuple[Array, Array]:
    """Make as few attempts as possible. Return the best point and the verdict.

    `point` is the placeholder before the first attempt. Most problems are solved by the
    first attempt. In a batch, the others run if any member needs them.
    """
    dtype = point.dtype
    close = tolerance(dtype)

    def body(carry):
        best, so_far = carry
        # The kind is data, because branches would all be compiled, and all run under
        # vmap.
        before = Verdict(*so_far)
        kind = before.kind
        at = attempt(kind)
        stable = at.gap > at.rounding
        # If rounding of X does not allow a smaller residual, up to a hundred times the
        # tolerance is accepted.
        enough = xp.clip(at.attainable, close, 100 * close)
        solved = stable & (at.residual <= enough)
        unchanged = kind <= SECOND  # the user's problem, not a perturbed one
        # Of two solutions, take that with the smaller residual. Of two failures, keep
        # the first, unless only the second is stable.
        take = solved & (~(before.solved > 0) | (at.unscaled < before.unscaled))
        take = take | (kind == FIRST) | stable & ~(before.stable > 0)
        take = unchanged & take

        # For a perturbed problem a rough solution is enough.
        survives = stable & (at.residual <= close**0.5)
        # The gap is smaller than its rounding, so its sign is not known.
        undecided = ~stable & (at.gap >= -at.rounding)
        undecided = undecided & (at.residual <= close) & at.bounded
        # The gap of a robust solution hardly changes with Q. The gap of a marginal
        # solution changes completely. A gap that is only rounding may stay by chance,
        # but then the doubling does not converge.
        same = xp.abs(at.gap - before.gap) <= _GAP_TOLERANCE * before.gap
        same = same & (at.iterations < MAX_DOUBLINGS)
        marginal = (before.marginal > 0) & ~(unchanged & solved)
        marginal = xp.where(kind == PERTURBED, ~(survives & same), marginal)
        unit = kind == UNIT
        stable_now = xp.where(take, stable, before.stable > 0)
        stabilisable = survives | undecided | stable_now
        on_boundary = xp.where(
            kind == REGULARISED, survives & at.around, before.on_boundary > 0
        )
        success = xp.where(unchanged, solved, ~marginal & (~unit | survives))
        following = entry(xp.asarray(_NEXT), kind.astype(int), success.astype(int))
        kept = lambda new, old: xp.where(take, new, old)
        after = Verdict(
            kind=xp.where(unchanged & solved & ~at.near, DONE, following),
            residual=kept(at.residual, before.residual),
            unscaled=kept(at.unscaled, before.unscaled),
            bound=kept(at.bound, before.bound),
            gap=kept(at.gap, before.gap),
            solved=kept(solved, before.solved),
            stable=stable_now,
            marginal=marginal,
            stabilisable=xp.where(unit, stabilisable, before.stabilisable),
            on_boundary=xp.where(unit, undecided, on_boundary),
            iterations=before.iterations + xp.where(unchanged, at.iterations, 0),
        )
        return kept(at.point, best), numbers(*after, dtype=dtype)

    start = point, no_verdict(xp.where(well_posed, FIRST, DONE), dtype)
    return while_loop(lambda carry: carry[1][0] != DONE, body, start)


def no_verdict(kind: Any, dtype: Any) -> Array:
    """The verdict before the first attempt, which is of this `kind`. Residuals are
    infinite, and the pair counts as stabilisable."""
    most = xp.inf
    return numbers(kind, most, most, most, -most, 0, 0, 0, 1, 0, 0, dtype=dtype)


def weights(
    kind: Scalar, data: RiccatiData, by: Float[Array, " n"]
) -> tuple[RiccatiData, Scalar]:
    """The data of an attempt of this kind, and the size of the state weight."""
    Q, R, S = data.Q, data.R, data.S
    n, m, dtype = Q.shape[0], R.shape[0], Q.dtype
    eps = xp.finfo(dtype).eps
    # If Q is zero, R sets the scale.
    eye_Q, eye_R = xp.eye(n, dtype=dtype), xp.eye(m, dtype=dtype)
    size_Q, size_R = size(Q), size(R)
    scale_R = one_if_zero(size_R)
    scale_Q = xp.where(size_Q > 0, size_Q, scale_R)
    # A change of Q by eps is within the rounding of the data. A change by eps^(1/2)
    # moves eigenvalues off the boundary by about eps^(1/4).
    users = size(Q * (by[:, None] * by)) / by**2
    change = xp.where(kind == PERTURBED, -10 * n * eps * users, 0)
    change = xp.where(kind == REGULARISED, eps**0.5 * scale_Q, change)
    unit = kind == UNIT
    Q = xp.where(unit, scale_Q * eye_Q, Q + change * eye_Q)
    R = xp.where(unit, scale_R * eye_R, R)
    return data._replace(Q=Q, R=R, S=xp.where(unit, 0, S)), scale_Q


def units(data: RiccatiData) -> Float[Array, "2 n"]:
    """Diagonal balancing: powers of two that scale states and the rows of A, B and E.

    They make the row norm and the column norm of the Hamiltonian matrix equal for each
    state, because a badly scaled state is lost in the rounding of the others. A state
    with a zero row or column keeps its scale. The rows of E, if given, get equal norms.

    Source: Parlett and Reinsch, 1969 (balancing); Benner, 2001 (of a Hamiltonian).
    """
    A, B, Q, R, _, E = stop_gradient(data)
    n, dtype = A.shape[0], A.dtype
    lowest = xp.finfo(dtype).minexp
    plain_A, plain_B = (A, B) if E is None else (solve(E, A), solve(E, B))

    def logarithm(M):
        # As a vector, because one loop compiles faster than two over rows and columns.
        exponent = xp.log2(M.ravel())
        return xp.where(xp.isfinite(exponent), exponent, lowest).reshape(M.shape)

    # The quadratic blocks are squares of B R^-1/2 and Q^1/2, which have the scale of
    # one state and of the cost. The unit of the cost is free: it is one more row and
    # column, and its factor balances the two. All sizes are base-2 logarithms.
    effort = xp.sqrt(_diagonal_sizes(R))
    force = xp.max(xp.abs(plain_B) / one_if_zero(effort), axis=1)
    weight = xp.concatenate([xp.sqrt(_diagonal_sizes(Q)), xp.zeros(1, dtype)])
    table = xp.concatenate([xp.abs(plain_A), force[:, None]], axis=1)
    table = xp.concatenate([table, weight[None]])
    table = logarithm(xp.where(xp.eye(n + 1, dtype=bool), 0, table))

    def more(carry):
        k, change, _ = carry
        return (k < _SWEEPS) & (xp.max(xp.abs(change)) > 1 / 4)

    def sweep(carry):
        k, _, d = carry
        moved = table + d[:, None] - d
        # All scales change at once, so take half of the step of a single scale.
        change = (xp.max(moved, axis=0) - xp.max(moved, axis=1)) / 4
        # A zero row or column has the logarithm `lowest` and gives a huge step.
        change = xp.where(xp.abs(change) < -lowest / 8, change, 0)
        return k + 1, change, d + change

    start = xp.zeros(n + 1, dtype)
    *_, d = while_loop(more, sweep, (0, start + 1, start))
    # A factor common to all states has no effect. It is removed to avoid overflow.
    d = d[:n] - xp.mean(d[:n])
    f = d
    if E is not None:
        f = -xp.max(logarithm(xp.abs(E)) - d, axis=1)
    both = xp.stack([d, f])
    badly_scaled = xp.any(
        xp.max(both, axis=1) - xp.min(both, axis=1) > _BALANCE_THRESHOLD
    )
    return power_of_two(xp.exp2(xp.where(badly_scaled, both, 0)))


def _diagonal_sizes(M):
    # `jnp.diagonal` gathers, which is slower to compile.
    return xp.max(xp.where(xp.eye(len(M), dtype=bool), xp.abs(M), 0), axis=1)


def in_units(by: Float[Array, "2 n"], data: RiccatiData) -> RiccatiData:
    """The data with states and rows scaled `by` the factors of `units`."""
    # With the new state z = state x, the cost x'Qx is z'Qz / state^2. The rows of A, B
    # and E have their own scale, because an equation may be multiplied by a number.
    A, B, Q, R, S, E = data
    state, row = (unit[:, None] for unit in by)
    across = row / by[0]
    E = None if E is None else E * across
    Q = Q / (state * by[0])
    return RiccatiData(A * across, B * row, Q, R, S / state, E)
