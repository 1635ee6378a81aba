"""Games at a given level or at the smallest level, and the derivative of that level."""

import functools
from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax
from jaxtyping import Float

from .._check import check_step
from .._jax import custom_jvp, stop_gradient, vmap, while_loop, xp
from .._module import shown
from .._results import raise_on_failure, Result
from .._typing import Array, Scalar, Square
from ..math._linear_solve import full_precision, solve
from ..math._norms import size
from ._arguments import RiccatiData
from ._residual import stationary


_LOOSE = {4: 1e-3, 8: 1e-6}
"""The default tolerance of a level at which `X` has a pole, by the bytes of a float."""
_WIDEST = 1e18
"""The search gives up this factor away from its start."""
_FACTOR = 4.0
_MAX_TRIALS = 200
_SQUARINGS = 3
_AWAY = (1.0, 4.0, 16.0, 64.0)
_WEIGHTS = (64 / 21, -8 / 3, 2 / 3, -1 / 21)
"""The weights of values at distances proportional to `_AWAY`, in the extrapolation to
distance 0 by a polynomial in the square root of the distance."""


class GameSolution(eqx.Module):
    r"""The saddle point of an H-infinity game, stationary or over a finite horizon.

    Take the cost from state $x$ at step $t$, minus $\gamma^2$ times the sum of
    $w^\top w$. This value is at most $x^\top X_t x$, and the worst disturbance attains
    this bound. Over a finite horizon the matrices have a leading axis. In discrete time
    this axis runs over the $T$ steps, and in continuous time over the $N$ points of the
    time grid.

    **Attributes:**

    - `X`: the solution of the game equation, symmetric, shape `(n, n)`. Over a finite
        horizon in discrete time, `X` has one matrix for each step and one for the end,
        shape `(T+1, n, n)`. In continuous time, it has one matrix for each point of the
        time grid, shape `(N, n, n)`.
    - `K`: the gain of the control $u = -K x$, shape `(m, n)`; over a finite horizon
        `(T, m, n)` in discrete time, or `(N, m, n)` in continuous time.
    - `L`: the gain of the worst disturbance $w = L x$, shape `(k, n)`; over a finite
        horizon `(T, k, n)` in discrete time, or `(N, k, n)` in continuous time.
    - `gamma`: the level $\gamma$ that the control attains; infinite if no level was
        found.
    - `closed_loop`: the matrix $A - B K$, shape `(n, n)`; over a finite horizon
        `(T, n, n)` in discrete time, or `(N, n, n)` in continuous time.
    - `result`: success, or the reason for a failure; one of `delucax.RESULTS`.
    - `residual`: an upper bound on the relative residual: the norm of the residual of
        the equation, divided by the sum of the norms of its terms. The bound includes
        the rounding errors that the computation of the residual makes. `None` over a
        horizon.
    - `iterations`: the number of doubling steps that the solver takes at the level
        `gamma`. `None` over a horizon.
    - `spectral_radius`: in discrete time, a close upper bound on the spectral radius of
        `closed_loop`. `spectral_radius` is `None` in continuous time and over a finite
        horizon.
    - `spectral_abscissa`: in continuous time, the largest real part of an eigenvalue of
        `closed_loop`, up to rounding. `spectral_abscissa` is `None` in discrete time
        and over a finite horizon.

    `residual`, `spectral_radius` and `spectral_abscissa` are diagnostics and have no
    gradient.

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp

        A = jnp.array([[1.0, 1.0], [0.0, 1.0]])
        B = jnp.array([[0.0], [1.0]])
        Q, R = jnp.eye(2), jnp.eye(1)
        solution = dlx.riccati.hinf_dare(A, B, None, Q, R, gamma=5.0)
        solution.K, solution.L
        ```

        ```text
        (Array([[0.497, 1.37 ]], dtype=float32), Array([[0.087, 0.107],
               [0.02 , 0.055]], dtype=float32))
        ```
    """

    X: Array
    K: Array
    L: Array
    gamma: Array
    closed_loop: Array
    result: Result
    residual: Array | None = None
    iterations: Array | None = None
    spectral_radius: Array | None = None
    spectral_abscissa: Array | None = None

    __repr__ = shown


