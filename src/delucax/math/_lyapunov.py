"""Lyapunov, Stein and Sylvester equations with stable matrices, and Gramians over a
finite time, by doubling."""

from jaxtyping import Float

from .._jax import lax, matmul, scan, stop_gradient, while_loop, xp
from .._typing import Array, Scalar, Square
from ._balancing import balanced
from ._exponential import exponential_of_blocks
from ._linear_solve import full_precision, solve, symmetric
from ._norms import largest, relative_size


_REFINEMENTS = 3
_SIGN_STEPS = 60
MAX_DOUBLINGS = 60
"""Enough for 2**60 steps. float64 does not resolve a spectral radius closer to 1."""


def lyapunov(
    discrete: bool, A: Square, Q: Square, refinements: int = _REFINEMENTS
) -> Square:
    """The solution of `A'X + XA + Q = 0`, or in discrete time of `X = A'XA + Q`, for a
    stable `A`. `refinements` bounds the refinements in continuous time.

    It is differentiated as a linear solve, to any order and in either mode.
    """

    def solved(A):
        if discrete:
            return lambda _, right: smith(A, None, right)[0]
        return lambda _, right: stable_sylvester(A, None, right, refinements)[0]

    # The transposed equation is that with A'. The doubling is never differentiated.
    return lax.custom_linear_solve(
        lambda X: X - A.T @ X @ A if discrete else A.T @ X + X @ A,
        Q if discrete else -Q,
        solve=solved(A.T),
        transpose_solve=solved(A),
    )


def smith(
    A: Square, B: Float[Array, "m m"] | None, C: Float[Array, "n m"]
) -> tuple[Float[Array, "n m"], Array]:
    """The solution of `X = A X B + C` for stable `A` and `B` (`A'` by default), and the
    number of doublings.

    `X_2k = X_k + A^k X_k B^k` is the sum of the first 2k terms of the series.

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
        change = matmul(matmul(left, X), right)
        X = X + change
        # A NaN compares false, so that a diverging member of a batch stops.
        relative = relative_size(change, X)
        return X, tuple(matmul(power, power) for power in powers), relative, k + 1

    # With a zero C, as at the start of a refinement, there is nothing to do.
    unknown = xp.where(largest(C) != 0, xp.asarray(xp.inf, C.dtype), 0)
    start = (C, powers, unknown, xp.asarray(0))
    X, *_, iterations = while_loop(more, body, start)
    return X, iterations


def stable_sylvester(
    A: Square,
    B: Float[Array, "m m"] | None,
    C: Float[Array, "n m"],
    refinements: int = _REFINEMENTS,
) -> tuple[Float[Array, "n m"], Array]:
    """The solution of `A X + X B = C` for stable `A` and `B` (`A'` by default), and the
    number of steps.

    By the sign iteration. Iterative refinement recovers the digits that it loses for a
    wide spectrum.
    """
    eps = xp.finfo(C.dtype).eps
    other = A.T if B is None else B

    def more(carry):
        *_, going, k = carry
        return going & (k <= refinements)

    def body(carry):
        X, rest, residual, iterations, _, k = carry
        change, steps = _by_sign(A, B, rest)
        candidate = X + change
        left, right = matmul(A, candidate), matmul(candidate, other)
        left_over = C - left - right
        relative = relative_size(left_over, left, right, C)
        # The first round solves, the others refine.
        better = (relative < residual) | (k == 0)
        X = xp.where(better, candidate, X)
        residual = xp.where(better, relative, residual)
        going = better & (residual > 10 * eps)
        return X, left_over, residual, iterations + steps, going, k + 1

    unknown, zero = xp.asarray(xp.inf, C.dtype), xp.asarray(0)
    start = xp.zeros_like(C), C, unknown, zero, largest(C) != 0, zero
    X, _, _, iterations, *_ = while_loop(more, body, start)
    return X, iterations


def _by_sign(A, B, C):
    """The solution of `A X + X B = C`, and the number of steps.

    The sign iteration `A <- (A + A^-1) / 2` takes `A` and `B` to `-I`, while
    `C <- (C + A^-1 C B^-1) / 2` goes to `-2 X`.

    Source: Roberts, 1971; Higham, 2008, section 5 (the scaling).
    """
    eps = float(xp.finfo(C.dtype).eps)
    pair = (A,) if B is None else (A, B)
    units = [xp.eye(len(M), dtype=M.dtype) for M in pair]

    def more(carry):
        *_, change, k = carry
        return (change > eps**0.5 / 10) & (k < _SIGN_STEPS)

    def body(carry):
        pair, C, _, k = carry
        inverses = [solve(M, unit) for M, unit in zip(pair, units, strict=True)]
        right = inverses[0].T if len(pair) == 1 else inverses[1]
        sizes = [largest(M) for M in pair], [largest(M) for M in inverses]
        ratio = (sum(sizes[1]) / sum(sizes[0])) ** 0.5
        # Near the limit the scale is close to 1 and is left out.
        scale = xp.where(xp.abs(ratio - 1) < 0.5, 1, ratio)
        after = [
            (scale * M + inverse / scale) / 2
            for M, inverse in zip(pair, inverses, strict=True)
        ]
        product = matmul(matmul(inverses[0], C), right)
        C = (scale * C + product / scale) / 2
        # A NaN compares false, so that a diverging member of a batch stops.
        change = sum(largest(M + unit) for M, unit in zip(after, units, strict=True))
        return tuple(after), C, change, k + 1

    start = pair, C, xp.asarray(xp.inf, C.dtype), xp.asarray(0)
    _, C, _, steps = while_loop(more, body, start)
    return -C / 2, steps


@full_precision
def gramian_over(A: Square, Q: Square, time: Scalar) -> Square:
    """The integral of `exp(A s) Q exp(A' s)` over `s` from 0 to `time`.

    If `A` is stiff, the exponential of `-A` over the whole time would overflow. It is
    taken over a short time with `|A| t < 1`, which is then doubled.

    Source: Van Loan, 1978.
    """
    # In units of the states that balance A. Otherwise a large entry of A hides others.
    A, unit = balanced(A)
    units = unit[:, None] * unit
    Q = Q / units
    fastest = stop_gradient(time * xp.linalg.norm(A))
    doublings = xp.clip(xp.ceil(xp.log2(xp.maximum(fastest, 1))), 0, MAX_DOUBLINGS)
    short = time * 0.5**doublings
    # exp([[-A, Q], [0, A']] t) = [[exp(-A t), exp(-A t) W], [0, exp(A' t)]].
    _, beside, power = exponential_of_blocks(-A * short, Q * short, A.T * short)
    power = power.T
    W = power @ beside

    # W(2t) = W(t) + exp(A t) W(t) exp(A' t), in a loop of fixed length, which reverse
    # mode needs.
    def double(carry, k):
        W, power = carry
        more = k < doublings
        # Unused powers are set to zero, because an overflow would reach the derivative.
        safe_power = xp.where(more, power, 0)
        W_next = W + safe_power @ W @ safe_power.T
        return (W_next, xp.where(more, safe_power @ safe_power, power)), None

    (W, _), _ = scan(double, (W, power), xp.arange(MAX_DOUBLINGS))
    return symmetric(W) * units
