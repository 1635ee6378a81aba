"""Riccati equations by doubling, and by the sign of the Hamiltonian matrix."""

import lineax as lx

from .._jax import if_true, matmul, while_loop, xp
from .._typing import Array, Scalar, Square
from ..math._linear_solve import factorised, SMALL, solve, symmetric
from ..math._lyapunov import MAX_DOUBLINGS
from ..math._norms import largest, largest_of_each, one_if_zero, size
from ._arguments import RiccatiData
from ._recursion import Element, without_cross_weight
from ._search import SECOND, UNIT


_SIGN_STEPS = 60


def discrete_start(data: RiccatiData, height: Scalar) -> tuple[Array, Array]:
    """A solution by doubling from `X0 = height I`, and the number of doublings."""
    # X0 > 0 makes R + B'X0 B invertible. It also excludes fixed points whose closed
    # loop leaves an undetectable unstable mode unstable.
    A, B, Q, R, S, _ = data
    X0 = height * xp.eye(A.shape[0], dtype=A.dtype)
    # The data of the equation for H = X - X0.
    cross = height * matmul(A.T, B) + S
    weight = symmetric(R + height * matmul(B.T, B))
    linear = height * matmul(A.T, A) - X0
    H, doublings = double(without_cross_weight(A, B, linear, weight, cross, Q), X0)
    return X0 + H, doublings


def continuous_start(data: RiccatiData, kind: Scalar) -> tuple[Array, Array, Array]:
    """A solution by the sign iteration, the size of `B R^-1 B'`, and the number of
    steps."""
    A, G, Q = without_cross_weight(*data[:5])
    size_A, size_G, size_Q = (one_if_zero(size(M)) for M in (A, G, Q))
    # The first unit of X makes the two quadratic blocks equally large. The second is
    # the size of X for a weak control, which the unstable modes alone determine.
    unit = xp.where(kind == SECOND, size_A / size_G, xp.sqrt(size_Q / size_G))
    unit = xp.where(kind == UNIT, 1, one_if_zero(unit))
    X, steps = _by_sign(A, unit * G, Q / unit)
    return unit * X, size_G, steps


def _by_sign(A, G, Q):
    """`X` from the sign of the Hamiltonian matrix `H = [[A, -G], [-Q, -A']]`.

    With `J = [[0, I], [-I, 0]]` the matrix `W = JH` is symmetric, and the iteration
    `H <- (H + H^-1) / 2` becomes `W <- (W + J W^-1 J) / 2`. In this form the
    eigenvalues stay in pairs.

    Source: Roberts, 1971; Byers, 1987 (the symmetric form and the scaling).
    """
    n, dtype = A.shape[0], A.dtype
    eps = xp.finfo(dtype).eps
    eye, both = xp.eye(n, dtype=dtype), xp.eye(2 * n, dtype=dtype)

    def J(M):
        return xp.concatenate([M[n:], -M[:n]])

    def more(carry):
        *_, going, k = carry
        return going & (k < _SIGN_STEPS)

    def body(carry):
        W, before, _, k = carry
        turned = J(solve(W, J(both)))
        ratio = largest(turned) / largest(W)
        # Scaling speeds up the iteration far from the limit. Near the limit it would
        # prevent convergence.
        scale = xp.where(before < 1e-2, 1, xp.sqrt(ratio))
        new = symmetric(scale * W + turned / scale) / 2
        change = largest(new - W) / largest(new)
        # Because convergence is quadratic, a small change that is not halved is
        # rounding.
        stalled = (change < 1e-6) & (change > before / 2)
        # At a singular W the iteration ends, because NaN compares false.
        new = xp.where(change < xp.inf, new, W)
        going = (change > 10 * eps) & ~stalled
        return new, change, going, k + 1

    W = xp.block([[-Q, -A.T], [-A, G]])
    start = (W, xp.asarray(xp.inf, dtype), xp.asarray(True), xp.asarray(0))
    W, *_, iterations = while_loop(more, body, start)
    # I - sign(H) = [I; X] M projects onto the stable subspace, and H = J'W. M may be
    # singular, so X is computed by least squares from all 2n columns.
    upper = xp.concatenate([eye + W[n:, :n], W[n:, n:]], axis=1)
    lower = xp.concatenate([-W[:n, :n], eye - W[:n, n:]], axis=1)
    return symmetric(factorised(upper.T, lx.QR())(lower.T).T), iterations


def double(element: Element, X0: Square) -> tuple[Array, Array]:
    """The limit `J` of composing an element with itself, and the number of doublings.

    `J` is a correction of `X0`. Only the size of `X0` is used, by the stopping test.
    """
    eps, n = xp.finfo(X0.dtype).eps, len(X0)
    eye = xp.eye(n, dtype=X0.dtype)

    def more(carry):
        _, relative, k = carry
        return (k < MAX_DOUBLINGS) & (relative > eps)

    def body(carry):
        (A, C, J), _, k = carry
        # As in `composed`. Small matrices are factorised once for both right sides. For
        # large ones products with the inverse are faster than solves.
        right = xp.concatenate([A, C], axis=1) if n <= SMALL else eye
        inverse = solve(eye + matmul(C, J), right)
        solved = inverse[:, :n] if n <= SMALL else matmul(inverse, A)
        change = symmetric(matmul(A.T, matmul(J, solved)))
        after, J_after = matmul(A, solved), J + change
        # Relative to X = X0 + J, because J may be a small part of it.
        sizes = largest_of_each(change, J_after, X0 + J_after, after)
        changed, whole, size_X, size_A = sizes
        # The next change is at most |A|^2 |J|.
        relative = xp.minimum(changed, (n * size_A) ** 2 * whole) / one_if_zero(size_X)
        # An overflow or NaN (which compares false) ends the iteration at the last
        # finite step. Its closed loop is not stable, which the caller checks.
        finite = (whole < xp.inf) & (size_A < xp.inf)
        relative = xp.where(finite, relative, 0)

        def joined(C):
            spread = inverse[:, n:] if n <= SMALL else matmul(inverse, C)
            return C + symmetric(matmul(matmul(A, spread), A.T))

        # The last doubling needs J alone. Small problems are compiled without branches.
        C = joined(C) if n <= SMALL else if_true(relative > eps, joined, C)
        return (after, C, xp.where(finite, J_after, J)), relative, k + 1

    start = element, xp.asarray(xp.inf, X0.dtype), xp.asarray(0)
    (_, _, J), _, doublings = while_loop(more, body, start)
    return J, doublings
