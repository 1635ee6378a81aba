"""A linear window with bounds, solved by an active-set method.

An active bound is treated as an observation without noise, so the solution for a guess
of the active set takes one pass of the smoother. Its multipliers and violations give
the next guess. If the guesses do not settle, an interior-point method finds the active
set. There, a bound is an observation whose noise decreases.

Source: Hintermueller, Ito and Kunisch, 2002 (guesses); Mehrotra, 1992.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jax import lax

from .._results import choose, Result, RESULTS
from .._typing import Array
from ._base import Belief
from ._window_smoother import Rows, Smoothed, smoothed, Steps


_GUESSES = 10
"""The maximum number of guesses of the active set."""
_PATIENCE = 3
"""The guesses end early if so many in a row do not reduce the number of wrong bounds.
"""
_BARRIERS = 50
"""The maximum number of interior-point steps."""
_TO_BOUNDARY = 0.99
_LOOSE = 30
"""A bound that is violated by more than this many slacks counts as infeasible."""


class Limits(NamedTuple):
    """The bounds of some entries of `(d, w)`, shape `(N, q)`, infinite for none, and
    the indices of these entries."""

    low: Array
    high: Array
    entries: tuple[int, ...]


class Bounded(NamedTuple):
    """The solution with bounds."""

    solution: Smoothed
    free: Smoothed  # the solution without bounds
    sides: Array  # (N, q): 1 at the upper bound, -1 at the lower one, else 0
    result: Result


class _Problem(NamedTuple):
    """The window, its bounds, and the scale of the bounded entries."""

    steps: Steps
    rows: Rows
    start: Belief
    W: Array
    low: Array
    high: Array
    units: Array  # (q, n) or (q, n + k), unit vectors of the bounded entries
    width: Array  # (N, q), the standard deviations without bounds

    def bounded(self, on: Array, variance: Array, target: Array) -> Smoothed:
        """The solution with additional observations of the bounded entries."""
        c = jnp.where(on[:, :, None], self.units, 0)
        more = Rows(c, variance, jnp.where(on, target, 0))
        return smoothed(self.steps, self.rows.beside(more), self.start, self.W)

    @property
    def give(self) -> Array:
        """The variance of an active bound.

        It is not zero, because active bounds of one quantity at many stages may depend
        on each other.
        """
        return 30 * float(jnp.finfo(self.W.dtype).eps) * self.width**2

    def held(self, sides: Array) -> Smoothed:
        """The solution with these bounds active."""
        target = jnp.where(sides > 0, self.high, self.low)
        return self.bounded(sides != 0, self.give, target)

    def at(self, solution: Smoothed) -> Array:
        """The bounded entries of a solution."""
        z = jnp.concatenate([solution.d, solution.zeta @ self.W], axis=1)
        return z[:, : self.units.shape[1]] @ self.units.T

    def multipliers(self, solution: Smoothed) -> Array:
        """The multipliers of the bounds in a solution."""
        return solution.u[:, self.rows.c.shape[1] :]


def smoothed_between(
    steps: Steps, rows: Rows, limits: Limits, start: Belief, W: Array, guess: Array
) -> Bounded:
    """The solution of the window with bounds. It is differentiated with the active set
    fixed."""
    low, high, entries = limits
    n = steps.A.shape[1]
    free = smoothed(steps, rows, start, W)
    own = jnp.broadcast_to(jnp.diagonal(W), (len(low), len(W)))
    at = jnp.array(entries)
    variances = jnp.concatenate([free.variances, own], axis=1)[:, at]
    width = jnp.sqrt(lax.stop_gradient(variances))
    size = n if max(entries) < n else n + len(W)
    units = jnp.eye(size, dtype=W.dtype)[at]
    problem = _Problem(steps, rows, start, W, low, high, units, width)
    constant, fixed = lax.stop_gradient((problem, free))
    none = jnp.zeros(low.shape, int)
    first, _ = _corrected(constant, fixed, none, jnp.zeros_like(low))
    is_needed = jnp.any(first != none)
    begin = jnp.where(is_needed, guess, none)
    sides, done = _guessed(constant, begin, ~is_needed)

    def barrier(sides):
        del sides
        return _guessed(constant, _by_barrier(constant, fixed), jnp.asarray(False))

    sides, done = lax.cond(done, lambda s: (s, jnp.asarray(True)), barrier, sides)

    def unheld(problem, sides):
        pad = (0, 0), (0, sides.shape[1])
        return free._replace(u=jnp.pad(free.u, pad))

    held = lambda problem, sides: problem.held(sides)
    solution = lax.cond(is_needed, held, unheld, problem, sides)
    result = _judged(constant, lax.stop_gradient(solution))
    result = choose(done, result, RESULTS.not_converged)
    return Bounded(solution, free, sides, result)


def _judged(problem: _Problem, solution: Smoothed) -> Result:
    """The status: whether the bounds hold, up to rounding."""
    z, info = problem.at(solution), jnp.finfo(problem.W.dtype)
    ends = problem.low, problem.high
    sizes = (jnp.where(jnp.isfinite(a), jnp.abs(a), 0) for a in ends)
    slack = jnp.sqrt(problem.give) + float(info.eps) ** 0.4 * jnp.maximum(*sizes)
    slack = jnp.maximum(slack, float(info.tiny) ** 0.5)
    worst = jnp.max(jnp.maximum(z - problem.high, problem.low - z) / slack)
    result = choose(worst <= 1, RESULTS.successful, RESULTS.inaccurate)
    return choose(worst <= _LOOSE, result, RESULTS.no_feasible_point)


def _corrected(problem: _Problem, solution: Smoothed, sides: Array, u: Array):
    """The next guess of the active set, and the number of bounds that it changes."""
    z, width = problem.at(solution), problem.width
    near = float(jnp.finfo(z.dtype).eps) ** 0.6
    # A bound cannot move an entry without variance.
    off = (sides == 0) & (width > 0)
    to_high = off & (z - problem.high > near * width)
    to_low = off & (problem.low - z > near * width)
    # An upper bound pulls its entry down, so its multiplier must be negative.
    leaves = (u * sides * width > near) & (problem.low < problem.high)
    after = jnp.where(leaves, 0, sides)
    after = jnp.where(to_high, 1, jnp.where(to_low, -1, after))
    return after, jnp.sum(after != sides)


def _guessed(problem: _Problem, sides: Array, done: Array) -> tuple[Array, Array]:
    """The active set after repeated guesses, and whether the guesses settled."""

    def body(carry):
        sides, best, patience, k, _ = carry
        solution = problem.held(sides)
        u = problem.multipliers(solution)
        after, count = _corrected(problem, solution, sides, u)
        patience = jnp.where(count < best, _PATIENCE, patience - 1)
        return after, jnp.minimum(count, best), patience, k + 1, count == 0

    def going(carry):
        _, _, patience, k, done = carry
        return ~done & (k < _GUESSES) & (patience > 0)

    counts = (jnp.asarray(count) for count in (sides.size + 1, _PATIENCE, 0))
    sides, _, _, _, done = lax.while_loop(going, body, (sides, *counts, done))
    return sides, done


def _by_barrier(problem: _Problem, free: Smoothed) -> Array:
    """The active set by an interior-point method (Mehrotra's predictor-corrector).

    The arrays `s` and `z` hold the upper bounds first, then the lower ones.
    """
    both = lambda a: jnp.stack([a, -a])
    width, dtype = problem.width, problem.W.dtype
    h = jnp.stack([problem.high, -problem.low])
    fixed = problem.low == problem.high
    on = jnp.isfinite(h) & (width > 0) & ~fixed
    h = jnp.where(on, h, 0)
    unit = jnp.where(width > 0, width, 1)
    count = jnp.sum(on) + 1
    end = float(jnp.finfo(dtype).eps) ** 0.6
    mean = lambda s, z: jnp.sum(jnp.where(on, s * z, 0)) / count

    def turn(carry, s, z, mu):
        """One step: first the predictor, then with a second-order correction."""
        ds, dz, aim = carry
        push = (aim - jnp.where(aim > 0, ds * dz, 0)) / s
        rate = jnp.where(on, z / s, 0)
        weight = jnp.sum(rate, axis=0)
        pulled = jnp.where(on, rate * h - z - push, 0)
        target = (pulled[0] - pulled[1]) / jnp.where(weight > 0, weight, 1)
        variance = 1 / jnp.where(weight > 0, weight, 1)
        variance = jnp.where(fixed, problem.give, variance)
        target = jnp.where(fixed, problem.high, target)
        solution = problem.bounded((weight > 0) | fixed, variance, target)
        s_new = h - both(problem.at(solution))
        ds, dz = s_new - s, push - rate * s_new
        length = _length(jnp.where(on, s, 1), jnp.where(on, ds, 0))
        length = jnp.minimum(length, _length(jnp.where(on, z, 1), jnp.where(on, dz, 0)))
        left = mean(s + length * ds, z + length * dz)
        return (ds, dz, mu * (left / mu) ** 3), length

    def body(carry):
        s, z, gap, k = carry
        mu = mean(s, z)
        zero = jnp.zeros_like(s), jnp.zeros_like(z), jnp.zeros((), dtype)

        def twice(_, carry):
            return turn(carry[0], s, z, mu)

        (ds, dz, _), length = lax.fori_loop(0, 2, twice, (zero, jnp.zeros((), dtype)))
        length = jnp.minimum(_TO_BOUNDARY * length, 1)
        s = jnp.where(on, s + length * ds, 1)
        z = jnp.where(on, z + length * dz, 1)
        return s, z, (1 - length) * gap, k + 1

    def going(carry):
        s, z, gap, k = carry
        return ((mean(s, z) > end) | (gap > end)) & (k < _BARRIERS)

    s = jnp.maximum(h - both(problem.at(free)), unit)
    s = jnp.where(on, s, 1)
    start = s, jnp.where(on, 1 / s, 1), jnp.ones((), dtype), jnp.asarray(0)
    s, z, *_ = lax.while_loop(going, body, start)
    active = on & (z * unit > s / unit)
    sides = jnp.where(active[0], 1, jnp.where(active[1], -1, 0))
    return jnp.where(fixed, 1, sides)


def _length(a: Array, da: Array) -> Array:
    """The largest step length, at most 1, that keeps `a` nonnegative."""
    return 1 / jnp.maximum(jnp.max(-da / a, initial=0), 1)
