"""The conditioning of normal distributions that all Kalman filters share."""

import abc
import math
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import lineax as lx
import numpy as np
from jaxtyping import Bool, Float, PyTree

from .._check import (
    as_vector,
    check_definite,
    check_finite,
    check_instance,
    symmetric_matrix,
)
from .._controller import wrong_observation
from .._jax import xp
from .._typing import (
    Array,
    Control,
    Difference,
    Observation,
    PRNGKey,
    RealScalar,
    Scalar,
)
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


class Joint(eqx.Module):
    """The joint normal distribution of a state `x` and of `z`, its image plus noise,

    `x = E[x] + X e`, `z = mean + Z e + noise`, `e ~ (0, P)`.

    Of the linear `z = C x + noise`, `Z` is `C`, `P` the covariance of the state and `X`
    the identity, which is left out. Of weighted points, `X` and `Z` have their
    deviations as columns, and `P` their weights, the diagonal of a matrix. What is
    known of a steady state need not be computed again.
    """

    mean: Array
    X: Array | None
    Z: Array
    P: Array
    noise: Array
    known_covariance: Array | None = None
    known_gain: Array | None = None
    known_remainder: Array | None = None

    def _form(self, A, B):
        """`A P B'`."""
        # A vector P is the diagonal of the weights of points, and scales columns.
        return (A @ self.P if self.P.ndim == 2 else A * self.P) @ B.T

    @property
    @full_precision
    def covariance(self):
        """The covariance of `z`."""
        if self.known_covariance is not None:
            return self.known_covariance
        # S = Z P Z' + noise: C Sigma C' + V of a sensor, A P A' + E W E' of a step.
        return symmetric(self._form(self.Z, self.Z) + self.noise)

    @property
    @full_precision
    def cross(self):
        """The covariance of `x` with `z`, shape `(n, p)`."""
        # X P Z', without the noise, which is independent of x.
        return self.P @ self.Z.T if self.X is None else self._form(self.X, self.Z)

    def gain(self):
        """The `G` of `E[x | z] = E[x] + G (z - E[z])`."""
        if self.known_gain is not None:
            return self.known_gain
        # G = cov(x, z) S^-1, solved as S G' = cov(z, x): S is symmetric, and no inverse
        # is formed.
        S, _ = _regular(self.covariance)
        if S.shape[0] <= SMALL:
            return solve(S, self.cross.T).T
        tag = lx.positive_semidefinite_tag
        return factorised(S, lx.Cholesky(), tag)(self.cross.T).T

    @full_precision
    def remainder(self, G):
        """The covariance of `x - G z`: that of `x` given `z`, at the gain."""
        if self.known_remainder is not None:
            return self.known_remainder
        # Joseph's form, a sum of congruences: it stays semidefinite in rounding, where
        # the shorter P - G S G' may not, and it is stationary in G, so that an error of
        # the gain counts to second order only.
        X = xp.eye(len(G), dtype=self.P.dtype) if self.X is None else self.X
        rest = X - G @ self.Z
        return symmetric(self._form(rest, rest) + G @ self.noise @ G.T)


@full_precision
def congruence(E: Float[Array, "n k"], W: Float[Array, "k k"]) -> Float[Array, "n n"]:
    """`E W E'`."""
    return symmetric(E @ W @ E.T)


def noise_of_state(E: Array | None, W: Array) -> Array:
    """The covariance of `E w`, `E` being the identity by default."""
    return W if E is None else congruence(E, W)


def _regular(S: Float[Array, "n n"]) -> tuple[Float[Array, "n n"], Bool[Array, " n"]]:
    """A covariance made definite, and which of its entries vary.

    What is added is of the size of rounding, in the units of each entry. An entry that
    does not vary is given the variance 1: nothing is correlated with it, so its gain
    is 0.
    """
    variances = xp.diagonal(S)
    varies = variances != 0
    slack = S.shape[0] * float(xp.finfo(S.dtype).eps)
    return S + xp.diag(xp.where(varies, slack * variances, 1)), varies


