"""Riccati equations over a finite horizon: the recursion in discrete time, in sequence
or in parallel, and the flow in continuous time."""

import functools
from collections.abc import Callable
from typing import Any

import jax
from jaxtyping import Float

from .._jax import custom_jvp, fori_loop, lax, matmul, scan, stop_gradient, vmap, xp
from .._typing import Array, BoolScalar, Square
from ..math._linear_solve import cholesky, full_precision, solve, symmetric
from ._arguments import where_solved


_MAX_HALVINGS = 40
_PADE = (1.0, 1 / 2, 5 / 44, 1 / 66, 1 / 792, 1 / 15840, 1 / 665280)
"""Numerator of the [6/6] Pade approximant of exp. The error is 2e-17 at norm 1/2."""

Element = tuple[Array, Array, Array]
"""`A, C, J` of an interval: the solution `X` at its end gives the solution
`J + A' X (I + C X)^-1 A` at its start."""


def is_clearly_definite(M: Square) -> BoolScalar:
    """Whether a symmetric matrix is positive definite by more than rounding."""
    L = cholesky(stop_gradient(M))
    # The pivot L_ii^2 is a Schur complement of M_ii. It is compared with M_ii, so that
    # units do not matter. NaN compares false.
    least = M.shape[0] * xp.finfo(M.dtype).eps * xp.abs(xp.diagonal(M))
    return xp.all(xp.diagonal(L) ** 2 > least)


def is_saddle(M: Float[Array, "k k"], maximisers: int) -> BoolScalar:
    """Whether `[u; w]' M [u; w]` has a minimum over `u` of its maximum over `w`.

    `w` holds the last `maximisers` entries. It may be empty.
    """
    m = M.shape[0] - maximisers
    if maximisers == 0:
        return is_clearly_definite(M)
    # Concave in w, and convex in u at the best w: the Schur complement is positive.
    U, C, W = M[:m, :m], M[:m, m:], -M[m:, m:]
    concave = is_clearly_definite(W)
    safe = xp.where(concave, W, xp.eye(maximisers, dtype=M.dtype))
    return concave & is_clearly_definite(symmetric(U + C @ solve(safe, C.T)))


def failed_step(X: Float[Array, "T n n"]) -> int:
    """The last step without a solution. `X` is NaN there and at all steps before it."""
    return int(xp.sum(xp.isnan(X[:, 0, 0]))) - 1


def gain(A, B, R, S, X):
    """The gain `K = (R + B'XB)^-1 (B'XA + S')`, and the closed loop `A - B K`."""
    # By LU, not Cholesky, because the weight is indefinite in a game.
    K = solve(R + B.T @ X @ B, B.T @ X @ A + S.T)
    return K, A - B @ K


def one_step(A, B, Q, R, S, K, X):
    """The cost-to-go of `u = -K x` for one step, followed by the cost-to-go `X`.

    In this form an error in `K` has a second-order effect only, and the result is
    positive if the costs are.
    """
    loop, cross = A - B @ K, S @ K
    return symmetric(loop.T @ X @ loop + Q + K.T @ R @ K - cross - cross.T)


@functools.partial(custom_jvp, nondiff_argnums=(6, 7))
def values(A, B, Q, R, S, final, maximisers: int, parallel: bool):
    """`X` at steps 0 to T of the recursion from `final`, shape `(T+1, n, n)`.

    The last `maximisers` controls maximise the cost. `X` is NaN at a step without a
    saddle point, and at all steps before it.
    """
    if parallel:
        X = _in_parallel(A, B, Q, R, S, final)
    else:

        def back(X, here):
            A, B, Q, R, S = here
            return one_step(A, B, Q, R, S, gain(A, B, R, S, X)[0], X)

        X = backwards(back, final, (A, B, Q, R, S))
        X = xp.concatenate([X, final[None]])
    pivot = R + xp.swapaxes(B, 1, 2) @ X[1:] @ B
    good = vmap(lambda M: is_saddle(M, maximisers))(symmetric(pivot))
    good = good & xp.all(xp.isfinite(X[:-1]), axis=(1, 2))
    # If a step has no minimum, the steps before it have none.
    good = lax.cummin(good.astype(xp.int32), reverse=True).astype(bool)
    before = xp.where(good[:, None, None], X[:-1], xp.nan)
    return xp.concatenate([before, final[None]])


