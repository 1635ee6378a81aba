"""The stabilising solution of an algebraic Riccati equation, in discrete or continuous
time."""

import functools
from typing import NamedTuple

import equinox as eqx
import jax

from .._jax import compiled_unless_on_host, custom_jvp, matmul, stop_gradient, xp
from .._module import shown
from .._results import raise_on_failure, Result
from .._typing import Array, BoolScalar, Square
from ..math._linear_solve import (
    factorised,
    full_precision,
    is_definite,
    no_tangent,
    solve,
    symmetric,
)
from ..math._lyapunov import lyapunov
from ..math._norms import one_if_zero, size
from ._arguments import (
    complex_form,
    is_complex,
    real_form,
    RiccatiData,
    where_solved,
)
from ._doubling import continuous_start, discrete_start
from ._recursion import is_clearly_definite
from ._residual import (
    if_needed,
    is_small,
    matrices_of,
    newton_refine,
    riccati_residual,
    stationary,
)
from ._search import (
    Attempt,
    DONE,
    in_units,
    no_verdict,
    search,
    SECOND,
    units,
    Verdict,
    weights,
)
from ._spectrum import abscissa_and_size, spectral_radius


_SECOND_START = 1e4
"""The second start of doubling is larger than the first by this factor, because `X` may
be far larger than `Q`, for example if a control is weak."""


class RiccatiSolution(eqx.Module):
    r"""The solution of an algebraic Riccati equation, with diagnostics.

    **Attributes:**

    - `X`: the solution, shape `(n, n)`, symmetric.
    - `K`: the gain of the control $u = -K x$, shape `(m, n)`; for a filter, the gain of
        the correction $K (y - C \hat{x})$, shape `(n, p)`.
    - `residual`: an upper bound on the relative residual: the norm of the residual of
        the equation, divided by the sum of the norms of its terms. The bound includes
        the rounding errors that the computation of the residual makes.
    - `closed_loop`: the matrix of the closed loop, shape `(n, n)`: $A - B K$, or
        $E^{-1} (A - B K)$ with a descriptor matrix $E$; for a filter $A - K C$.
    - `spectral_radius`: in discrete time, an upper bound on the spectral radius of
        `closed_loop`, accurate to about eight digits. The loop is stable if the
        spectral radius is below 1. `None` in continuous time.
    - `iterations`: the number of steps of the solver (doubling or the sign iteration).
    - `result`: success, or the reason for a failure; one of `delucax.RESULTS`.
    - `spectral_abscissa`: in continuous time, a close upper bound on the largest real
        part of an eigenvalue of `closed_loop`. The loop is stable if the spectral
        abscissa is below 0. `None` in discrete time.

    `X`, `K` and `closed_loop` are differentiable. `residual`, `spectral_radius` and
    `spectral_abscissa` are diagnostics and have no gradient. If the solve failed and
    the loop is not stable, the derivatives are zero, so that a failed equation does not
    affect the gradient of a batch.

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp

        A = jnp.array([[1.0, 1.0], [0.0, 1.0]])
        B = jnp.array([[0.0], [1.0]])
        solution = dlx.riccati.dare(A, B, jnp.eye(2), jnp.eye(1))
        solution.K, solution.spectral_radius
        ```

        ```text
        (Array([[0.422, 1.244]], dtype=float32), Array(0.422, dtype=float32))
        ```
    """

    X: Array
    K: Array
    residual: Array
    closed_loop: Array
    iterations: Array
    result: Result
    spectral_radius: Array | None = None
    spectral_abscissa: Array | None = None

    __repr__ = shown

    def _facts(self) -> str:
        """The diagnostics of an error."""
        radius, abscissa = self.spectral_radius, self.spectral_abscissa
        name, bound = ("abscissa", abscissa) if radius is None else ("radius", radius)
        return (
            f"Relative residual {float(self.residual):.1e}, spectral {name} of the "
            f"closed loop {float(xp.asarray(bound)):.6g}."
        )


def stabilising_solution(
    discrete: bool, data: RiccatiData, where: str, throw: bool
) -> RiccatiSolution:
    """Solve an equation with checked data. Complex data are solved in real form."""
    if is_complex(*data):
        data = jax.tree.map(real_form, data)
        solution = _as_complex(_solution(discrete, data), discrete, data)
    else:
        solution = _solution(discrete, data)
    return raise_on_failure(solution, where, throw, facts=solution._facts)


@compiled_unless_on_host
@full_precision
def _as_complex(solution: RiccatiSolution, discrete: bool, data: RiccatiData):
    """The solution in complex form. The residual bound is computed again, because
    rounding may have left an `X` that is not exactly a real form."""
    # The solution of the real equation of twice the size is a real form, and so are its
    # gain and closed loop.
    solution = eqx.tree_at(
        lambda s: (s.X, s.K, s.closed_loop), solution, replace_fn=complex_form
    )
    data, X = stop_gradient((data, real_form(solution.X)))
    bound = riccati_residual(discrete, data, X, True).bounds[0]
    bound = xp.where(xp.isfinite(bound), bound, solution.residual)
    return eqx.tree_at(lambda s: s.residual, solution, bound)