def square_root(P: Float[Array, "n n"]) -> Float[Array, "n n"]:
    """The lower triangular `L` of `P = L L'`; NaN if `P` is not semidefinite."""
    regular, varies = _regular(P)
    posed = is_definite(regular)
    # An indefinite matrix is kept out of the derivative too: `where` alone would
    # multiply a NaN cotangent by 0.
    eye = jnp.eye(P.shape[0], dtype=P.dtype)
    L = jnp.linalg.cholesky(jnp.where(posed, regular, eye))
    # A known entry was given the variance 1 only to be factored: its row of L is 0.
    return jnp.where(posed, jnp.where(varies[:, None], L, 0), jnp.nan)


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
    observation_difference: eqx.AbstractVar[Difference | None]

    @abc.abstractmethod
    def _observation(self, t: RealScalar, belief: Belief) -> Joint:
        """The moments of what will be observed at `t`."""

    @abc.abstractmethod
    def _transition(self, t: RealScalar, u: Control, belief: Belief) -> Joint:
        """The moments of the next state."""

    def __check_init__(self):
        self._model()

    def _model(self, default: Array | None = None) -> tuple[Array, Array, Array, Array]:
        """As `checked_model`."""
        given = self.W, self.V, self.mean, self.covariance
        return checked_model(self.dynamics, *given, type(self).__name__, default)

    def init(self, *, key: PRNGKey | None = None) -> PyTree:
        del key
        return Belief(self.mean, self.covariance)

    def update(self, t: RealScalar, y: Observation, state: PyTree):
        return self._corrected(state, *self._innovation(t, y, state))

    def predict(self, t: RealScalar, u: Control, state: PyTree):
        # A filter needs the marginal of the next state alone; the smoother its joint
        # distribution with this one.
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
        # Of normal x and z: the mean moves by G (z - E[z]), and the covariance becomes
        # P - G S G'.
        G = joint.gain()
        mean = belief.mean + matvec(G, innovation)
        return _like(Belief(mean, joint.remainder(G)), belief)

    @full_precision
    def _log_density(self, belief, joint, innovation):
        """The log-density of an innovation, `N(0, S)`; NaN if `S` is not definite."""
        S = joint.covariance
        posed, p = is_definite(S), len(S)
        L = jnp.linalg.cholesky(jnp.where(posed, S, jnp.eye(p, dtype=S.dtype)))
        # `r' S^-1 r = |L^-1 r|^2` and `log det S = 2 sum log L_ii`, from one factor.
        # A triangular solve, because the inverse of S would square the condition of L.
        lower = lx.MatrixLinearOperator(L, lx.lower_triangular_tag)
        r = innovation.astype(S.dtype)
        whitened = lx.linear_solve(lower, r, lx.Triangular(), throw=False).value
        log_scale = jnp.sum(jnp.log(jnp.diagonal(L))) + 0.5 * p * math.log(2 * math.pi)
        value = -0.5 * jnp.sum(whitened**2) - log_scale
        return jnp.where(posed, value, jnp.nan).astype(belief.mean.dtype)

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
        # Backwards, `P_k A' Sigma_{k+1}^-1` is the gain of `x_k` on the next state.
        G = joint.gain()
        # By the difference of the dynamics, so that angles go the shorter way.
        shift = self.dynamics.difference(after.mean, joint.mean)
        # P + G (P_after - Sigma) G', of which the remainder is P - G Sigma G': a sum of
        # two semidefinite terms, where the textbook's difference may lose that in
        # rounding.
        covariance = joint.remainder(G) + congruence(G, after.covariance)
        return _like(Belief(belief.mean + matvec(G, shift), covariance), belief)


def checked_model(
    dynamics: AbstractDynamics,
    W: Any,
    V: Any,
    mean: Any,
    covariance: Any,
    where: str,
    default: Array | None = None,
) -> tuple[Array, Array, Array, Array]:
    """`W`, `V`, and the mean and covariance of the first state, checked, and in the
    precision of all; where they are not given, `default` or zero and the identity.
    """
    n, p = dynamics.state_size, dynamics.observation_size
    k = dynamics.disturbance_size
    W = _covariance_matrix(W, k, "W", "the disturbance", where)
    V = _covariance_matrix(V, p, "V", "the observation", where)
    start: Any = np.zeros(n, W.dtype) if default is None else default
    mean = start if mean is None else as_vector(mean, n, "mean", where)
    check_finite(mean, "mean", where)
    P = np.eye(n, dtype=mean.dtype) if covariance is None else covariance
    P = _covariance_matrix(P, n, "covariance", "the state", where)
    # One precision for all, because loops carry the belief and keep its types.
    dtype = jnp.result_type(mean, P, start, W, V)
    return W, V, mean.astype(dtype), P.astype(dtype)


def check_dynamics(dynamics: Any, where: str) -> None:
    """Raise unless these are dynamics that measure deviations of their state."""
    check_instance(dynamics, AbstractDynamics, "dynamics", where)
    n = dynamics.state_size
    x = jnp.zeros(n)
    shape = eqx.filter_eval_shape(dynamics.difference, x, x).shape
    if shape != (n,):
        raise ValueError(
            f"{where}: dynamics must have a difference of the size of the state, "
            f"{(n,)}, got shape {shape}."
        )


def _like(after: Belief, before: Belief) -> Belief:
    """`after` in the types of `before`, as a loop must carry it."""
    return Belief(*(a.astype(b.dtype) for a, b in zip(after, before, strict=True)))


def _covariance_matrix(value: Any, size: int, name: str, of: str, where: str) -> Array:
    """`value` as a covariance matrix of `size`, or an error."""
    matrix = symmetric_matrix(value, name, where)
    if matrix.shape != (size, size):
        raise ValueError(
            f"{where}: {name} must have shape {(size, size)}, a row for each entry of "
            f"{of}, got {matrix.shape}."
        )
    check_definite(matrix, name, where, False)
    return matrix
