"""The smoother of a linear window: a pass forwards and a pass back, without inverses.

The window is `d_{k+1} = A_k d_k + E_k w_k + b_k`, `d_0 ~ N(mean, covariance)`,
`w_k ~ N(0, W)`. Its observations are rows `c' z_k = target + v`, `v ~ N(0, variance)`,
where `z_k` is `d_k`, or `d_k` and `w_k`. All covariances may be singular. A row with
variance 0 is an equation; its multiplier is computed like the others.

Source: Bryson and Frazier, 1963; Bierman, 1973 (without an inverse).
"""

from typing import NamedTuple

import jax.numpy as jnp
from jax import lax

from .._typing import Array
from ..math._linear_solve import full_precision
from ._base import Belief


_WRITTEN_OUT = 12
"""Loops over at most this many rows are unrolled."""


class Steps(NamedTuple):
    """The steps of a window. After the last stage the state stays constant."""

    A: Array  # (N, n, n)
    E: Array  # (N, n, k)
    b: Array  # (N, n)


class Rows(NamedTuple):
    """Rows with independent noise. A row of zeros has no effect."""

    c: Array  # (N, R, n) or (N, R, n + k)
    variance: Array  # (N, R)
    target: Array  # (N, R)

    def beside(self, other: "Rows") -> "Rows":
        """These rows followed by the rows of `other`."""
        size = max(self.c.shape[2], other.c.shape[2])
        wide = lambda c: jnp.pad(c, ((0, 0), (0, 0), (0, size - c.shape[2])))
        pairs = zip(self._replace(c=wide(self.c)), other, strict=True)
        return Rows(*(jnp.concatenate(pair, axis=1) for pair in pairs))


class Smoothed(NamedTuple):
    """The least-squares solution of a window."""

    d: Array  # (N, n)
    zeta: Array  # (N, k), the disturbances are `w = W zeta`
    rho: Array  # (N, n), the multipliers of the steps; `d_0 = mean + covariance rho_0`
    u: Array  # (N, R), the noise of a row is `variance u`
    variances: Array  # (N, n), of each state before it is observed
    last: Belief  # of the last state


def independent(V: Array, *rows: Array) -> tuple[Array, ...]:
    """Transform observations with noise of covariance `V` to independent noise.

    Returns the new variances, and each of `rows` transformed along its second axis.
    """
    # Gaussian elimination without pivoting. A row that is determined by the rows before
    # it gets variance 0.
    p, slack = len(V), len(V) * float(jnp.finfo(V.dtype).eps)
    own, freed = jnp.diagonal(V), list(rows)
    for i in range(p - 1):
        varies = V[i, i] > slack * own[i]
        factor = V[:, i] / jnp.where(varies, V[i, i], 1)
        factor = jnp.where(varies & (jnp.arange(p) > i), factor, 0)
        V = V - factor[:, None] * V[i]
        for k, a in enumerate(freed):
            shares = factor.reshape(p, *(1,) * (a.ndim - 2))
            freed[k] = a - shares * a[:, i : i + 1]
    variances = jnp.diagonal(V)
    return jnp.where(variances > slack * own, variances, 0), *freed


def observed(m: Array, P: Array, rows: Rows) -> tuple[Array, Array, tuple]:
    """Mean and covariance after the observations of one stage, one row after the other.

    Also returns what the pass back needs: for each row its gain, and its error over the
    variance of the error.
    """

    def known(carry, row):
        m, P = carry
        c, variance, target = row
        Pc = jnp.sum(P * c, axis=1)
        S = jnp.sum(c * Pc) + variance
        safe = jnp.where(S > 0, S, 1)
        G = Pc / safe
        error = jnp.where(S > 0, target - jnp.sum(c * m), 0) / safe
        m = m + Pc * error
        # (I - G c') P (I - G c')' + variance G G', by two updates of rank one.
        P = P - G[:, None] * Pc
        P = P - jnp.sum(P * c, axis=1)[:, None] * G + variance * G[:, None] * G
        return (m, P), (G, error)

    unroll = _unrolled(len(rows.c))
    (m, P), kept = lax.scan(known, (m, P), tuple(rows), unroll=unroll)
    return m, (P + P.T) / 2, kept


def _unrolled(count: int) -> int:
    """The number of rows to unroll. A nested loop is slow, and many unrolled rows are
    a long program."""
    return count if count <= _WRITTEN_OUT else 1


@full_precision
def smoothed(steps: Steps, rows: Rows, start: Belief, W: Array) -> Smoothed:
    """The solution of the window. If the rows have more columns than `d`, they act on
    `(d, w)`."""
    A, E, b = steps
    n, k = E.shape[1:]
    is_wide = rows.c.shape[2] > n
    if is_wide:
        # The disturbance of the next step is part of the state, so that rows can
        # observe it.
        A, Q = jnp.concatenate([A, E], axis=2), jnp.zeros_like(A)
    else:
        Q = E @ W @ E.mT

    def forward(carry, here):
        m, P = before = carry
        A, Q, b, rows = here
        if is_wide:
            m = jnp.concatenate([m, jnp.zeros(k, m.dtype)])
            beside = jnp.zeros((n, k), P.dtype)
            P = jnp.block([[P, beside], [beside.T, W]])
        m, P, kept = observed(m, P, Rows(*rows))
        P = A @ P @ A.T + Q
        return (jnp.sum(A * m, axis=1) + b, (P + P.T) / 2), (before, kept)

    last, ((m, P), kept) = lax.scan(forward, tuple(start), (A, Q, b, tuple(rows)))

    def back(rho, here):
        A, c, (G, error) = here

        def known(rho, row):
            c, G, error = row
            u = error - jnp.sum(G * rho)
            return rho + c * u, u

        rho, given = jnp.sum(A * rho[:, None], axis=0), (c, G, error)
        unroll = _unrolled(len(c))
        rho, u = lax.scan(known, rho, given, reverse=True, unroll=unroll)
        return rho[:n], (rho, u)

    zero = jnp.zeros(n, m.dtype)
    _, (rho, u) = lax.scan(back, zero, (A, rows.c, kept), reverse=True)
    rho, zeta = rho[:, :n], rho[:, n:]
    if not is_wide:
        after = jnp.concatenate([rho[1:], zero[None]])
        zeta = jnp.sum(E * after[:, :, None], axis=1)
    d = m + jnp.sum(P * rho[:, None, :], axis=2)
    variances = jnp.diagonal(P, axis1=1, axis2=2)
    return Smoothed(d, zeta, rho, u, variances, Belief(*last))