@compiled_unless_on_host
@full_precision
def _solution(discrete: bool, data: RiccatiData) -> RiccatiSolution:
    solved = _certified(discrete, data)
    verdict = Verdict(*stop_gradient(solved.numbers))
    return RiccatiSolution(
        X=solved.X,
        K=solved.K,
        residual=verdict.unscaled,
        closed_loop=solved.closed_loop,
        iterations=verdict.iterations.astype(int),
        result=verdict.result(solved.well_posed),
        **{"spectral_radius" if discrete else "spectral_abscissa": verdict.bound},
    )


class _Solved(NamedTuple):
    """The best `X`, its gain and closed loop, the numbers of its verdict, and the units
    of states and rows in the search."""

    X: Square
    K: Array
    closed_loop: Square
    numbers: Array
    well_posed: BoolScalar
    by: Array

    @property
    def differentiable(self) -> BoolScalar:
        stable = Verdict(*self.numbers).stable > 0
        return stable & xp.all(xp.isfinite(self.X)) & self.well_posed


@functools.partial(custom_jvp, nondiff_argnums=(0,))
def _certified(discrete: bool, data: RiccatiData) -> _Solved:
    """The certified search for the stabilising `X`."""
    A, B, Q, _, S, _ = data
    (n, m), dtype = B.shape, A.dtype
    # Zero times NaN or infinity is NaN, and so is the sum.
    finite = xp.sum(0 * xp.concatenate([A, Q, B.T, S.T])) == 0
    unknown = xp.full((2 * n + m, n), xp.nan, dtype)
    # Two loops of one round each. If the arrays are small, XLA on CPU compiles a loop
    # as a whole, and both at the same time. They compile and run faster this way.
    problem = _Problem(xp.ones((2, n), dtype), data, (A, B), finite)
    prepare = lambda _, data: _in_fitting_units(discrete, data)
    problem = if_needed(finite, prepare, problem, (data,))
    # The result for data that are not well posed.
    kept = no_verdict(DONE, dtype), problem.well_posed, problem.by
    nothing = _Solved(*matrices_of(unknown), *kept)
    solved = lambda _, problem: _search(discrete, problem)
    return if_needed(problem.well_posed, solved, nothing, (problem,))


class _Problem(NamedTuple):
    """The data with states and rows scaled `by` balancing units, and `A` and `B` of the
    system without a descriptor matrix."""

    by: Array
    data: RiccatiData
    plain: tuple[Array, Array]
    well_posed: BoolScalar


def _in_fitting_units(discrete: bool, data: RiccatiData) -> _Problem:
    by = units(data)
    A, B, _, R, _, E = data = in_units(by, data)
    # In discrete time R + B'XB is inverted, in continuous time R alone.
    well_posed = is_semidefinite(R) if discrete else is_clearly_definite(R)
    # The starting points need E^-1 A and E^-1 B.
    if E is not None:
        A, B = map(factorised(E), (A, B))
        finite = xp.sum(0 * xp.concatenate([A, B], axis=1)) == 0
        well_posed = well_posed & finite
    return _Problem(by, data, (A, B), well_posed)


def _search(discrete: bool, problem: _Problem) -> _Solved:
    """The search for the solution, in the units of the problem."""
    by, data, plain, well_posed = problem
    d, _ = by
    A, B, *_, E = data
    n, eps = A.shape[0], float(xp.finfo(A.dtype).eps)
    small = is_small(B)
    magnified = 1 if E is None else size(E) ** 2

    def attempt(kind: Array) -> Attempt:
        here, size_Q = weights(kind, data, d)
        start = here._replace(A=plain[0], B=plain[1])
        if discrete:
            height = xp.where(kind == SECOND, _SECOND_START * size_Q, size_Q)
            X, iterations = discrete_start(start, height)
            size_G = xp.zeros_like(size_Q)  # used in continuous time only
        else:
            X, size_G, iterations = continuous_start(start, kind)
        # The residuals are in the balanced and in the user's units.
        left = newton_refine(
            lambda X, flag: riccati_residual(discrete, here, X, small or flag, d),
            lambda _, *at: _correction(discrete, here.E, *at),
            _outside(here.E, X),
            controls=here.B.shape[1],
            units=2,
            to_working_precision=small,
        )
        X, loop = left.X, left.closed_loop
        if discrete:
            bound = spectral_radius(loop)
            # A stable loop may belong to a saddle point of an indefinite cost.
            weight = here.R + matmul(here.B.T, matmul(X, here.B))
            gap = xp.where(is_semidefinite(weight), 1 - bound, -xp.inf)
            rounding, scale = xp.asarray(n * eps, A.dtype), 1.0
            # Eigenvalues come in pairs z, 1/z. If two meet on the unit circle, rounding
            # of the data moves them apart by its square root.
            reach = 10 * eps**0.5
        else:
            bound, scale = abscissa_and_size(loop)
            gap, rounding = -bound, n * eps * scale
            # A change of Q by rounding moves eigenvalues off the imaginary axis by its
            # square root.
            reach = xp.sqrt(10 * n * eps * size_G * size_Q) + 10 * rounding
            scale = size(loop)
        size_X, size_loop = size(X), size(loop)
        gain = 1 + size_loop**2 if discrete else 2 * size_loop
        # A change dX by rounding gives a residual L'dX L - E'dX E, or E'dX L + L'dX E.
        terms = xp.where(left.terms[0] > 0, left.terms[0], xp.inf)
        return Attempt(
            left.point,
            residual=left.bounds[0],
            unscaled=left.bounds[1],
            bound=bound,
            gap=gap,
            rounding=rounding,
            near=xp.abs(gap) < reach,
            around=xp.abs(gap) < 4 * eps**0.125 * scale,
            attainable=8 * eps * size_X * gain * magnified / terms,
            bounded=size_X * eps**0.5 < size_Q,
            iterations=iterations,
        )

    unknown = xp.full((2 * n + B.shape[1], n), xp.nan, A.dtype)
    point, numbers = search(attempt, unknown, well_posed)
    return _Solved(*_in_users_units(by, *matrices_of(point)), numbers, well_posed, by)


