"""Linear solves, with an elimination for small matrices."""

import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.lax as lax
import lineax as lx
import numpy as np
from jaxtyping import Complex, Float, Inexact

from .._jax import on_host, xp
from .._typing import Array, BoolScalar, Square


SMALL = 8
"""Matrices up to this size are eliminated here, larger ones by LAPACK.

LAPACK is called once for each matrix of a batch. For small matrices it is slower even
without a batch.
"""


def full_precision(function: Callable) -> Callable:
    """`function`, with matrix products in the full precision of their arguments.

    By default, accelerators round the arguments of a float32 product to fewer bits.
    Repeated squaring would amplify that.
    """

    @functools.wraps(function)
    def wrapped(*arguments):
        if on_host():
            return function(*arguments)
        with jax.default_matmul_precision("highest"):
            return function(*arguments)

    return wrapped


def solve(matrix: Square, right: Float[Array, "n k"]) -> Float[Array, "n k"]:
    """`matrix^-1 right`; not finite if `matrix` is singular."""
    return factorised(matrix)(right)


def factorised(
    matrix: Inexact[Array, "*stack m n"],
    solver: lx.AbstractLinearSolver | None = None,
    tags: Any = (),
) -> Callable[[Inexact[Array, "m k"]], Inexact[Array, "n k"]]:
    """The function `right -> matrix^-1 right`, for several right sides in turn.

    A given `solver` may need `tags` of the matrix. On NumPy, `matrix` may be a stack.
    """
    if on_host():
        return functools.partial(_by_lapack, matrix, isinstance(solver, lx.QR))
    if solver is None:
        if len(matrix) == 1:
            return lambda right: right / matrix
        solver = _Elimination() if len(matrix) <= SMALL else lx.LU()
    operator = lx.MatrixLinearOperator(matrix, tags)
    # The factorisation is computed once and not differentiated: Lineax differentiates
    # the solve.
    constant = lx.MatrixLinearOperator(lax.stop_gradient(matrix), tags)
    state = solver.init(constant, {})

    def column(b):
        return lx.linear_solve(operator, b, solver, state=state, throw=False).value

    return jax.vmap(column, in_axes=1, out_axes=1)


def _by_lapack(matrix: Any, least_squares: bool, right: Any) -> Any:
    """The solution on the host, NaN if there is none."""
    if least_squares:
        basis, matrix = np.linalg.qr(matrix)
        right = basis.T @ right
    try:
        return np.linalg.solve(matrix, right)
    except np.linalg.LinAlgError:
        if matrix.ndim == 2:
            return np.full_like(right, np.nan)
        # One matrix of the stack is singular.
        rights = np.broadcast_to(right, (len(matrix), *right.shape[-2:]))
        pairs = zip(matrix, rights, strict=True)
        return np.stack([_by_lapack(M, False, b) for M, b in pairs])


def cholesky(matrix: Any) -> Any:
    """The lower Cholesky factor; NaN if `matrix` is not definite."""
    try:
        return xp.linalg.cholesky(matrix)
    except np.linalg.LinAlgError:
        return np.full_like(matrix, np.nan)


class _Elimination(lx.AbstractLinearSolver):
    """Gauss-Jordan elimination with partial pivoting, for a matrix and a vector.

    Rows stay in place, and one loop eliminates above and below the diagonal. The error
    of the solution has the same bound as that of substitution with triangular factors
    (Higham, 2002, section 14.4).
    """

    def init(self, operator: lx.AbstractLinearOperator, options: dict[str, Any]):
        del options
        return operator.as_matrix()

    def compute(self, state, vector, options):
        del options
        n = len(vector)
        rows = xp.arange(n)

        # For a batch of vectors with one matrix, the matrix is eliminated once.
        def step(k, carry):
            matrix, x, unused, order = carry
            column = _entry(matrix, k, axis=1)
            # The pivot is the largest entry among the rows that had no pivot yet.
            pivot = xp.argmax(xp.where(unused, xp.abs(column), -1))
            here = rows == pivot
            value = _entry(column, pivot)
            row, entry = _entry(matrix, pivot) / value, _entry(x, pivot) / value
            matrix = xp.where(here[:, None], row, matrix - column[:, None] * row)
            x = xp.where(here, entry, x - column * entry)
            return matrix, x, unused & ~here, xp.where(rows == k, pivot, order)

        start = state, vector, xp.full(n, True), rows
        _, x, _, order = lax.fori_loop(0, n, step, start)
        x = x.at[order].get(mode="promise_in_bounds", unique_indices=True)
        return x, lx.RESULTS.successful, {}

    def transpose(self, state, options):
        del options
        return state.T, {}

    def conj(self, state, options):
        del options
        return state.conj(), {}

    def assume_full_rank(self):
        return True


def _entry(array, k, axis=0):
    """Entry or row `k`, without a test of whether `k` is negative."""
    return lax.dynamic_index_in_dim(
        array, k, axis, keepdims=False, allow_negative_indices=False
    )


def is_definite(matrix: Square) -> BoolScalar:
    """Whether all pivots of a symmetric matrix are positive."""
    n = len(matrix)
    if n > SMALL or on_host():
        return xp.all(xp.isfinite(cholesky(matrix)))
    if n == 1:
        return matrix[0, 0] > 0

    # Elimination without exchanges. Its pivots are the squares of the diagonal of the
    # Cholesky factor. The rest moves to the upper left corner.
    def step(rest, _):
        pivot = rest[0, 0]
        rest = rest - rest[:, :1] * (rest[0] / pivot)
        moved = (-1, 1, 0)
        return lax.pad(rest, xp.zeros((), rest.dtype), (moved, moved)), pivot > 0

    return xp.all(lax.scan(step, matrix, length=n)[1])


def symmetric(X: Float[Array, "*T n n"]) -> Float[Array, "*T n n"]:
    """The symmetric part of `X`."""
    return (X + X.mT) / 2


def no_tangent(tree: Any) -> Any:
    """The zero tangent of a tree, also of its integers and booleans."""

    def zero(x):
        if xp.issubdtype(x.dtype, xp.inexact):
            return xp.zeros_like(x)
        return xp.zeros(x.shape, jax.dtypes.float0)

    return jax.tree.map(zero, tree)


def lu_solve(
    matrix: Inexact[Array, "n n"], right: Inexact[Array, "n k"]
) -> Inexact[Array, "n k"]:
    """`solve` by LAPACK at every size, also for complex matrices."""
    return factorised(matrix, lx.LU())(right)


def eigenvalues(matrix: Square) -> Complex[Array, " n"]:
    """The eigenvalues, NaN if `matrix` is not finite."""
    if not on_host():
        return xp.linalg.eigvals(matrix)
    values: Any
    try:
        values = np.linalg.eigvals(matrix)
    except np.linalg.LinAlgError:
        values = np.full(len(matrix), np.nan)
    # NumPy returns real numbers if all eigenvalues are real.
    return values.astype(np.result_type(matrix, np.complex64))