def backwards(step: Callable[[Array, Any], Array], final: Array, steps: Any) -> Array:
    """The values of the backward recursion `X = step(X, here)` over `steps`, from
    `final`."""

    def back(X, here):
        X = step(X, here)
        return X, X

    return scan(back, final, steps, reverse=True)[1]


def _in_parallel(A, B, Q, R, S, final):
    # Adding x_next' P x_next - x' P x to each step changes the cost by a telescoping
    # sum, but not the optimal control. It makes the control weight definite even if R
    # is not.
    n = A.shape[-1]
    size = xp.linalg.norm(Q, axis=(1, 2)).mean() + xp.linalg.norm(final)
    size = xp.where(size > 0, size, xp.linalg.norm(R, axis=(1, 2)).mean())
    P = xp.where(size > 0, size, 1) * xp.eye(n, dtype=A.dtype)

    def element(A, B, Q, R, S):
        cross = A.T @ P @ B + S
        linear, weight = A.T @ P @ A - P, R + B.T @ P @ B
        return without_cross_weight(A, B, linear, weight, cross, Q)

    def combine(later, earlier):
        # The scan runs backwards, so the later of two elements comes first.
        return vmap(composed)(earlier, later)

    steps = vmap(element)(A, B, Q, R, S)
    nothing = xp.zeros((1, n, n), A.dtype)
    last = (nothing, nothing, (final - P)[None])
    elements = jax.tree.map(lambda a, b: xp.concatenate([a, b]), steps, last)
    _, _, J = lax.associative_scan(combine, elements, reverse=True)
    after = xp.concatenate([J[1:-1] + P, final[None]])
    # One step of the recursion from each X reduces the rounding of the scan.
    K, _ = vmap(gain)(A, B, R, S, after)
    before = vmap(one_step)(A, B, Q, R, S, K, after)
    return xp.concatenate([before, final[None]])


def without_cross_weight(A, B, Q, R, S, added=None) -> Element:
    """`A - B R^-1 S'`, `B R^-1 B'` and `Q - S R^-1 S'`: the data for the control
    `u + R^-1 S'x`, without a cross weight. `added` is a part of `Q` that is added last.

    The element of a step in discrete time, about some `X0`, follows with
    `A'X0 A - X0` for `Q`, `R + B'X0 B` for `R`, `A'X0 B + S` for `S` and `added = Q`.
    """
    n = A.shape[0]
    solved = solve(R, xp.concatenate([S.T, B.T], axis=1))
    K = solved[:, :n]
    closed_loop, G = A - matmul(B, K), symmetric(matmul(B, solved[:, n:]))
    # The difference of similar terms comes first. Rounding of `added` would hide it.
    Q = Q - matmul(S, K)
    return closed_loop, G, symmetric(Q if added is None else Q + added)


def composed(first: Element, second: Element) -> Element:
    """The element of two intervals, one after the other.

    Source: Sarkka and Garcia-Fernandez, 2023.
    """
    A1, C1, J1 = first
    A2, C2, J2 = second
    # One factorisation is enough, because J2 (I + C1 J2)^-1 and (I + C1 J2)^-1 C1 are
    # symmetric.
    n = A1.shape[0]
    eye = xp.eye(n, dtype=A1.dtype)
    solved = solve(eye + matmul(C1, J2), xp.concatenate([A1, C1], axis=1))
    after = matmul(A2, solved)
    C = symmetric(C2 + matmul(after[:, n:], A2.T))
    J = J1 + symmetric(matmul(A1.T, matmul(J2, solved[:, :n])))
    return after[:, :n], C, J


