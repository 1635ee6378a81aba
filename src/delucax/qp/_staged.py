"""The staged form. A Riccati recursion solves the linear system in time linear in the
horizon.

The unknowns are `z_k = (x_k, u_k)`, shape `(T+1, n+m)`, with a last control of zero.
The equations are `x_0 = f_0` and `x_{k+1} - A_k x_k - B_k u_k = f_{k+1}`. Their
multipliers are the costates. A free entry of the start has no equation.
"""

import dataclasses
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Float

from .._typing import Array
from ..math._linear_solve import solve
from ..math._norms import power_of_two
from ._dense import cost_unit, regularisation
from ._form import AbstractForm, Scaling


_ELIMINATED = 6
"""Up to this many controls are eliminated entry by entry, more of them by LAPACK."""
_SUMMED = 16
"""Matrix products with an inner dimension up to this are written as sums."""
_PASSES = 3


class Factors(NamedTuple):
    """The factors of the Riccati recursion."""

    V: Array  # (T+1, n, n), the cost-to-go
    K: Array  # (T, m, n), the gains
    pivots: Array  # (T, m, m), the inverse of the weight of the controls
    closed: Array  # (T, n, n), A - B K


class StagedForm(AbstractForm):
    """A program in stages. The first rows of each stage are bounds of variables."""

    H: Float[Array, "steps N N"]
    q: Float[Array, "steps N"]
    F: Float[Array, "stages n N"]
    f: Float[Array, "steps n"]
    G: Float[Array, "steps p N"]
    lower: Float[Array, "steps rows"]
    upper: Float[Array, "steps rows"]
    soft: tuple[Array, Array] | None
    bounded: tuple[int, int] = eqx.field(static=True)
    free: tuple[int, ...] = eqx.field(static=True)
    """The entries of the start that are free."""

    def given(self, p):
        """The costates, or an array of their shape, with zeros for the free start."""
        return p.at[0, np.array(self.free)].set(0) if self.free else p

    def hessian(self, x):
        # H is symmetric, and this order of the sum reads memory along the rows.
        return _each_transposed(self.H, x)

    def rows(self, x):
        first, last = self.bounded
        return jnp.concatenate([x[:, first:last], _each(self.G, x)], axis=1)

    def rows_transposed(self, y):
        first, last = self.bounded
        y, general = y[:, : last - first], y[:, last - first :]
        pad = (0, 0), (first, self.q.shape[1] - last)
        return jnp.pad(y, pad) + _each_transposed(self.G, general)

    def equations(self, x):
        n = self.f.shape[1]
        steps = x[1:, :n] - _each(self.F, x[:-1])
        return self.given(jnp.concatenate([x[:1, :n], steps]))

    def equations_transposed(self, p):
        n, N = self.f.shape[1], self.q.shape[1]
        pulled = jnp.pad(_each_transposed(self.F, p[1:]), ((0, 1), (0, 0)))
        return jnp.pad(self.given(p), ((0, 0), (0, N - n))) - pulled

    def factorise(self, weight):
        first, last = self.bounded
        (_, n, N), dtype = self.F.shape, self.q.dtype
        own, general = weight[:, : last - first], weight[:, last - first :]
        diagonal = jnp.pad(own, ((0, 0), (first, N - last))) + regularisation(dtype)
        M = self.H + diagonal[:, :, None] * jnp.eye(N, dtype=dtype)
        if self.G.shape[1]:
            M = M + jnp.einsum("tpi,tp,tpj->tij", self.G, general, self.G)

        def back(V, here):
            F, M = here
            M = lax.optimization_barrier(
                M + _across(F, lax.optimization_barrier(_product(V, F)))
            )
            solved = _eliminated(M[n:, n:], M[n:, :n])
            K = solved[:, :n]
            before = M[:n, :n] - _across(M[n:, :n], K)
            return (before + before.T) / 2, (V, K, solved[:, n:])

        V, (after, K, pivots) = lax.scan(
            back, M[-1, :n, :n], (self.F, M[:-1]), reverse=True
        )
        closed = self.F[:, :, :n] - jnp.einsum("tij,tjk->tik", self.F[:, :, n:], K)
        return Factors(jnp.concatenate([V[None], after]), K, pivots, closed)

    def solve(self, factors, x, p):
        n = self.f.shape[1]
        V, K, pivots, closed = factors
        A_t = lambda v: _each_transposed(self.F, v)
        # The cost-to-go of a state is 1/2 x'V x + v'x. Terms that do not depend on the
        # recursion are computed for all stages at once.
        r, s = x[:, :n], x[:-1, n:]
        pushed = _each(V, p)
        added = _each_transposed(K, s) - r[:-1]

        def back(v, here):
            closed, pushed, added = here
            return added + _applied_transposed(closed, v + pushed), v

        v, after = lax.scan(back, -r[-1], (closed, pushed[1:], added), reverse=True)
        k = _each(pivots, A_t(after + pushed[1:])[:, n:] - s)
        at_start = self.given(p)[0]
        if self.free:
            free = np.array(self.free)
            slope = (v + _applied(V[0], at_start))[free, None]
            at_start = at_start.at[free].set(-solve(V[0][free][:, free], slope)[:, 0])
        reached = p[1:] - _each(self.F[:, :, n:], k)

        def forward(x, here):
            closed, reached = here
            return _applied(closed, x) + reached, x

        last, states = lax.scan(forward, at_start, (closed, reached))
        controls = -_each(K, states) - k
        states = jnp.concatenate([states, last[None]])
        costates = -_each(V, states) - jnp.concatenate([v[None], after])
        controls = jnp.pad(controls, ((0, 1), (0, 0)))
        return jnp.concatenate([states, controls], axis=1), self.given(costates)

    def equilibrated(self):
        n, N = self.f.shape[1], self.q.shape[1]
        largest = lambda M, axis: jnp.max(jnp.abs(M), axis=axis, initial=0)
        unit = lambda size: power_of_two(lax.rsqrt(jnp.where(size > 0, size, 1)))
        D, R = jnp.ones(N, self.q.dtype), jnp.ones(self.G.shape[:2], self.q.dtype)
        # A component has the same scale at all times, so that the step x_{k+1} - A x_k
        # keeps its form.
        H, general = lax.stop_gradient((largest(self.H, 0), self.G))

        def balance(_, scaled):
            H, D, R = scaled
            rows = largest(R[..., None] * general, (0, 1)) * D
            d = unit(jnp.maximum(largest(H, 0), rows))
            H, D = d[:, None] * H * d, D * d
            if self.G.shape[1]:
                R = 1 / largest(general * D, 2)
                R = power_of_two(jnp.where(jnp.isfinite(R), R, 1))
            return H, D, R

        _, D, R = lax.fori_loop(0, _PASSES, balance, (H, D, R))
        first, last = self.bounded
        E = 1 / D[:n]
        H = D[:, None] * self.H * D
        q = D * self.q
        c = cost_unit(*lax.stop_gradient((H, q)))
        G = R[..., None] * self.G * D
        rows = jnp.broadcast_to(1 / D[first:last], (len(R), last - first))
        scaling = Scaling(
            jnp.broadcast_to(D, self.q.shape),
            jnp.broadcast_to(E, self.f.shape),
            jnp.concatenate([rows, R], axis=1),
            c,
        )
        F = E[:, None] * self.F * D
        scaled = dict(H=c * H, q=c * q, F=F, f=E * self.f, G=G)
        return dataclasses.replace(self, **scaled), scaling

    def admissible(self, x, p):
        n = self.f.shape[1]
        return x.at[-1, n:].set(0), self.given(p)


