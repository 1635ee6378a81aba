"""The matrix logarithm, and the exponential that it inverts."""

import jax
import numpy as np
from jaxtyping import Bool, Float

from .._jax import (
    custom_jvp,
    fori_loop,
    lax,
    scan,
    stop_gradient,
    while_loop,
    xp,
)
from .._typing import Array
from ..math._linear_solve import full_precision, solve


_MAX_ROOTS = 40
_MAX_ROOT_STEPS = 60
_CLOSE = 0.25
"""Within this distance from the identity, the quadrature is exact to rounding."""
_SQUARINGS = 12
_TERMS = 9
"""The terms of the series of the exponential: exact to rounding for norms up to 300."""


def logarithm(
    A: Float[Array, "n n"],
) -> tuple[Float[Array, "n n"], Bool[Array, ""]]:
    """The principal logarithm, and whether it failed.

    It is differentiated as the inverse of the exponential: the derivative of the
    exponential is a linear map, and the logarithm of a block matrix inverts it.
    """
    # The iterations have no reverse mode. They run on a constant, and the derivative is
    # defined separately.
    constant = stop_gradient(A)
    eye = xp.eye(A.shape[0], dtype=A.dtype)
    value, converged = _by_roots(constant)
    error = xp.linalg.norm(exponential_less_one(value) + eye - constant)
    # The result is checked: its exponential must be A.
    close = error <= xp.finfo(A.dtype).eps ** 0.5 * xp.linalg.norm(constant)
    failed = ~(converged & close)
    # A failed matrix is replaced by the identity, so that derivatives are finite.
    constant = xp.where(failed, eye, constant)
    value = xp.where(failed, 0, value)
    return _with_derivative(xp.where(failed, eye, A), constant, value), failed


@custom_jvp
def _with_derivative(A, constant, value):
    """`value`, the logarithm of `A`, with its derivative."""
    del A, constant
    return value


@_with_derivative.defjvp
@full_precision
def _with_derivative_jvp(primals, tangents):
    _, constant, _ = primals
    logarithm = _with_derivative(*primals)

    def inverse(M, right):
        """The tangent `D` of the logarithm along `E`, as a block of the logarithm of a
        block matrix: `log [[M, E], [0, M]] = [[log M, D], [0, log M]]`."""
        # D is linear in E. E is scaled, so that the block matrix is as close to the
        # identity as M is.
        n = M.shape[0]
        size = xp.linalg.norm(right)
        size = xp.where(size > 0, size, 1)
        block = xp.block([[M, right / size], [xp.zeros_like(M), M]])
        return _by_roots(block)[0][:n, n:] * size

    # Reverse mode: the transpose of the derivative at M is the derivative at M'
    # (Higham, 2008).
    tangent = lax.custom_linear_solve(
        lambda tangent: jax.jvp(exponential_less_one, (logarithm,), (tangent,))[1],
        tangents[0],
        solve=lambda _, right: inverse(constant, right),
        transpose_solve=lambda _, right: inverse(constant.T, right),
    )
    return logarithm, tangent


def exponential_less_one(L: Array) -> Array:
    """`exp(L) - I`. A fixed number of squarings keeps the programs of its derivatives
    small. Each maps `P` to `(I + P)^2 - I`, so that a small `P` keeps its digits."""
    X = L / 2**_SQUARINGS
    eye = xp.eye(L.shape[0], dtype=L.dtype)
    # Horner's rule: X + X^2/2! + ... = X (I + X/2 (I + X/3 (I + ...))).
    P = X / _TERMS
    for k in range(_TERMS - 1, 0, -1):
        P = X @ (eye + P) / k
    return fori_loop(0, _SQUARINGS, lambda _, P: 2 * P + P @ P, P)


def _by_roots(A: Array) -> tuple[Array, Array]:
    """The logarithm by inverse scaling and squaring: that of a root near the identity,
    times the order of the root."""
    eye = xp.eye(A.shape[0], dtype=A.dtype)

    def proceeds(carry):
        root, k, converged = carry
        far = xp.linalg.norm(root - eye) > _CLOSE
        return far & converged & (k < _MAX_ROOTS)

    def body(carry):
        root, k, _ = carry
        root, converged = _square_root(root)
        return root, k + 1, converged

    start = (A, xp.asarray(0), xp.asarray(True))
    root, k, converged = while_loop(proceeds, body, start)
    # log A = 2^k log A^(1/2^k).
    X = root - eye
    converged = converged & (xp.linalg.norm(X) <= _CLOSE)
    X = xp.where(converged, X, 0)

    # Gauss-Legendre for the integral over [0, 1] of X (I + x X)^-1.
    def add(total, rule):
        node, weight = rule
        # The rule is for [-1, 1]: x = (1 + node) / 2, with half of the weight.
        return total + weight / 2 * solve(eye + (1 + node) / 2 * X, X), None

    nodes, weights = np.polynomial.legendre.leggauss(8)
    rules = xp.asarray(nodes, A.dtype), xp.asarray(weights, A.dtype)
    total, _ = scan(add, xp.zeros_like(A), rules)
    return total * 2.0**k, converged


def _square_root(A: Array) -> tuple[Array, Array]:
    """The principal square root, by the product form of Denman and Beavers' iteration.

    `M` converges to the identity and `Y` to the root, unless an eigenvalue is on the
    closed negative real axis.
    """
    n, eps = A.shape[0], xp.finfo(A.dtype).eps
    # Y_{k+1} = Y_k (I + M_k^-1) / 2, M_{k+1} = (I + (M_k + M_k^-1) / 2) / 2. This is
    # Newton's method for Y^2 = A, in a form that is stable under rounding.
    eye = xp.eye(n, dtype=A.dtype)
    small = 10 * n * eps

    def proceeds(carry):
        _, _, error, before, k = carry
        # Convergence is quadratic: an error that no longer halves is rounding.
        going = (error > small) & ((error < before / 2) | (before > 0.1))
        return going & xp.isfinite(error) & (k < _MAX_ROOT_STEPS)

    def body(carry):
        M, Y, error, _, k = carry
        inverse = solve(M, eye)
        Y = (Y + Y @ inverse) / 2
        M = eye / 2 + (M + inverse) / 4
        return M, Y, xp.linalg.norm(M - eye), error, k + 1

    far = xp.asarray(xp.inf, A.dtype)
    start = (A, A, xp.asarray(xp.finfo(A.dtype).max, A.dtype), far, xp.asarray(0))
    _, root, error, *_ = while_loop(proceeds, body, start)
    # A NaN compares false, and so counts as no root.
    return root, error < eps**0.5 * n