def joint_inputs(B, D, R, gamma) -> tuple[Array, Array]:
    """`[B D]`, the input matrix of the joint control `[u; w]`, and its weight."""
    m, k = B.shape[-1], D.shape[-1]
    nothing = xp.zeros((*R.shape[:-2], m, k), R.dtype)
    # gamma^2 w'w is subtracted from the cost.
    worth = -(gamma**2) * xp.eye(k, dtype=R.dtype)
    worth = xp.broadcast_to(worth, (*R.shape[:-2], k, k))
    weight = xp.block([[R, nothing], [nothing.mT, worth]])
    return xp.concatenate([B, D], axis=-1), weight


def joint(problem: tuple, gamma: Scalar) -> RiccatiData:
    """The equation of the game `(A, B, D, Q, R)`."""
    A, B, D, Q, R = problem
    both, weight = joint_inputs(B, D, R, gamma)
    return RiccatiData(A, both, Q, weight, xp.zeros_like(both), None)


def joint_gain(discrete: bool, data: RiccatiData, X: Square) -> Array:
    """The gains `K` of the joint control `[u; w] = -K x`."""
    _, cross, weight = stationary(discrete, data, X)
    return solve(weight, cross.T)


def at_level(solver, where, discrete, problem, gamma, tolerance, throw) -> GameSolution:
    """Check `gamma` and `tolerance`, and call `solver`, with the game at a given level
    or at the smallest level."""
    dtype = problem[0].dtype
    if tolerance is None:
        tolerance = 16 * xp.finfo(dtype).eps if discrete else _LOOSE[dtype.itemsize]
    check_step(tolerance, where, "tolerance")
    if gamma is not None:
        check_step(gamma, where, "gamma")
        gamma = xp.asarray(gamma, dtype)
    solution = solver(discrete, problem, gamma, xp.asarray(tolerance, dtype))
    facts = lambda: f"Level gamma {float(solution.gamma):.6g}."
    return raise_on_failure(solution, where, throw, facts=facts)


class Game(NamedTuple):
    """A solution of a game equation, and whether it is a saddle point."""

    X: Array
    residual: Array
    holds: Array  # whether all conditions but the equation hold
    solved: Array  # whether the equation is solved
    iterations: Array
    distance: Array  # a number that decreases to zero at the smallest level

    @property
    def good(self) -> Array:
        return self.holds & self.solved


class Bisection(NamedTuple):
    """The state of the bisection for the smallest level.

    A point is `gamma^-2` and the `distance` at a feasible level.
    """

    low: Array
    high: Array
    point: Float[Array, "2"]  # at the upper end
    estimate: Array  # of the smallest level, from the last two points
    error: Array  # of the estimate
    width_before: Array  # of the bracket, before the last trial
    start: Array
    solvable: Array  # whether there is a solution without a disturbance
    affected: Array  # whether the disturbance has any effect on the cost
    base: Array  # the solution without a disturbance
    game: Game
    trials: Array

    @property
    def is_attained(self) -> Array:
        """Whether a level was found."""
        return xp.isfinite(self.high) & self.solvable


Barrier = Callable[[tuple, Array], Array]
Solve = Callable[[tuple, Array, Array], Game]
"""A function `((A, B, D, Q, R, *others), gamma, X0) -> game`. `X0` is below the
solution, and the iteration increases from it to the solution."""