def _in_users_units(by, X, K, loop):
    """Back to the user's units, by powers of two and therefore without rounding."""
    d, f = by
    return X * (f[:, None] * f), K * d, loop / (d[:, None] / d)


@_certified.defjvp
@full_precision
def _certified_jvp(discrete, primals, tangents):
    """By the implicit function theorem. Derivatives of unsolved members are zero."""
    solved = _certified(discrete, *primals)
    ok, by = solved.differentiable, stop_gradient(solved.by)
    d, f = by
    # Masked at input and output, so that the NaN of a failed member does not spread.
    if_ok = lambda tree: jax.tree.map(lambda M: xp.where(ok, M, 0), tree)
    tangent = if_ok(in_units(by, *tangents))
    A, B, Q, R, S, E = in_units(by, *primals)
    X = solved.X / (f[:, None] * f)
    (A, B, Q, S, X), (R, E) = where_solved(ok, (A, B, Q, S, X), (R, E))
    safe = RiccatiData(A, B, Q, R, S, E)
    # The derivative of the equation with respect to X is the Lyapunov operator of the
    # closed loop. So dX solves a Lyapunov equation, with the derivative with respect to
    # the data as the constant.
    equation = functools.partial(left_side, discrete, X)
    _, error, loop = jax.jvp(equation, (safe,), (tangent,), has_aux=True)
    # -I/2 is stable in discrete and continuous time, and its solve converges fast.
    loop = xp.where(ok, loop, shifted(-0.5, loop))
    dX = if_ok(_correction(discrete, E, loop, if_ok(error)))
    # The gain is an explicit function of X and the data.
    feedback = lambda *at: _terms(discrete, *at)[2:]
    _, (dK, d_loop) = jax.jvp(feedback, (safe, X), (tangent, dX))
    dX, dK, d_loop = _in_users_units(by, dX, if_ok(dK), if_ok(d_loop))
    return solved, no_tangent(solved)._replace(X=dX, K=dK, closed_loop=d_loop)


def left_side(discrete: bool, X: Array, data: RiccatiData) -> tuple[Array, Array]:
    """The left side of the equation at `X`, and the closed loop, for derivatives."""
    A, _, Q, *_, E = data
    moved, cross, K, closed_loop = _terms(discrete, data, X)
    # With the gain eliminated, the derivative in X is the Lyapunov operator.
    linear = moved @ A
    if discrete:
        linear = linear - (X if E is None else E.T @ X @ E)
    else:
        linear = linear + linear.T
    return symmetric(linear - cross @ K + Q), closed_loop


def _terms(discrete, data, X):
    A, B, *_, E = data
    moved, cross, weight = stationary(discrete, data, X)
    K = solve(weight, cross.T)
    closed_loop = A - B @ K
    return moved, cross, K, closed_loop if E is None else solve(E, closed_loop)


def _correction(discrete: bool, E: Array | None, loop: Array, error: Array) -> Array:
    """The Newton step for an `error` of the equation, given the closed loop."""
    return _outside(E, lyapunov(discrete, loop, error))


def _outside(E: Array | None, Y: Array) -> Array:
    """The `X` of `Y = E'XE`."""
    return Y if E is None else symmetric(solve(E.T, solve(E.T, Y).T))


def is_semidefinite(weight: Array, units: int = 100) -> BoolScalar:
    """Whether a symmetric matrix has no negative eigenvalue, up to rounding."""
    rounding = weight.shape[0] * xp.finfo(weight.dtype).eps
    # The Cholesky factorisation needs positive eigenvalues. The shift makes zero ones
    # positive, but not a negative one that is larger than rounding.
    slack = units * rounding * one_if_zero(size(weight))
    return is_definite(symmetric(weight) + shifted(slack, weight))


def shifted(c, like: Array) -> Array:
    """`c I`, of the shape of `like`."""
    return c * xp.eye(like.shape[0], dtype=like.dtype)
