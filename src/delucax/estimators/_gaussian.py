"""The conditioning of normal distributions, which all Kalman filters share."""

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
    full_precision,
    is_definite,
    solve,
    symmetric,
)
from ._base import AbstractEstimator, Belief


class Joint(eqx.Module):
    r"""The joint distribution of a state `x` and of `z`, a function of it plus noise.

    $$x = E[x] + X e, \qquad z = \mathrm{mean} + Z e + \mathrm{noise}, \qquad
    e \sim (0, P)$$

    For a linear function `C x`, `Z` is `C`, `P` is the covariance of `x`, and `X` is
    the identity, which is left out. For weighted points, the columns of `X` and `Z` are
    the deviations of the points, and the vector `P` holds their weights. In a steady
    state, the `known_` fields hold results that need not be computed again.
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
        # A vector P, the weights of points, is a diagonal matrix: it scales columns.
        return (A @ self.P if self.P.ndim == 2 else A * self.P) @ B.T

    @property
    @full_precision
    def covariance(self):
        """The covariance of `z`."""
        if self.known_covariance is not None:
            return self.known_covariance
        # Z P Z' + noise is C Sigma C' + V for a sensor, and A P A' + E W E' for a step.
        return symmetric(self._form(self.Z, self.Z) + self.noise)

    @property
    @full_precision
    def cross(self):
        """The covariance of `x` with `z`, shape `(n, p)`."""
        # The noise does not appear, because it is independent of x.
        return self.P @ self.Z.T if self.X is None else self._form(self.X, self.Z)

    def gain(self):
        """The gain `G` in `E[x | z] = E[x] + G (z - E[z])`."""
        if self.known_gain is not None:
            return self.known_gain
        # G = cov(x, z) S^-1 is solved as S G' = cov(z, x), without an inverse. Not by
        # Cholesky, because a singular S may be indefinite by more than its slack.
        S, _ = _regular(self.covariance)
        return solve(S, self.cross.T).T

    @full_precision
    def remainder(self, G):
        """The covariance of `x - G z`. For the gain of `gain`, it is that of `x` given
        `z`."""
        if self.known_remainder is not None:
            return self.known_remainder
        # Joseph's form stays semidefinite under rounding, because it is a sum of
        # congruences; P - G S G' may not. It is also stationary in G, so an error of
        # the gain counts to second order only.
        X = xp.eye(len(G), dtype=self.P.dtype) if self.X is None else self.X
        rest = X - G @ self.Z
        return symmetric(self._form(rest, rest) + G @ self.noise @ G.T)


@full_precision
def congruence(E: Float[Array, "n k"], W: Float[Array, "k k"]) -> Float[Array, "n n"]:
    """`E W E'`."""
    return symmetric(E @ W @ E.T)


def noise_of_state(E: Array | None, W: Array) -> Array:
    """The covariance of `E w`. `E` is the identity if it is `None`."""
    return W if E is None else congruence(E, W)


def _regular(S: Float[Array, "n n"]) -> tuple[Float[Array, "n n"], Bool[Array, " n"]]:
    """A covariance made definite, and whether each of its entries varies.

    The variances grow by about the rounding of each. A variance of 0 becomes 1; nothing
    is correlated with this entry, so its gain is still 0.
    """
    variances = xp.diagonal(S)
    varies = variances != 0
    slack = S.shape[0] * float(xp.finfo(S.dtype).eps)
    return S + xp.diag(xp.where(varies, slack * variances, 1)), varies


def square_root(P: Float[Array, "n n"]) -> Float[Array, "n n"]:
    """The lower triangular `L` in `P = L L'`; NaN if `P` is not semidefinite."""
    regular, varies = _regular(P)
    posed = is_definite(regular)
    # An indefinite matrix must be replaced before it is factored: masking only the
    # result would multiply NaN by 0 in the derivative.
    eye = jnp.eye(P.shape[0], dtype=P.dtype)
    L = jnp.linalg.cholesky(jnp.where(posed, regular, eye))
    # An entry without variance was given the variance 1 only for the factorisation; its
    # row of L is 0.
    return jnp.where(posed, jnp.where(varies[:, None], L, 0), jnp.nan)


class AbstractGaussianFilter(AbstractEstimator):
    """A Kalman filter: a normal belief, with updates that are linear in the innovation.

    Its subclasses differ in how they compute the moments of the observation and of the
    next state.
    """

    dynamics: eqx.AbstractVar[AbstractDynamics]
    W: eqx.AbstractVar[Float[Array, "k k"]]
    V: eqx.AbstractVar[Float[Array, "p p"]]
    mean: eqx.AbstractVar[Float[Array, " n"]]
    covariance: eqx.AbstractVar[Float[Array, "n n"]]
    observation_difference: eqx.AbstractVar[Difference | None]

    @abc.abstractmethod
    def _observation(self, t: RealScalar, belief: Belief) -> Joint:
        """The joint moments of the state and of the observation at `t`."""

    @abc.abstractmethod
    def _transition(self, t: RealScalar, u: Control, belief: Belief) -> Joint:
        """The joint moments of the state and of the next state."""

    def __check_init__(self):
        self._model()

    def _model(self, default: Array | None = None) -> tuple[Array, Array, Array, Array]:
        """The fields checked by `checked_model`."""
        given = self.W, self.V, self.mean, self.covariance
        return checked_model(self.dynamics, *given, type(self).__name__, default)

    def init(self, *, key: PRNGKey | None = None) -> PyTree:
        del key
        return Belief(self.mean, self.covariance)

    def update(self, t: RealScalar, y: Observation, state: PyTree):
        return self._corrected(state, *self._innovation(t, y, state))

    def predict(self, t: RealScalar, u: Control, state: PyTree):
        # A filter needs only the marginal distribution of the next state. The smoother
        # also needs the joint distribution with this state.
        joint = self._prediction(t, u, state)
        return _like(Belief(joint.mean, joint.covariance), state)

    def log_likelihood(self, t: RealScalar, y: Observation, belief: Belief) -> Scalar:
        """The log-density of an observation, given the belief before it.

        Its sum over a record is the log-likelihood of the model.

        **Arguments:**

        - `t`: time of the observation, a scalar.
        - `y`: the observation, shape `(p,)`.
        - `belief`: the belief of the state at `t` before the update with `y`.

        **Returns:** a scalar; NaN if the covariance of the observation is not definite.
        """
        return self._log_density(belief, *self._innovation(t, y, belief))

    def _innovation(self, t, y, belief):
        """The moments of the observation, and the innovation of `y`."""
        if y.shape != self.V.shape[:1]:
            raise wrong_observation(self, self.V.shape[0], y)
        joint = self._observation(t, belief)
        if self.observation_difference is None:
            return joint, y - joint.mean
        return joint, self.observation_difference(y, joint.mean)

    def _corrected(self, belief, joint, innovation):
        # For normal x and z, the mean moves by G (z - E[z]), and the covariance becomes
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
        # r' S^-1 r = |L^-1 r|^2 and log det S = 2 sum log L_ii both follow from L. The
        # triangular solve has the condition of L; the inverse of S would square it.
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
        """One step of the backward pass: the smoothed belief, from the smoothed belief
        `after` of the next state."""
        joint = self._prediction(t, u, belief)
        # This is G_k = P_k A' Sigma_{k+1}^-1.
        G = joint.gain()
        # The difference of the dynamics takes angles the shorter way.
        shift = self.dynamics.difference(after.mean, joint.mean)
        # P + G (P_after - Sigma) G' as a sum of two semidefinite terms. Rounding in the
        # difference of the textbook could make it indefinite.
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
    """`W`, `V`, and the mean and covariance of the first state, checked and in one
    precision.

    If `mean` is `None`, it is `default` or zero; if `covariance` is `None`, it is the
    identity.
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
    """Raise unless `dynamics` is dynamics whose `difference` has the state's size."""
    check_instance(dynamics, AbstractDynamics, "dynamics", where)
    n = dynamics.state_size
    x = jnp.zeros(n)
    shape = eqx.filter_eval_shape(dynamics.difference, x, x).shape
    if shape != (n,):
        raise ValueError(
            f"{where}: dynamics.difference must return a vector of shape {(n,)}, like "
            f"the state, got shape {shape}."
        )


def _like(after: Belief, before: Belief) -> Belief:
    """`after` in the types of `before`, because a loop must keep the types."""
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