def linear_recursion(loop, added, final, parallel: bool, product):
    """All `Z` of `Z_t = product(loop_t, Z_{t+1}) + added_t`, backwards from `final`.

    `product` is linear in its second argument, and `product(a, product(b, Z))` is
    `product(b @ a, Z)`.
    """
    if not parallel:
        back = lambda Z, here: product(here[0], Z) + here[1]
        Z = backwards(back, final, (loop, added))
        return xp.concatenate([Z, final[None]])

    # A pair (loop, added) is an affine map, and composition of maps is associative.
    def combine(later, earlier):
        (later_loop, later_added), (loop, added) = later, earlier
        moved = vmap(product)(loop, later_added)
        return later_loop @ loop, moved + added

    loop = xp.concatenate([loop, xp.zeros_like(loop[:1])])
    added = xp.concatenate([added, final[None]])
    return lax.associative_scan(combine, (loop, added), reverse=True)[1]


@values.defjvp
@full_precision
def _values_jvp(maximisers, parallel, primals, tangents):
    *matrices, _ = primals
    X = values(*primals, maximisers, parallel)  # pyright: ignore[reportCallIssue]
    good = xp.all(xp.isfinite(X[:-1]), axis=(1, 2))
    A, B, Q, R, S = matrices
    (A, B, Q, S, after), R = where_solved(good, (A, B, Q, S, X[1:]), R)
    K, loop = vmap(gain)(A, B, R, S, after)

    # By the envelope theorem, the change of the optimal gain does not contribute.
    def cost(A, B, Q, R, S):
        return vmap(one_step)(A, B, Q, R, S, K, after)

    _, change = jax.jvp(cost, (A, B, Q, R, S), tangents[:-1])
    change = xp.where(good[:, None, None], change, 0)
    congruence = lambda loop, Z: loop.T @ Z @ loop
    tangent = linear_recursion(loop, change, tangents[-1], parallel, congruence)
    return X, tangent


def scale_of(G: Array, Q: Array) -> Array:
    """The size of `X` at which `X G X` is as large as `Q`; 1 if `G` or `Q` is zero."""
    # |G| x^2 = |Q|. No derivative, because the result does not depend on the unit.
    quadratic, constant = xp.linalg.norm(G), xp.linalg.norm(Q)
    usual = (quadratic > 0) & (constant > 0)
    ratio = xp.where(usual, constant, 1) / xp.where(usual, quadratic, 1)
    return stop_gradient(xp.sqrt(ratio))


def hamiltonian(A, G, Q) -> Array:
    """The matrix of the linear flow of `[I; X]`, for `dX/dt = -A'X - XA + XGX - Q`."""
    return xp.block([[A, -G], [-Q, -A.T]])


def short_element(H: Float[Array, "_ _"], time: Array) -> tuple[Array, Array, Array]:
    """The element of an interval that is short compared with `1 / |H|`."""
    n = H.shape[0] // 2
    Z = -H * time
    power = xp.eye(2 * n, dtype=H.dtype)
    parts = [power * _PADE[0], xp.zeros_like(Z)]  # of even and of odd degree
    for k in range(1, 7):
        power = power @ Z
        parts[k % 2] = parts[k % 2] + _PADE[k] * power
    even, odd = parts
    # The denominator of the approximant is its numerator at -Z.
    flow = solve(even - odd, even + odd)
    # Backwards over the interval, [U; V] = flow [I; X], and V U^-1 is X at its start.
    # Written as J + A' X (I + C X)^-1 A, this gives A, C and J.
    first, second = flow[:n, :n], flow[:n, n:]
    eye = xp.eye(n, dtype=H.dtype)
    solved = solve(first, xp.concatenate([eye, second], axis=1))
    J = solve(first.T, flow[n:, :n].T).T
    return solved[:, :n], symmetric(solved[:, n:]), symmetric(J)


def _short_elements(A, G, Q, times):
    """The unit of `X`, the number of halvings, and the elements of the intervals
    between `times` after these halvings."""
    # The unit gives the quadratic and the constant part of the flow equal norms.
    unit, lengths = scale_of(G, Q), xp.diff(times)
    H = hamiltonian(A, unit * G, Q / unit)
    # After these halvings, |H| times the longest interval is at most 1/2.
    sizes = xp.maximum(2 * xp.linalg.norm(H) * lengths, 1)
    count = xp.max(stop_gradient(xp.ceil(xp.log2(sizes))).astype(xp.int32))
    count = xp.minimum(count, _MAX_HALVINGS)
    short = (lengths * 0.5**count).astype(lengths.dtype)
    return unit, count, vmap(lambda time: short_element(H, time))(short)


