"""The smoother of a linear window, forwards and back, without an inverse.

Of the window `d_{k+1} = A_k d_k + E_k w_k + b_k`, `d_0 ~ N(mean, covariance)`,
`w_k ~ N(0, W)`, with rows `c'z_k = target + v`, `v ~ N(0, variance)`, `z_k` being
`(d_k, w_k)` or `d_k` alone. All covariances may be singular: a row of variance 0 is an
equation, and its multiplier is found with the others.

Source: Bryson and Frazier, 1963; Bierman, 1973 (without an inverse).
"""

from typing import NamedTuple

import jax.numpy as jnp
from jax import lax

from .._typing import Array
from ..math._linear_solve import full_precision
from ._base import Belief


class Steps(NamedTuple):
    """The steps of a window; after the last stage the state stays."""

    A: Array  # (N, n, n)
    E: Array  # (N, n, k)
    b: Array  # (N, n)


class Rows(NamedTuple):
    """Rows with independent noise; one that is all zero takes no part."""

    c: Array  # (N, R, n) or (N, R, n + k)
    variance: Array  # (N, R)
    target: Array  # (N, R)

    def beside(self, other: "Rows") -> "Rows":
        """These rows, then others."""
        size = max(self.c.shape[2], other.c.shape[2])
        wide = lambda c: jnp.pad(c, ((0, 0), (0, 0), (0, size - c.shape[2])))
        pairs = zip(self._replace(c=wide(self.c)), other, strict=True)
        return Rows(*(jnp.concatenate(pair, axis=1) for pair in pairs))


class Smoothed(NamedTuple):
    """The least-squares solution of a window."""

    d: Array  # (N, n)
    zeta: Array  # (N, k), of which `w = W zeta`
    rho: Array  # (N, n), the multipliers of the steps; `d_0 = mean + covariance rho_0`
    u: Array  # (N, R), of which the noise of a row is `variance u`
    variances: Array  # (N, n), of each state before it is observed
    last: Belief  # of the last state


def independent(V: Array, *rows: Array) -> tuple[Array, ...]:
    """The variances of rows whose noise has the covariance `V` once each is freed of
    what those before it say, and these rows; their number is the second axis."""
    # Elimination without exchanges. A row that says nothing new has variance 0.
    p, slack = len(V), len(V) * float(jnp.finfo(V.dtype).eps)
    V_rows = list(V)
    freed = [[array[:, i] for i in range(p)] for array in rows]
    for i in range(p):
        pivot = V_rows[i][i]
        varies = pivot > slack * V[i, i]
        pivot = jnp.where(varies, pivot, 1)
        V_rows[i] = jnp.where(varies, V_rows[i], 0)
        for j in range(i + 1, p):
            factor = V_rows[j][i] * varies / pivot
            V_rows[j] = V_rows[j] - factor * V_rows[i]
            for entries in freed:
                entries[j] = entries[j] - factor * entries[i]
    variances = jnp.stack([row[i] for i, row in enumerate(V_rows)])
    return variances, *(jnp.stack(entries, axis=1) for entries in freed)


def observed(m: Array, P: Array, rows: Rows) -> tuple[Array, Array, tuple]:
    """Mean and covariance once the rows of one stage are known, one after the other,
    with what the way back needs: of each row its gain, and its error over its variance.
    """
    kept = []
    for c, variance, target in zip(*rows, strict=True):
        Pc = jnp.sum(P * c, axis=1)
        S = jnp.sum(c * Pc) + variance
        unknown = S > 0
        safe = jnp.where(unknown, S, 1)
        G = Pc / safe
        error = jnp.where(unknown, target - jnp.sum(c * m), 0) / safe
        m = m + Pc * error
        # (I - G c') P (I - G c')' + variance G G', as updates of rank one.
        P = P - G[:, None] * Pc
        P = P - jnp.sum(P * c, axis=1)[:, None] * G + variance * G[:, None] * G
        kept.append((G, error))
    return m, (P + P.T) / 2, tuple(jnp.stack(a) for a in zip(*kept, strict=True))


@full_precision
def smoothed(steps: Steps, rows: Rows, start: Belief, W: Array) -> Smoothed:
    """The solution of the window. The rows are of `(d, w)` if they have as many
    columns."""
    A, E, b = steps
    n, k = E.shape[1:]
    is_wide = rows.c.shape[2] > n
    if is_wide:
        # The noise of a step is known before it is made, as a part of the state.
        A, Q = jnp.concatenate([A, E], axis=2), jnp.zeros_like(A)
    else:
        Q = E @ W @ E.mT

    def forward(carry, here):
        m, P = before = carry
        A, Q, b, rows = here
        if is_wide:
            m = jnp.concatenate([m, jnp.zeros(k, m.dtype)])
            P = jnp.block([[P, jnp.zeros((n, k), P.dtype)], [jnp.zeros((k, n)), W]])
        m, P, kept = observed(m, P, Rows(*rows))
        P = A @ P @ A.T + Q
        return (jnp.sum(A * m, axis=1) + b, (P + P.T) / 2), (before, kept)

    last, ((m, P), kept) = lax.scan(forward, tuple(start), (A, Q, b, tuple(rows)))

    def back(rho, here):
        A, c, (G, error) = here
        rho, u = jnp.sum(A * rho[:, None], axis=0), []
        for i in reversed(range(len(c))):
            u.append(error[i] - jnp.sum(G[i] * rho))
            rho = rho + c[i] * u[-1]
        return rho[:n], (rho, jnp.stack(u[::-1]))

    zero = jnp.zeros(n, m.dtype)
    _, (rho, u) = lax.scan(back, zero, (A, rows.c, kept), reverse=True)
    rho, zeta = rho[:, :n], rho[:, n:]
    if not is_wide:
        after = jnp.concatenate([rho[1:], zero[None]])
        zeta = jnp.sum(E * after[:, :, None], axis=1)
    d = m + jnp.sum(P * rho[:, None, :], axis=2)
    variances = jnp.diagonal(P, axis1=1, axis2=2)
    return Smoothed(d, zeta, rho, u, variances, Belief(*last))
