"""Linear solves, with unrolled elimination for small matrices."""

import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.lax as lax
import lineax as lx
import numpy as np
from jaxtyping import Float, Inexact

from .._jax import on_host, xp
from .._typing import Array, BoolScalar, Square


SMALL = 5
"""Matrices up to this size are eliminated entry by entry, over a batch at once.

From six rows on LAPACK is faster for one matrix, and compiles in a tenth of the time.
"""


def full_precision(function: Callable) -> Callable:
    """`function` with products in the precision of their arguments.

    Accelerators round the arguments of a float32 product to fewer bits by default, and
    repeated squaring amplifies that.
    """

    @functools.wraps(function)
    def wrapped(*arguments):
        if on_host():
            return function(*arguments)
        with jax.default_matmul_precision("highest"):
            return function(*arguments)

    return wrapped


def solve(matrix: Square, right: Float[Array, "n k"]) -> Float[Array, "n k"]:
    """`matrix^-1 right`; not finite where `matrix` is singular."""
    return factorised(matrix)(right)


def factorised(
    matrix: Inexact[Array, "m n"],
    solver: lx.AbstractLinearSolver | None = None,
    tags: Any = (),
) -> Callable[[Inexact[Array, "m k"]], Inexact[Array, "n k"]]:
    """`right -> matrix^-1 right`, for more than one right side in turn.

    A small matrix is eliminated entry by entry: one member of a batch is then a lane of
    vector instructions, where LAPACK would be called for each. A `solver` that is given
    may need `tags` of the matrix.
    """
    if on_host():
        return functools.partial(_by_lapack, matrix, isinstance(solver, lx.QR))
    if solver is None:
        solver = _Elimination() if matrix.shape[0] <= SMALL else lx.LU()
    # The state is computed once. Lineax differentiates the solve, not the elimination.
    operator = lx.MatrixLinearOperator(matrix, tags)
    state = solver.init(operator, {})

    def column(b):
        return lx.linear_solve(operator, b, solver, state=state, throw=False).value

    return jax.vmap(column, in_axes=1, out_axes=1)


def _by_lapack(matrix, least_squares, right):
    """The solution on the host, NaN where there is none."""
    if least_squares:
        basis, matrix = np.linalg.qr(matrix)
        right = basis.T @ right
    try:
        return np.linalg.solve(matrix, right)
    except np.linalg.LinAlgError:
        return np.full_like(right, np.nan)


def cholesky(matrix: Square) -> Square:
    """The lower factor; NaN where `matrix` is not definite."""
    try:
        return xp.linalg.cholesky(matrix)
    except np.linalg.LinAlgError:
        return np.full_like(matrix, np.nan)


class _Elimination(lx.AbstractLinearSolver):
    """Gaussian elimination with partial pivoting, unrolled, for a matrix and a vector.

    Rows are exchanged by selects instead of gathers, which vectorise under `jax.vmap`
    although each member of a batch has its own pivots.
    """

    def init(self, operator: lx.AbstractLinearOperator, options: dict[str, Any]):
        del options
        matrix = operator.as_matrix()
        return matrix, _factor(matrix)

    def compute(self, state, vector, options):
        del options
        _, (rows, pivots) = state
        n = len(rows)
        x = [vector[i] for i in range(n)]
        # The row exchanges, then forward and backward substitution.
        for k in range(n):
            chosen = x[k]
            for i in range(k + 1, n):
                is_pivot = pivots[k] == i
                chosen = lax.select(is_pivot, x[i], chosen)
                x[i] = lax.select(is_pivot, x[k], x[i])
            x[k] = chosen
        for k in range(n):
            for i in range(k + 1, n):
                x[i] = x[i] - rows[i][k] * x[k]
        x = _materialised(x)
        for i in reversed(range(n)):
            for j in range(i + 1, n):
                x[i] = x[i] - rows[i][j] * x[j]
            x[i] = x[i] / rows[i][i]
        return xp.stack(x), lx.RESULTS.successful, {}

    def transpose(self, state, options):
        del options
        matrix = state[0].T
        return (matrix, _factor(matrix)), {}

    def conj(self, state, options):
        del options
        return state, {}

    def assume_full_rank(self):
        return True


def _materialised(tree):
    """The same values, materialised before use: a compiler that fuses the whole
    elimination recomputes them for each use, and their number doubles with each
    pivot."""
    return lax.optimization_barrier(tree)


def _factor(matrix):
    """Upper triangle and multipliers, row by row, and the row of each pivot."""
    n = matrix.shape[0]
    rows = [[matrix[i, j] for j in range(n)] for i in range(n)]
    pivots = []
    for k in range(n):
        # The pivot is the largest entry of the column: a comparison for each row.
        best, pivot = xp.abs(rows[k][k]), xp.asarray(k)
        for i in range(k + 1, n):
            size = xp.abs(rows[i][k])
            larger = size > best
            best = lax.select(larger, size, best)
            pivot = lax.select(larger, xp.asarray(i), pivot)
        rows, pivot = _materialised((rows, pivot))
        pivots.append(pivot)
        chosen = list(rows[k])
        for i in range(k + 1, n):
            is_pivot = pivot == i
            for j in range(n):
                chosen[j] = lax.select(is_pivot, rows[i][j], chosen[j])
                rows[i][j] = lax.select(is_pivot, rows[k][j], rows[i][j])
        rows[k] = _materialised(chosen)
        for i in range(k + 1, n):
            multiplier = rows[i][k] / rows[k][k]
            rows[i][k] = multiplier
            for j in range(k + 1, n):
                rows[i][j] = rows[i][j] - multiplier * rows[k][j]
    return _materialised(rows), pivots


def is_definite(matrix: Square) -> BoolScalar:
    """Whether all pivots of a symmetric matrix are positive."""
    n = matrix.shape[0]
    if n > SMALL or on_host():
        return xp.all(xp.isfinite(cholesky(matrix)))
    # Elimination without pivoting, whose pivots are the squares of Cholesky's diagonal.
    rows = [[matrix[i, j] for j in range(n)] for i in range(n)]
    definite = xp.asarray(True)
    for k in range(n):
        definite = definite & (rows[k][k] > 0)
        for i in range(k + 1, n):
            multiplier = rows[i][k] / rows[k][k]
            for j in range(k + 1, n):
                rows[i][j] = rows[i][j] - multiplier * rows[k][j]
    return definite


def symmetric(X: Float[Array, "*T n n"]) -> Float[Array, "*T n n"]:
    """The symmetric part."""
    return (X + X.mT) / 2


def no_tangent(tree: Any) -> Any:
    """The zero tangent of a tree, integers and flags included."""

    def zero(x):
        if xp.issubdtype(x.dtype, xp.inexact):
            return xp.zeros_like(x)
        return xp.zeros(x.shape, jax.dtypes.float0)

    return jax.tree.map(zero, tree)


def lu_solve(
    matrix: Inexact[Array, "n n"], right: Inexact[Array, "n k"]
) -> Inexact[Array, "n k"]:
    """`solve` by LAPACK at every size, of complex matrices too."""
    return factorised(matrix, lx.LU())(right)
