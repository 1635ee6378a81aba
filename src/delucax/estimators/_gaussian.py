"""The steps that all Kalman filters share."""

import abc
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._check import as_vector, check_finite, is_concrete, symmetric_matrix
from .._controller import wrong_observation
from .._typing import Control, Observation, RealScalar, Scalar
from ..dynamics import AbstractDynamics
from ..math import matvec
from ._base import AbstractEstimator, Belief
from ._moments import AbstractJoint, log_density


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
    if is_concrete(matrix):
        array = np.asarray(matrix)
        eigenvalues = np.linalg.eigvalsh(array)
        slack = 100 * size * np.finfo(array.dtype).eps * np.max(np.abs(eigenvalues))
        if eigenvalues[0] < -slack:
            raise ValueError(
                f"{where}: {name} must be positive semidefinite, got {array}, whose "
                f"least eigenvalue is {eigenvalues[0]:.3g}."
            )
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
