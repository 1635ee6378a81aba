"""Riccati equations by doubling, and by the sign of the Hamiltonian matrix."""

import jax
import lineax as lx

from .._jax import while_loop, xp
from .._typing import Array, BoolScalar, Scalar, Square
from ..math._linear_solve import factorised, solve, symmetric
from ..math._lyapunov import MAX_DOUBLINGS
from ..math._norms import one_if_zero, relative_and_total_size, size
from ._arguments import RiccatiData
from ._recursion import composed, Element, without_cross_weight


_SIGN_STEPS = 60


def discrete_start(data: RiccatiData, height: Scalar) -> tuple[Array, Array]:
    """A solution by doubling about `X0 = height I`, and the doublings taken."""
    # X0 > 0 makes R + B'X0 B invertible, and excludes the fixed points that leave an
    # undetectable unstable mode unstable.
    A, B, Q, R, S, _ = data
    X0 = height * xp.eye(A.shape[0], dtype=A.dtype)
    # The data of the equation of H = X - X0.
    cross = height * (A.T @ B) + S
    weight = symmetric(R + height * (B.T @ B))
    linear = height * (A.T @ A) - X0
    H, doublings = double(without_cross_weight(A, B, linear, weight, cross, Q), X0)
    return X0 + H, doublings


def continuous_start(
    data: RiccatiData, doubled: BoolScalar
) -> tuple[Array, Array, Array]:
    """A solution by the sign iteration, or by doubling if that is wanted; the size of
    `B R^-1 B'`; and the steps taken."""
    A, G, Q = without_cross_weight(*data[:5])
    # Under vmap both run for all members: the unwanted one ends before its first step.
    by_sign, sign_steps = _by_sign(A, G, Q, ~doubled)
    by_doubling, doublings = _by_doubling(A, G, Q, doubled)
    X = xp.where(doubled, by_doubling, by_sign)
    return X, size(G), xp.where(doubled, doublings, sign_steps)


def _by_sign(A, G, Q, wanted):
    """`X` from the sign of the Hamiltonian matrix `H = [[A, -G], [-Q, -A']]`.

    With `J = [[0, I], [-I, 0]]`, the iteration `H <- (H + H^-1) / 2` is one of the
    symmetric `W = JH`: `W <- (W + J W^-1 J) / 2`. It keeps the eigenvalues in pairs.

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
        ratio = size(turned) / size(W)
        # Scaling speeds up the way to the neighbourhood of the limit, where it would
        # keep the iteration from settling.
        scale = xp.where(before < 1e-2, 1, xp.sqrt(ratio))
        new = symmetric(scale * W + turned / scale) / 2
        change = size(new - W) / size(new)
        # Convergence is quadratic: a small change that is not halved is rounding.
        stalled = (change < 1e-6) & (change > before / 2)
        # A NaN compares false, so that a lane that diverges stops.
        going = (change > 10 * eps) & ~stalled
        return new, change, going, k + 1

    W = xp.block([[-Q, -A.T], [-A, G]])
    start = (W, xp.asarray(xp.inf, dtype), xp.asarray(wanted), xp.asarray(0))
    W, *_, iterations = while_loop(more, body, start)
    # I - sign(H) = [I; X] M projects onto the stable subspace; H = J'W. M alone may be
    # singular, so that X is computed by least squares from all 2n columns.
    upper = xp.concatenate([eye + W[n:, :n], W[n:, n:]], axis=1)
    lower = xp.concatenate([-W[:n, :n], eye - W[:n, n:]], axis=1)
    return symmetric(factorised(upper.T, lx.QR())(lower.T).T), iterations


def _by_doubling(A, G, Q, wanted):
    """`X` by doubling of the Cayley transform `(H - c)^-1 (H + c)`, which maps the left
    half-plane into the circle; `c = |A|`.

    Source: Chu, Fan and Lin, 2005.
    """
    n = A.shape[0]
    # The formulas take 2c. It is at least twice the size of any eigenvalue of A.
    shift = 2 * one_if_zero(size(A)) * xp.eye(n, dtype=A.dtype)
    moved = A - shift / 2
    left = solve(moved, G)
    mixed = moved.T + Q @ left
    right = solve(mixed.T, xp.concatenate([mixed.T + shift, left.T], axis=1))
    # With A_c = A - cI and W = A_c' + Q A_c^-1 G: A = I + 2c W^-T, G = 2c A_c^-1 G W^-1
    # and H = 2c W^-1 Q A_c^-1, the element to be doubled.
    H = solve(mixed, solve(moved.T, Q).T)
    H, G = symmetric(shift @ H), symmetric(shift @ right[:, n:])
    return double((right[:, :n], G, H), xp.zeros_like(H), wanted)


def double(
    element: Element, X0: Square, wanted: BoolScalar | bool = True
) -> tuple[Array, Array]:
    """The limit of joining an interval's element to itself, as `J`, if it is wanted;
    and the doublings taken.

    `X0` is what `J` is a correction to, for its size alone.
    """
    eps = xp.finfo(X0.dtype).eps

    def more(carry):
        _, relative, k = carry
        return (k < MAX_DOUBLINGS) & (relative > eps)

    def body(carry):
        before, _, k = carry
        after = composed(before, before)
        finite = xp.all(xp.stack([xp.all(xp.isfinite(M)) for M in after]))
        # An overflow ends the iteration at the last finite step, whose closed loop is
        # not stable, which the caller checks.
        A, _, J = after = jax.tree.map(
            lambda new, old: xp.where(finite, new, old), after, before
        )
        # In units of X = X0 + J, of which J may be a small part.
        changes = xp.stack([J - before[2], J])
        (change, whole), _ = relative_and_total_size(changes, (X0 + J)[None])
        # The next change is at most |A|^2 |J|.
        relative = xp.minimum(change, size(A) ** 2 * whole)
        return after, xp.where(finite, relative, 0), k + 1

    relative = xp.where(wanted, xp.asarray(xp.inf, X0.dtype), 0)
    start = element, relative, xp.asarray(0)
    (_, _, J), _, doublings = while_loop(more, body, start)
    return J, doublings
