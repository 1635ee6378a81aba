"""The dense form, for any program of up to some hundreds of variables."""

import dataclasses
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import jax.scipy.linalg as jsl
from jax import lax
from jaxtyping import Float

from .._typing import Array
from ..math._norms import power_of_two
from ._form import AbstractForm, Scaling


_PASSES = 4
"""The passes of the equilibration. Each scales by a square root of the sizes."""


class Factors(NamedTuple):
    """The factors of `M = H + G'W G + F'F` and of the Schur complement `F M^-1 F'`."""

    L: Array
    solved: Array  # M^-1 F', shape (n, e)
    S: Array


class DenseForm(AbstractForm):
    """A program with dense matrices.

    With `bounded`, the first rows are the bounds of the variables.
    """

    H: Float[Array, "n n"]
    q: Float[Array, " n"]
    F: Float[Array, "e n"]
    f: Float[Array, " e"]
    G: Float[Array, "p n"]
    lower: Float[Array, " rows"]
    upper: Float[Array, " rows"]
    soft: tuple[Array, Array] | None
    bounded: bool = eqx.field(static=True)

    def hessian(self, x):
        return self.H @ x

    def rows(self, x):
        general = self.G @ x
        return jnp.concatenate([x, general]) if self.bounded else general

    def rows_transposed(self, y):
        if not self.bounded:
            return self.G.T @ y
        n = self.q.shape[0]
        return y[:n] + self.G.T @ y[n:]

    def equations(self, x):
        return self.F @ x

    def equations_transposed(self, p):
        return self.F.T @ p

    def factorise(self, weight):
        n, e = self.q.shape[0], self.f.shape[0]
        M, general = self.H, weight
        eye = jnp.eye(n, dtype=self.q.dtype)
        shift = jnp.full(n, regularisation(self.q.dtype))
        if self.bounded:
            shift, general = shift + weight[:n], weight[n:]
        M = M + eye * shift
        if self.G.shape[0]:
            M = M + (self.G.T * general) @ self.G
        if e:
            # F'F changes nothing on F x = f, and makes M definite where H is not.
            M = M + self.F.T @ self.F
        L = jnp.linalg.cholesky(M, symmetrize_input=False)
        solved = jsl.cho_solve((L, True), self.F.T) if e else self.F.T
        S = self.F @ solved + regularisation(self.q.dtype) * jnp.eye(e, dtype=L.dtype)
        return Factors(L, solved, jnp.linalg.cholesky(S) if e else S)

    def solve(self, factors, x, p):
        if not self.f.shape[0]:
            return jsl.cho_solve((factors.L, True), x), p
        free = jsl.cho_solve((factors.L, True), x + self.F.T @ p)
        # The equations hold for the multipliers dp = S^-1 (F free - p).
        dp = jsl.cho_solve((factors.S, True), self.F @ free - p)
        return free - factors.solved @ dp, dp

    def rows_matrix(self):
        """The matrix of all rows, with the bounds of the variables."""
        eye = jnp.eye(self.q.shape[0], dtype=self.q.dtype)
        return jnp.concatenate([eye, self.G]) if self.bounded else self.G

    def equilibrated(self):
        n, dtype = self.q.shape[0], self.q.dtype
        D, E, R = (jnp.ones(size, dtype) for size in (n, *map(len, (self.F, self.G))))
        # The solution does not depend on the scales, so they need no derivative.
        H, F, G = lax.stop_gradient((self.H, self.F, self.G))
        largest = lambda M, axis: jnp.max(jnp.abs(M), axis=axis, initial=0)
        unit = lambda size: power_of_two(lax.rsqrt(jnp.where(size > 0, size, 1)))

        def balance(_, scaled):
            H, F, G, D, E, R = scaled
            across = jnp.maximum(largest(H, 0), largest(F, 0))
            d = unit(jnp.maximum(across, largest(G, 0)))
            e, r = unit(largest(F, 1)), unit(largest(G, 1))
            H, F, G = d[:, None] * H * d, e[:, None] * F * d, r[:, None] * G * d
            return H, F, G, D * d, E * e, R * r

        H, *_, D, E, R = lax.fori_loop(0, _PASSES, balance, (H, F, G, D, E, R))
        q = D * self.q
        c = cost_unit(H, lax.stop_gradient(q))
        H = D[:, None] * self.H * D
        F, G = E[:, None] * self.F * D, R[:, None] * self.G * D
        # The bound of a variable has the scale of the variable.
        rows = jnp.concatenate([1 / D, R]) if self.bounded else R
        scaled = dict(H=c * H, q=c * q, F=F, f=E * self.f, G=G)
        return dataclasses.replace(self, **scaled), Scaling(D, E, rows, c)

    def meaningful(self, sides):
        # A row of zeros with a bound of zero has no interior, so the method would not
        # converge. Such rows are left out if they hold.
        empty = jnp.max(jnp.abs(self.rows_matrix()), axis=1, initial=0) == 0
        slack = 10 * jnp.finfo(self.q.dtype).eps * jnp.max(jnp.abs(sides.h), initial=0)
        off = empty & (sides.h >= -slack)
        off = off & ~(sides.equality & (sides.h > slack))
        on = lambda kind: kind & ~off
        return sides._replace(
            h=jnp.where(off, 0, sides.h),
            inequality=on(sides.inequality),
            equality=on(sides.equality),
            soft=on(sides.soft),
            hinge=on(sides.hinge),
        )


def regularisation(dtype) -> float:
    """The regularisation of the diagonal of a scaled problem. Refinement removes its
    effect on the solution."""
    return float(jnp.finfo(dtype).eps) ** 0.75


def cost_unit(H: Array, q: Array) -> Array:
    """A power of two that makes the scaled cost of size 1."""
    size = jnp.maximum(jnp.mean(jnp.max(jnp.abs(H), axis=-1)), jnp.max(jnp.abs(q)))
    return power_of_two(1 / jnp.where(size > 0, size, 1))
