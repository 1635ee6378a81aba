"""Second moments of a state and of an image of it, which all Kalman filters share."""

import abc
import math

import equinox as eqx
import jax
import jax.numpy as jnp
import lineax as lx
from jaxtyping import Array, Bool, Float

from ..math._linear_solve import full_precision, is_definite, SMALL, solve, symmetric


class AbstractJoint(eqx.Module):
    """A state `x` and an image `z` of it with noise added, as jointly normal."""

    mean: eqx.AbstractVar[Array]

    @property
    @abc.abstractmethod
    def covariance(self) -> Array:
        """That of `z`."""

    @property
    @abc.abstractmethod
    def cross(self) -> Array:
        """The covariance of `x` with `z`, shape `(n, p)`."""

    @abc.abstractmethod
    def gain(self) -> Array:
        """The `G` of `E[x | z] = E[x] + G (z - E[z])`."""

    @abc.abstractmethod
    def remainder(self, G: Array) -> Array:
        """The covariance of `x - G z`: that of `x` given `z`, at the gain.

        A sum of congruences, so that it is symmetric and stays semidefinite in
        rounding, and an error in `G` counts to second order only.
        """


class LinearJoint(AbstractJoint):
    """The moments of `z = C x + noise`.

    What is known of a steady state need not be computed again.
    """

    mean: Array
    P: Array
    C: Array
    noise: Array
    known_covariance: Array | None = None
    known_gain: Array | None = None
    known_remainder: Array | None = None

    @property
    @full_precision
    def covariance(self):
        if self.known_covariance is not None:
            return self.known_covariance
        return symmetric(self.C @ self.P @ self.C.T + self.noise)

    @property
    @full_precision
    def cross(self):
        return self.P @ self.C.T

    def gain(self):
        if self.known_gain is not None:
            return self.known_gain
        return _gain(self.covariance, self.cross)

    @full_precision
    def remainder(self, G):
        if self.known_remainder is not None:
            return self.known_remainder
        # Joseph's form.
        rest = jnp.eye(self.P.shape[0], dtype=self.P.dtype) - G @ self.C
        return symmetric(rest @ self.P @ rest.T + G @ self.noise @ G.T)


class SampledJoint(AbstractJoint):
    """The moments of weighted points: deviations `dx` and `dz`, a row a point."""

    mean: Array
    dx: Array
    dz: Array
    weights: Array
    noise: Array

    @property
    @full_precision
    def covariance(self):
        return symmetric((self.weights * self.dz.T) @ self.dz + self.noise)

    @property
    @full_precision
    def cross(self):
        return (self.weights * self.dx.T) @ self.dz

    def gain(self):
        return _gain(self.covariance, self.cross)

    @full_precision
    def remainder(self, G):
        rest = self.dx - self.dz @ G.T
        return symmetric((self.weights * rest.T) @ rest + G @ self.noise @ G.T)


@full_precision
def congruence(E: Float[Array, "n k"], W: Float[Array, "k k"]) -> Float[Array, "n n"]:
    """`E W E'`."""
    return symmetric(E @ W @ E.T)


def _gain(S, cross):
    """`cross S^-1`, and no gain on what does not vary."""
    S, _ = _regular(S)
    if S.shape[0] <= SMALL:
        return solve(S, cross.T).T
    operator = lx.MatrixLinearOperator(S, lx.positive_semidefinite_tag)
    solver = lx.Cholesky()
    state = solver.init(operator, {})

    def row(c):
        return lx.linear_solve(operator, c, solver, state=state, throw=False).value

    return jax.vmap(row)(cross)


def _regular(S: Float[Array, "n n"]) -> tuple[Float[Array, "n n"], Bool[Array, " n"]]:
    """A covariance made definite, and which of its entries vary.

    What is added is of the size of rounding, in the units of each entry. An entry that
    does not vary is given the variance 1: nothing is correlated with it.
    """
    variances = jnp.diagonal(S)
    varies = variances != 0
    slack = S.shape[0] * float(jnp.finfo(S.dtype).eps)
    return S + jnp.diag(jnp.where(varies, slack * variances, 1)), varies


def square_root(P: Float[Array, "n n"]) -> Float[Array, "n n"]:
    """The lower triangular `L` of `P = L L'`; NaN if `P` is not semidefinite."""
    regular, varies = _regular(P)
    posed = is_definite(regular)
    # A matrix that has no root is kept out of the derivative too.
    eye = jnp.eye(P.shape[0], dtype=P.dtype)
    L = jnp.linalg.cholesky(jnp.where(posed, regular, eye))
    return jnp.where(posed, jnp.where(varies[:, None], L, 0), jnp.nan)


@full_precision
def log_density(
    residual: Float[Array, " p"], S: Float[Array, "p p"]
) -> Float[Array, ""]:
    """The logarithm of the normal density `N(0, S)`; NaN if `S` is not definite."""
    (p,) = residual.shape
    posed = is_definite(S)
    L = jnp.linalg.cholesky(jnp.where(posed, S, jnp.eye(p, dtype=S.dtype)))
    operator = lx.MatrixLinearOperator(L, lx.lower_triangular_tag)
    whitened = lx.linear_solve(operator, residual, lx.Triangular(), throw=False).value
    log_scale = jnp.sum(jnp.log(jnp.diagonal(L))) + 0.5 * p * math.log(2 * math.pi)
    value = -0.5 * jnp.sum(whitened**2) - log_scale
    return jnp.where(posed, value, jnp.nan)
