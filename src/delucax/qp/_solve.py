"""The solver of quadratic programs, and the judgement of its result."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from .._check import check_bool, check_count, check_instance, check_range, is_concrete
from .._jax import quickly_compiled
from .._results import choose, raise_on_failure, Result, RESULTS
from .._typing import Array, RealScalar
from ..math._linear_solve import full_precision
from ._dense_problem import Dense
from ._derivatives import optimum, Options
from ._embedding import Outcome, Tolerances
from ._form import AbstractForm
from ._solution import Solution
from ._staged_problem import Staged


_LOOSE = 1e2
"""A result within this many times the tolerance is `inaccurate`, not a failure."""


def solve(
    problem: Dense | Staged,
    *,
    start: Solution | None = None,
    rtol: RealScalar | None = None,
    atol: RealScalar | None = None,
    max_steps: int = 100,
    refinements: int = 3,
    throw: bool = True,
) -> Solution:
    r"""Solve a convex quadratic program, or show that it has no solution.

    The solver first guesses which lower and upper bounds of the constraints are active.
    Each guess gives a linear system, whose solution gives the next guess. Most
    quadratic programs in control are solved after a few guesses. If the guesses do not
    lead to a solution, a predictor-corrector interior-point method on the homogeneous
    embedding finds a solution, or a certificate that no solution exists.

    You can differentiate the solution, in forward and reverse mode, with respect to
    every array of the problem. The derivative comes from the implicit function theorem,
    where bounds with positive multipliers stay active. The derivative is NaN if the
    solution is not unique, if an active bound has a multiplier of zero, or if the solve
    failed. Residuals and certificates have no derivatives, and the solution has no
    derivative with respect to the start.

    **Arguments:**

    - `problem`: a [`delucax.qp.Dense`][] or a [`delucax.qp.Staged`][].
    - `start`: the solution of an earlier problem with the same shapes. The bounds that
        are active in this solution are the first guess. If the problem has changed
        little, one or two iterations are enough. A start that is not finite is ignored.
        By default the first guess is that no bound is active.
    - `rtol`, `atol`: tolerances. A residual may be at most `atol + rtol * size`, where
        `size` is the size of the terms whose sum is the residual. Both tolerances are
        `1e-8` by default, or `1e-4` in single precision.
    - `max_steps`: the largest number of iterations, 100 by default.
    - `refinements`: the largest number of refinements of each linear system, 3 by
        default. The solver makes refinements only if rounding errors require them.
    - `throw`: raise an error if the solver finds no solution (default). If false, check
        `result`.

    **Returns:** a [`delucax.qp.Solution`][], whose residuals are in the units of the
    given problem. `result` is one of

    - `RESULTS.successful`: the residuals are within the tolerance.
    - `RESULTS.no_feasible_point`, `RESULTS.unbounded`: the program has no solution, and
        the solver has checked the certificate that proves this.
    - `RESULTS.inaccurate`: the iteration ended near the tolerance, but not within it.
    - `RESULTS.ill_posed`: the data are not finite, or the cost is not convex.
    - `RESULTS.not_converged`: the solver stopped for another reason.

    **Raises:** `ValueError` if an argument has the wrong type, shape or value. With
    `throw`, an error at run time if the solver finds no solution.

    Source: Hintermueller, Ito and Kunisch, 2002 (active sides); Mehrotra, 1992;
    Andersen and Ye, 1999; Goulart and Chen, 2024.

    !!! example

        ```python
        import delucax as dlx
        import jax
        import jax.numpy as jnp

        def least(q):
            problem = dlx.qp.Dense(jnp.eye(2), q, bounds=(0.0, 1.0))
            return dlx.qp.solve(problem).x

        jax.jacobian(least)(jnp.array([-2.0, -0.5]))
        ```

        ```text
        Array([[ 0.,  0.],
               [ 0., -1.]], dtype=float32)
        ```
    """
    where = "solve"
    if not isinstance(problem, Dense | Staged):
        raise ValueError(
            f"{where}: problem must be a `delucax.qp.Dense` or a `delucax.qp.Staged`, "
            f"got {type(problem).__name__}."
        )
    if start is not None:
        check_instance(start, Solution, "start", where, "")
    near = None if start is None else (start.x, start.u, start.multipliers)
    dtype = jnp.result_type(*jax.tree.leaves(problem))
    usual = 1e-8 if dtype == jnp.float64 else 1e-4
    for name, value in (("rtol", rtol), ("atol", atol)):
        if value is not None:
            check_range(value, name, where)
    numbers = (usual if tol is None else tol for tol in (atol, rtol))
    atol, rtol = (as_scalar(number, dtype) for number in numbers)
    max_steps = check_count(max_steps, "max_steps", where)
    refinements = check_count(refinements, "refinements", where, 0)
    check_bool(throw, "throw", where)
    given = problem, near, atol, rtol
    solution = _solved(*given, max_steps, refinements)
    facts = lambda: _facts(problem, solution)
    return raise_on_failure(solution, where, throw, facts=facts)


def as_scalar(number: Any, dtype: Any) -> Any:
    """A number as a scalar argument of a compiled program."""
    if is_concrete(number):
        return np.asarray(number, dtype)
    return number.astype(dtype)


@quickly_compiled
@full_precision
def _solved(problem, start, atol, rtol, max_steps, refinements) -> Solution:
    form = problem.form()
    dtype = form.q.dtype
    certificate = jnp.asarray(1e-8 if dtype == jnp.float64 else 1e-4, dtype)
    atol, rtol = jnp.asarray(atol, dtype), jnp.asarray(rtol, dtype)
    if start is not None:
        start = _fitting(problem, form, start)
    tolerances = Tolerances(atol, rtol, certificate)
    options = lax.stop_gradient(Options(start, tolerances, max_steps, refinements))
    point = optimum(form, options)
    is_posed = _is_posed(problem, form)
    result, is_certificate = _judged(point, is_posed)
    infeasible, unbounded = is_certificate
    x, p, z = _certified(form, point, infeasible, unbounded)
    cost = form.cost(x)
    cost = jnp.where(infeasible, jnp.inf, jnp.where(unbounded, -jnp.inf, cost))
    # The multiplier of an equation has either sign, which selects one of its two sides.
    equality = form.sides().equality
    lower = jnp.where(equality[0], jnp.maximum(-z[0], 0), z[1])
    upper = jnp.where(equality[0], jnp.maximum(z[0], 0), z[0])
    multipliers = problem.multipliers(p, jnp.stack([upper, lower]))
    answer: Any = *problem.primal(x), multipliers, cost, *point.measured
    answers: Any = *answer, point.iterations, result
    return Solution(*answers)


def _fitting(problem: Dense | Staged, form: AbstractForm, start: Any) -> Any:
    """Check that a start fits the problem, and return its unknowns."""
    wanted = [form.q.shape, form.f.shape, (2, *form.lower.shape)]
    try:
        unknowns = problem.unknowns(*start)
        fits = [a.shape for a in unknowns] == wanted
    except (AttributeError, IndexError, TypeError, ValueError):
        fits, unknowns = False, None
    if not fits:
        raise ValueError(
            "solve: start must be the solution of a problem of the same kind, sizes "
            "and constraints."
        )
    return unknowns


def _judged(point: Outcome, is_posed: Array) -> tuple[Result, Any]:
    """The status, and whether the point is one of the two certificates."""
    error = point.errors[0]
    solved = error <= 1
    infeasible = ~solved & (point.errors[1] <= 1)
    unbounded = ~solved & ~infeasible & (point.errors[2] <= 1)
    result = choose(error <= _LOOSE, RESULTS.inaccurate, RESULTS.not_converged)
    result = choose(unbounded, RESULTS.unbounded, result)
    result = choose(infeasible, RESULTS.no_feasible_point, result)
    result = choose(solved, RESULTS.successful, result)
    return choose(is_posed, result, RESULTS.ill_posed), (infeasible, unbounded)


def _is_posed(problem: Dense | Staged, form: AbstractForm) -> Array:
    """Whether the data are finite, and the cost convex up to rounding."""
    bounds = (jnp.where(jnp.isinf(b), 0, b) for b in (form.lower, form.upper))
    arrays = *problem.data(), form.q, form.f, *bounds
    posed = jnp.all(jnp.isfinite(jnp.concatenate([jnp.ravel(a) for a in arrays])))
    # Traced bounds and weights have not been checked yet.
    posed = posed & jnp.all(form.lower < jnp.inf) & jnp.all(form.upper > -jnp.inf)
    if form.soft is not None:
        posed = posed & jnp.all(jnp.stack(form.soft) >= 0)
    for hessian in problem.hessians():
        n, size = hessian.shape[-1], jnp.max(jnp.abs(hessian), initial=0)
        # Rounding of a product C'C may make it indefinite by this much.
        slack = 100 * n * jnp.finfo(size.dtype).eps * jnp.where(size > 0, size, 1)
        L = jnp.linalg.cholesky(hessian + slack * jnp.eye(n, dtype=size.dtype))
        posed = posed & jnp.all(jnp.isfinite(L))
    return posed


def _certified(form: AbstractForm, point: Outcome, infeasible: Array, unbounded: Array):
    """The point, or the normalised certificate, with NaN for the other unknowns."""
    sides = form.sides()
    at = lax.stop_gradient(point)
    p, z = at.p, jnp.where(sides.soft, 0, at.z)
    support, slope = at.gains
    unit = lambda fails, size: jnp.where(fails, jnp.abs(size), 1)
    dual, primal = unit(infeasible, support), unit(unbounded, slope)

    def either(value, certificate, is_certificate, has_none):
        # A zero with the derivative of the failed solve, which is NaN.
        zero = jnp.where(jnp.isfinite(value), value, 0)
        zero = zero - lax.stop_gradient(zero)
        value = jnp.where(is_certificate, certificate + zero, value)
        return jnp.where(has_none, jnp.nan + zero, value)

    x = either(point.x, at.x / primal, unbounded, infeasible)
    p = either(point.p, p / dual, infeasible, unbounded)
    return x, p, either(point.z, z / dual, infeasible, unbounded)


def _facts(problem: Dense | Staged, solution: Solution) -> str:
    """A sentence about the constraint that contributes most to a certificate."""
    if not (solution.result == RESULTS.no_feasible_point):
        return ""
    given: Any = solution.x, solution.u, solution.multipliers
    _, p, z = problem.unknowns(*given)
    form = problem.form()
    sides = form.sides()

    def largest(heights):
        heights = np.abs(np.asarray(heights))
        if not heights.size:
            return 0.0, ()
        index = np.unravel_index(heights.argmax(), heights.shape)
        return heights[index], tuple(map(int, index))

    (bound, side), (value, row) = largest(sides.h * z), largest(form.f * p)
    # Name an equation, such as a step, only if equations contradict each other alone.
    alone = bound <= 1e-6 * value
    where = problem.equation(*row) if alone else problem.place(*side)
    return f"{where[0].upper()}{where[1:]} contributes most to the certificate."
