"""What all Kalman filters share: second moments, and the steps made of them."""

import abc
import math
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import lineax as lx
from jaxtyping import Array, Bool, Float

from .._check import (
    as_vector,
    check_definite,
    check_finite,
    symmetric_matrix,
)
from .._controller import wrong_observation
from .._typing import Control, Observation, RealScalar, Scalar
from ..dynamics import AbstractDynamics
from ..math import matvec
from ..math._linear_solve import (
    factorised,
    full_precision,
    is_definite,
    SMALL,
    solve,
    symmetric,
)
from ._base import AbstractEstimator, Belief


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
    tag = lx.positive_semidefinite_tag
    return factorised(S, lx.Cholesky(), tag)(cross.T).T


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


class AbstractGaussianFilter(AbstractEstimator):
    """An estimator that takes the state to be normal, with linear updates.

    The filters differ in how they find the moments of what is observed and of the next
    state.
    """

    dynamics: eqx.AbstractVar[AbstractDynamics]
    W: eqx.AbstractVar[Float[Array, "k k"]]
    V: eqx.AbstractVar[Float[Array, "p p"]]
    mean: eqx.AbstractVar[Float[Array, " n"]]
    covariance: eqx.AbstractVar[Float[Array, "n n"]]
    observation_difference: eqx.AbstractVar[Callable[[Array, Array], Array] | None]

    @abc.abstractmethod
    def _observation(self, t: RealScalar, belief: Belief) -> AbstractJoint:
        """The moments of what will be observed at `t`."""

    @abc.abstractmethod
    def _transition(self, t: RealScalar, u: Control, belief: Belief) -> AbstractJoint:
        """The moments of the next state."""

    def __check_init__(self):
        where, n = type(self).__name__, self.dynamics.state_size
        noise_covariances(self.dynamics, self.W, self.V, where)
        as_vector(self.mean, n, "mean", where)
        covariance_matrix(self.covariance, n, "covariance", "the state", where)

    def init(self, *, key=None):
        del key
        return Belief(self.mean, self.covariance)

    def update(self, t, y, state):
        return self._corrected(state, *self._innovation(t, y, state))

    def predict(self, t, u, state):
        joint = self._prediction(t, u, state)
        return _like(Belief(joint.mean, joint.covariance), state)

    def log_likelihood(self, t: RealScalar, y: Observation, belief: Belief) -> Scalar:
        """The log-density of an observation, given what is known before it.

        Summed over a record, it is the log-likelihood of the model.

        **Arguments:**

        - `t`: time of the observation, a scalar.
        - `y`: the observation, shape `(p,)`.
        - `belief`: what is known of the state at `t`, without `y`.

        **Returns:** a scalar; NaN if the covariance of the observation is not definite.
        """
        return self._log_density(belief, *self._innovation(t, y, belief))

    def _innovation(self, t, y, belief):
        """The moments of the expected observation, and how far `y` is from its mean."""
        if y.shape != self.V.shape[:1]:
            raise wrong_observation(self, self.V.shape[0], y)
        joint = self._observation(t, belief)
        if self.observation_difference is None:
            return joint, y - joint.mean
        return joint, self.observation_difference(y, joint.mean)

    def _corrected(self, belief, joint, innovation):
        G = joint.gain()
        mean = belief.mean + matvec(G, innovation)
        return _like(Belief(mean, joint.remainder(G)), belief)

    def _log_density(self, belief, joint, innovation):
        S = joint.covariance
        return log_density(innovation.astype(S.dtype), S).astype(belief.mean.dtype)

    def _prediction(self, t, u, belief):
        m = self.dynamics.control_size
        if u.shape != (m,):
            raise ValueError(
                f"{type(self).__name__}: u must have shape {(m,)}, as the controls of "
                f"its dynamics, got {u.shape}."
            )
        return self._transition(t, u.astype(belief.mean.dtype), belief)

    def _smoothed(self, t, u, belief, after):
        """The belief once that of the next state, `after`, is known from all data."""
        joint = self._prediction(t, u, belief)
        G = joint.gain()
        shift = self.dynamics.difference(after.mean, joint.mean)
        covariance = joint.remainder(G) + G @ after.covariance @ G.T
        return _like(Belief(belief.mean + matvec(G, shift), covariance), belief)


def _like(after: Belief, before: Belief) -> Belief:
    """`after` in the types of `before`, as a loop must carry it."""
    return Belief(*(a.astype(b.dtype) for a, b in zip(after, before, strict=True)))


def noise_covariances(
    dynamics: AbstractDynamics, W: Any, V: Any, where: str
) -> tuple[Array, Array]:
    """`W` and `V`, of the sizes that `dynamics` have, or an error."""
    k, p = dynamics.disturbance_size, dynamics.observation_size
    W = covariance_matrix(W, k, "W", "the disturbance", where)
    return W, covariance_matrix(V, p, "V", "the observation", where)


def covariance_matrix(value: Any, size: int, name: str, of: str, where: str) -> Array:
    """`value` as a covariance matrix of `size`, or an error."""
    matrix = symmetric_matrix(value, name, where)
    if matrix.shape != (size, size):
        raise ValueError(
            f"{where}: {name} must have shape {(size, size)}, a row for each entry of "
            f"{of}, got {matrix.shape}."
        )
    check_definite(matrix, name, where, False)
    return matrix


def gaussian_model(
    dynamics: AbstractDynamics,
    W: Any,
    V: Any,
    mean: Any,
    covariance: Any,
    default: Array | None,
    where: str,
) -> tuple[Array, Array, Array, Array]:
    """The covariances `W` and `V` of the noise, and the mean (`default`, or zero, if
    there is none) and covariance of the first state, in the precision of all."""
    W, V = noise_covariances(dynamics, W, V, where)
    n = dynamics.state_size
    default = jnp.zeros(n, W.dtype) if default is None else default
    mean = default if mean is None else as_vector(mean, n, "mean", where)
    check_finite(mean, "mean", where)
    if covariance is None:
        covariance = jnp.eye(n, dtype=mean.dtype)
    covariance = covariance_matrix(covariance, n, "covariance", "the state", where)
    dtype = jnp.result_type(mean, covariance, default, W, V)
    return W, V, mean.astype(dtype), covariance.astype(dtype)