def has_solution(C: Array, X: Array, is_game: bool) -> Array:
    """Whether the equation has a solution over an interval, backwards from `X`.

    It has a solution as long as `I + C X` is not singular, with `C` of the time passed
    so far. For control `C` increases with time, and in a game `X` is not negative. So
    it is enough to check at the end that no eigenvalue of `I + C X` is negative.
    """
    C, X = stop_gradient((C, X))
    # In a game X is semidefinite and C may be indefinite. For control it is the
    # reverse.
    inner, outer = (X, C) if is_game else (C, X)
    n = X.shape[0]
    eye = xp.eye(n, dtype=X.dtype)
    size = xp.linalg.norm(inner)
    # With C = root root', I + C X has the eigenvalues of I + root' X root.
    slack = 100 * n * xp.finfo(X.dtype).eps * xp.where(size > 0, size, 1)
    root = cholesky(inner + slack * eye)
    moved = cholesky(eye + symmetric(root.T @ outer @ root))
    return xp.all(xp.isfinite(root)) & xp.all(xp.isfinite(moved))


@functools.partial(custom_jvp, nondiff_argnums=(5,))
def flow_values(A, G, Q, final, times, is_game: bool):
    """`X` at `times` along `dX/dt = -A'X - XA + XGX - Q`, backwards from `final`.

    It is NaN at the times from which there is no solution to the end.
    """
    unit, count, short = _short_elements(A, G, Q, times)
    reach = lambda C, J: has_solution(C, J, is_game)

    def twice(_, carry):
        element, good = carry
        # From X = 0, there may be a solution over each half, but not over both.
        good = good & vmap(reach)(element[1], element[2])
        return vmap(composed)(element, element), good

    start = (short, xp.ones(len(times) - 1, bool))
    parts, possible = fori_loop(0, count, twice, start)

    def back(carry, here):
        X, good = carry
        element, possible = here
        # `passed` alone would step over a finite escape time within the interval.
        good = good & possible & has_solution(element[1], X, is_game)
        X = passed(element, X)
        good = good & xp.all(xp.isfinite(X))
        return (X, good), xp.where(good, X, xp.nan)

    start = (final / unit, xp.ones((), bool))
    _, X = scan(back, start, (parts, possible), reverse=True)
    return xp.concatenate([unit * X, final[None]])


def _to_differentiate(A, G, Q, final, times):
    """`X` of `flow_values` if it exists, by loops of fixed length for reverse mode."""
    unit, count, short = _short_elements(A, G, Q, times)

    def twice(element, k):
        # After the last doubling, elements of zeros are composed and not used.
        going = k < count
        tried = jax.tree.map(lambda M: xp.where(going, M, 0), element)
        after = vmap(composed)(tried, tried)
        kept = jax.tree.map(lambda a, b: xp.where(going, a, b), after, element)
        return kept, None

    parts, _ = scan(twice, short, xp.arange(_MAX_HALVINGS))
    X = backwards(lambda X, element: passed(element, X), final / unit, parts)
    return xp.concatenate([unit * X, final[None]])


@flow_values.defjvp
@full_precision
def _flow_values_jvp(is_game, primals, tangents):
    X = flow_values(*primals, is_game)  # pyright: ignore[reportCallIssue]
    good = xp.all(xp.isfinite(X))
    *matrices, times = primals
    # A failed problem is replaced by zeros, so that derivatives are not NaN.
    safe = (*(xp.where(good, M, 0) for M in matrices), times)
    _, tangent = jax.jvp(_to_differentiate, safe, tangents)
    return X, xp.where(good, tangent, 0)


def passed(element, X):
    """`X` at the start of an interval from `X` at its end."""
    A, C, J = element
    n = A.shape[0]
    moved = solve(xp.eye(n, dtype=A.dtype) + C @ X, A)
    return symmetric(J + A.T @ X @ moved)