def bisect_level(
    solve_game: Solve,
    problem: tuple,
    start: Array,
    gamma: Array | None = None,
    tolerance: Array | float = 0.0,
) -> tuple[Bisection, Array]:
    """The game at `gamma` or at the smallest level, and the level, without derivatives.

    The first trial starts at `start` and has no disturbance. It shows whether any level
    is feasible, and gives the scale of the bracket. The other trials start at its
    solution. The level is the feasible, upper end of a bracket of relative width
    `tolerance`, or 0 if the disturbance has no effect on the cost.
    """
    problem, start, gamma = stop_gradient((problem, start, gamma))
    A, B, D, *others = problem
    one = xp.ones((), A.dtype)

    def more(now):
        if gamma is not None:
            return (now.trials == 0) | (now.solvable & (now.trials < 2))
        # The bracket grows, within limits, until both ends are known. Then it shrinks.
        open_end = xp.isinf(now.high) | (now.low == 0)
        wide = now.high > now.low * (1 + tolerance)
        near = (now.low < _WIDEST * now.start) & (now.high > now.start / _WIDEST)
        going = xp.where(open_end, near, wide) & (now.trials < _MAX_TRIALS)
        return (now.trials == 0) | (now.solvable & now.affected & going)

    def body(now):
        first = now.trials == 0
        if gamma is None:
            # Increase the level by factors until it is feasible, decrease it until it
            # is not, then bisect the logarithms: the level may have any size.
            known = xp.where(xp.isinf(now.high), 1, now.high)
            up = xp.where(now.low == 0, now.start, _FACTOR * now.low)
            down = xp.where(now.low == 0, known / _FACTOR, _within(now, tolerance))
            trial = xp.where(xp.isinf(now.high), up, down)
        else:
            trial = gamma
        trial = xp.where(first, one, trial)
        tried = (A, B, xp.where(first, 0, D), *others)
        game = solve_game(tried, trial, now.base)
        good = game.good
        point = xp.stack([xp.where(first, 0, trial**-2.0), game.distance])
        # The bracket starts at a typical level. Its square is trace D'XD, the cost of a
        # unit disturbance.
        X = game.X[1:] if D.ndim == 3 else game.X
        effect = xp.sum(D * (X @ D))
        size = xp.linalg.norm(X) * xp.sum(D**2)
        slack = 10 * A.shape[-1] * xp.finfo(A.dtype).eps * size
        at_first = now._replace(
            start=xp.sqrt(xp.maximum(effect, xp.finfo(A.dtype).tiny)),
            solvable=good,
            affected=effect > slack,
            base=game.X,
            game=game,
            point=point,
        )
        # No number is left between the ends, so the bracket closes.
        stuck = (trial <= now.low) | (trial >= now.high)
        better = good & ~stuck
        # The distance is nearly linear in gamma^-2, so take the secant.
        place, value = point
        slope = (now.point[1] - value) / (now.point[0] - place)
        estimate = (place - value / slope) ** -0.5
        # The change is the error of the last estimate. The new error is smaller by the
        # ratio of the distances.
        error = xp.abs(estimate - now.estimate) * (value / now.point[1])
        # A search keeps the best game. At a given level the game is kept in any case.
        keep = better if gamma is None else xp.ones((), bool)
        later = now._replace(
            low=xp.where(stuck, now.high, xp.where(good, now.low, trial)),
            high=xp.where(better, trial, now.high),
            point=xp.where(better, point, now.point),
            estimate=xp.where(better, estimate, now.estimate),
            error=xp.where(better, error, now.error),
            width_before=now.high - now.low,
            game=_where(keep | (now.trials == 1), game, now.game),
        )
        return _where(first, at_first, later)._replace(trials=now.trials + 1)

    no, nothing = xp.zeros((), bool), xp.asarray(0)
    begin = Bisection(
        low=0 * one,
        high=xp.inf * one,
        start=one,
        solvable=no,
        affected=no,
        base=start,
        point=xp.inf * xp.ones(2, A.dtype),
        estimate=xp.inf * one,
        error=xp.inf * one,
        width_before=xp.inf * one,
        game=Game(start, one, no, no, nothing, one),
        trials=nothing,
    )
    end = while_loop(more, body, begin)
    if gamma is not None:
        return end, gamma
    level = xp.where(end.is_attained, end.high, one)
    return end, xp.where(end.solvable & ~end.affected, 0, level)


def _within(now: Bisection, tolerance: Array | float) -> Array:
    """The next level to try, within the bracket.

    It is above or below the estimate of the smallest level by the uncertainty of the
    estimate, on the side that cuts off more of the bracket.
    """
    low, high, estimate = now.low, now.high, now.estimate
    width, middle = high - low, xp.sqrt(low * high)
    error = xp.maximum(4 * now.error, tolerance * estimate / 4)
    above, below = estimate + error, estimate - error
    trial = xp.where(high - above > below - low, above, below)
    # Bisection is better if this cuts off less than half, or if the last trial did not
    # shrink the bracket enough.
    good = xp.maximum(high - above, below - low) > width / 2
    good = good & (estimate > low) & (estimate < high)
    good = good & (trial > low) & (trial < high) & (width < 0.7 * now.width_before)
    return xp.where(good, trial, middle)


