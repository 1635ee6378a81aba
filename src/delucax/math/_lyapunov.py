"""Lyapunov, Stein and Sylvester equations of stable matrices, and Gramians over a
finite time, by doubling."""

import jax.scipy.linalg as jsl
from jaxtyping import Float

from .._jax import lax, scan, stop_gradient, while_loop, xp
from .._typing import Array, Scalar, Square
from ._linear_solve import factorised, full_precision, symmetric
from ._norms import relative_size


_REFINEMENTS = 3
MAX_DOUBLINGS = 60
"""2**60 steps: a spectral radius closer to 1 is not resolved in float64."""


def lyapunov(discrete: bool, A: Square, Q: Square) -> Square:
    """The solution of `A'X + XA + Q = 0`, or in discrete time of `X = A'XA + Q`, for a
    stable `A`.

    It is differentiated as the linear solve that it is, to any order and in either
    mode.
    """
    equation = smith if discrete else stable_sylvester
    solved = lambda A: lambda _, right: equation(A, None, right)[0]
    # The transposed equation is that of A'. The doubling is never differentiated.
    return lax.custom_linear_solve(
        lambda X: X - A.T @ X @ A if discrete else A.T @ X + X @ A,
        Q if discrete else -Q,
        solve=solved(A.T),
        transpose_solve=solved(A),
    )


def smith(
    A: Square, B: Float[Array, "m m"] | None, C: Float[Array, "n m"]
) -> tuple[Float[Array, "n m"], Array]:
    """`X = A X B + C` for stable `A` and `B` (default `A'`), and the doublings taken.

    `X_2k = X_k + A^k X_k B^k`, the sum of the first 2k terms of the series.

    Source: Smith, 1968.
    """
    eps = xp.finfo(C.dtype).eps
    powers = (A,) if B is None else (A, B)

    def more(carry):
        *_, relative, k = carry
        return (k < MAX_DOUBLINGS) & (relative > eps / 4)

    def body(carry):
        X, powers, _, k = carry
        left, right = powers if len(powers) == 2 else (powers[0], powers[0].T)
        change = left @ X @ right
        X = X + change
        # A NaN compares false, so that a lane that diverges stops.
        relative = relative_size(change, X)
        return X, tuple(power @ power for power in powers), relative, k + 1

    start = (C, powers, xp.asarray(xp.inf, C.dtype), xp.asarray(0))
    X, *_, iterations = while_loop(more, body, start)
    return X, iterations


def stable_sylvester(
    A: Square, B: Float[Array, "m m"] | None, C: Float[Array, "n m"]
) -> tuple[Float[Array, "n m"], Array]:
    """`A X + X B = C` for stable `A` and `B` (default `A'`), and the doublings taken.

    With `P = (A - c)^-1 (A + c)` and likewise of `B` it is the Stein equation
    `X = P X P_B - 2c (A - c)^-1 C (B - c)^-1`. Iterative refinement recovers what
    the transform loses of a wide spectrum.
    """
    n, m = C.shape
    eps = xp.finfo(C.dtype).eps
    other = A.T if B is None else B
    # The geometric mean of the eigenvalues' sizes: the transform maps what is far above
    # it and far below it towards the circle alike. The determinant gives it without
    # eigenvalues.
    logs = xp.linalg.slogdet(A)[1]
    logs = 2 * logs if B is None else logs + xp.linalg.slogdet(B)[1]
    c = xp.exp(logs / (2 * n if B is None else n + m))
    shifted_A, power_A = _cayley(A, c)
    shifted_B, power_B = (shifted_A, None) if B is None else _cayley(B.T, c)

    def more(carry):
        *_, going, k = carry
        return going & (k <= _REFINEMENTS)

    def body(carry):
        X, rest, residual, iterations, _, k = carry
        scaled = shifted_B(shifted_A(rest).T).T
        change, doublings = smith(
            power_A, None if power_B is None else power_B.T, -2 * c * scaled
        )
        candidate = X + change
        left, right = A @ candidate, candidate @ other
        left_over = C - left - right
        relative = relative_size(left_over, left, right, C)
        # The first round solves, those after it refine.
        better = (relative < residual) | (k == 0)
        X = xp.where(better, candidate, X)
        residual = xp.where(better, relative, residual)
        going = better & (residual > 10 * eps)
        return X, left_over, residual, iterations + doublings, going, k + 1

    unknown, zero = xp.asarray(xp.inf, C.dtype), xp.asarray(0)
    start = xp.zeros_like(C), C, unknown, zero, xp.asarray(True), zero
    X, _, _, iterations, *_ = while_loop(more, body, start)
    return X, iterations


def _cayley(A, c):
    """The solution with `A - c`, and `(A - c)^-1 (A + c)`."""
    shift = c * xp.eye(len(A), dtype=A.dtype)
    solved = factorised(A - shift)
    return solved, solved(A + shift)


@full_precision
def gramian_over(A: Square, Q: Square, time: Scalar) -> Square:
    """The integral of `exp(A s) Q exp(A' s)` over `s` from 0 to `time`.

    Over the whole time the exponential of `-A` would overflow where `A` is stiff. It is
    taken over a short part, with `|A| t < 1`, which is then doubled.

    Source: Van Loan, 1978.
    """
    n = A.shape[0]
    fastest = stop_gradient(time * xp.linalg.norm(A))
    doublings = xp.clip(xp.ceil(xp.log2(xp.maximum(fastest, 1))), 0, MAX_DOUBLINGS)
    short = time * 0.5**doublings
    block = xp.block([[-A, Q], [xp.zeros_like(A), A.T]]) * short
    # exp([[-A, Q], [0, A']] t) = [[exp(-A t), exp(-A t) W], [0, exp(A' t)]].
    exponential = jsl.expm(block)
    power = exponential[n:, n:].T
    W = power @ exponential[:n, n:]

    # W(2t) = W(t) + exp(A t) W(t) exp(A' t); of fixed length, which reverse mode needs.
    def double(carry, k):
        W, power = carry
        more = k < doublings
        # Zero where it is not used: what overflows there must not reach a derivative.
        safe_power = xp.where(more, power, 0)
        W_next = W + safe_power @ W @ safe_power.T
        return (W_next, xp.where(more, safe_power @ safe_power, power)), None

    (W, _), _ = scan(double, (W, power), xp.arange(MAX_DOUBLINGS))
    return symmetric(W)