def _eliminated(matrix: Array, right: Array) -> Array:
    """`matrix^-1 [right, I]` for a definite matrix."""
    m = matrix.shape[0]
    eye = jnp.eye(m, dtype=matrix.dtype)
    right = jnp.concatenate([right, eye], axis=1)
    if m == 0:
        return right
    if m > _ELIMINATED:
        L = jnp.linalg.cholesky(matrix, symmetrize_input=False)
        return jax.scipy.linalg.cho_solve((L, True), right)
    # Without a call of LAPACK, the loop over the stages is compiled as a whole and is
    # ten times as fast. A definite matrix needs no pivoting.
    rows = list(jnp.concatenate([matrix, right], axis=1))
    for i in range(m):
        rows[i] = rows[i] / rows[i][i]
        for j in range(m):
            if j != i:
                rows[j] = rows[j] - rows[j][i] * rows[i]
    return lax.optimization_barrier(jnp.stack(rows)[:, m:])


def _product(a, b):
    """`a @ b`, as a sum if it is small. The loop over stages then calls no library."""
    if a.shape[1] > _SUMMED:
        return a @ b
    return jnp.sum(a[:, :, None] * b, axis=1)


def _across(a, b):
    """`a.T @ b`."""
    if a.shape[0] > _SUMMED:
        return a.T @ b
    return jnp.sum(a[:, :, None] * b[:, None, :], axis=0)


def _applied(a, x):
    return jnp.sum(a * x, axis=1)


def _applied_transposed(a, x):
    return jnp.sum(a * x[:, None], axis=0)


def _each(a, x):
    """The product of each matrix with its vector."""
    return jnp.sum(a * x[:, None, :], axis=2)


def _each_transposed(a, x):
    return jnp.sum(a * x[:, :, None], axis=1)