def game_at_level(
    solve_game: Solve, barrier: Barrier, problem, start, gamma, tolerance
) -> tuple[Bisection, Array, Array]:
    """The game at `gamma` or at the smallest level, the level (1 instead of 0), and the
    level itself with its derivatives."""
    end, level = bisect_level(solve_game, problem, start, gamma, tolerance)
    if gamma is None:
        attained = with_derivative(barrier, problem, level)
        known = end.is_attained | end.solvable & ~end.affected
        attained = xp.where(known, attained, xp.inf)
    else:
        attained = level = gamma
    return end, xp.where(level > 0, level, 1), attained


def _where(condition, first, second):
    return jax.tree.map(lambda a, b: xp.where(condition, a, b), first, second)


@functools.partial(custom_jvp, nondiff_argnums=(0,))
def with_derivative(barrier: Barrier, problem: tuple, level: Array):
    """The smallest level, with its derivative with respect to the problem.

    `barrier(problem, gamma)` is any function whose value or slope diverges at the
    smallest level. Its level sets move with the problem as the smallest level does.
    """
    del barrier, problem
    return level


@with_derivative.defjvp
@full_precision
def _with_derivative_jvp(barrier, primals, tangents):
    # Implicit differentiation of barrier(problem, gamma) = constant just above the
    # level. At the level both slopes are infinite, but their quotient has a limit.
    problem, level = primals
    level = once_differentiable(level)
    problem = jax.tree.map(once_differentiable, problem)
    # d gamma = -(d barrier / d problem) / (d barrier / d gamma).
    still = jax.tree.map(xp.zeros_like, problem)
    attained = level > 0
    safe = xp.where(attained, level, 1)

    def at_distance(away):
        along = functools.partial(jax.jvp, barrier, (problem, safe * (1 + away)))
        _, slope = along((still, xp.ones_like(safe)))
        _, change = along((tangents[0], xp.zeros_like(safe)))
        return -change / xp.where(slope != 0, slope, 1)

    # The error is a series in the square root of the distance, because two eigenvalues
    # may meet on the boundary. Extrapolation from four distances removes its first
    # terms.
    away = xp.finfo(level.dtype).eps ** (3 / 8) * xp.asarray(_AWAY, level.dtype)
    tangent = vmap(at_distance)(away) @ xp.asarray(_WEIGHTS, level.dtype)
    return primals[1], xp.where(attained, tangent, 0)


@custom_jvp
def once_differentiable(x: Array) -> Array:
    """Return `x`, and raise an error at a second differentiation.

    The slope of the barrier diverges in the limit, so its derivative would be rounding
    error.
    """
    return x


@once_differentiable.defjvp
def _once_differentiable_jvp(primals, tangents):
    raise NotImplementedError(
        "The smallest attainable gamma has first derivatives only. For higher "
        "derivatives of the solution, give gamma as an argument."
    )


def inverse_margin(D: Array, X: Square, gamma: Scalar) -> Array:
    """`(I - D'XD / gamma^2)^-1`."""
    eye = xp.eye(D.shape[1], dtype=D.dtype)
    return solve(eye - D.T @ X @ D / gamma**2, eye)


def largest_eigenvalue(X: Square) -> Scalar:
    """A close upper bound on the largest eigenvalue of a semidefinite matrix."""
    unit = size(X)
    power = X / unit
    for _ in range(_SQUARINGS):
        power = power @ power
    return unit * size(power) ** (0.5**_SQUARINGS)


def inverse_margins(
    D: Float[Array, "T n k"], X: Float[Array, "T n n"], gamma: Scalar
) -> Scalar:
    """The sum of the traces of `(gamma^2 I - D'XD)^-1`, in the unit of `X`."""
    eye = xp.eye(D.shape[-1], dtype=D.dtype)
    margins = gamma**2 * eye - xp.swapaxes(D, 1, 2) @ X @ D
    inverses = vmap(lambda M: xp.trace(solve(M, eye)))(margins)
    # In the unit of X, because the sum is added to the trace of X.
    return stop_gradient(gamma**2 * xp.linalg.norm(X)) * xp.sum(inverses)
