"""The steps that all Kalman filters share."""

import abc
from collections.abc import Callable
from typing import Any, ClassVar, TYPE_CHECKING

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from .._check import as_vector, check_finite, is_concrete, symmetric_matrix
from .._controller import wrong_observation
from .._typing import RealScalar
from ..dynamics import AbstractDynamics
from ..math import matvec
from ._base import AbstractEstimator, Belief
from ._moments import AbstractJoint, log_density


class AbstractGaussianFilter(AbstractEstimator):
    """An estimator that takes the state to be normal, with linear updates.

    The filters differ in how they find the moments of what is observed and of the next
    state.
    """

    if TYPE_CHECKING:  # a static checker would ask for abstract fields as arguments
        dynamics: ClassVar[Any]
        W: ClassVar[Any]
        V: ClassVar[Any]
        mean: ClassVar[Any]
        covariance: ClassVar[Any]
        observation_difference: ClassVar[Any]
    else:
        dynamics: eqx.AbstractVar[AbstractDynamics]
        W: eqx.AbstractVar[Array]
        V: eqx.AbstractVar[Array]
        mean: eqx.AbstractVar[Array]
        covariance: eqx.AbstractVar[Array]
        observation_difference: eqx.AbstractVar[Callable | None]

    @abc.abstractmethod
    def _observation(self, t: RealScalar, belief: Belief) -> AbstractJoint:
        """The moments of what will be observed at `t`."""

    @abc.abstractmethod
    def _transition(self, t: RealScalar, u: Array, belief: Belief) -> AbstractJoint:
        """The moments of the next state."""

    def init(self, *, key=None):
        del key
        return Belief(self.mean, self.covariance)

    def update(self, t, y, belief):
        return self._corrected(belief, *self._compared(t, y, belief))

    def predict(self, t, u, belief):
        joint = self._moved(t, u, belief)
        return _like(Belief(joint.mean, joint.covariance), belief)

    def __check_init__(self):
        where, n = type(self).__name__, self.dynamics.state_size
        noise_covariances(self.dynamics, self.W, self.V, where)
        as_vector(self.mean, n, "mean", where)
        covariance_matrix(self.covariance, n, "covariance", "the state", where)

    def log_likelihood(self, t: RealScalar, y: Array, belief: Belief) -> Array:
        """The log-density of an observation, given what is known before it.

        Summed over a record, it is the log-likelihood of the model.

        **Arguments:**

        - `t`: time of the observation, a scalar.
        - `y`: the observation, shape `(p,)`.
        - `belief`: what is known of the state at `t`, without `y`.

        **Returns:** a scalar; NaN if the covariance of the observation is not definite.
        """
        return self._density(belief, *self._compared(t, y, belief))

    def _compared(self, t, y, belief):
        """The moments of what was expected, and by how much `y` differs from it."""
        if y.shape != self.V.shape[:1]:
            raise wrong_observation(self, self.V.shape[0], y)
        joint = self._observation(t, belief)
        if self.observation_difference is None:
            return joint, y - joint.mean
        return joint, self.observation_difference(y, joint.mean)

    def _corrected(self, belief, joint, residual):
        G = joint.gain()
        mean = belief.mean + matvec(G, residual)
        return _like(Belief(mean, joint.remainder(G)), belief)

    def _density(self, belief, joint, residual):
        S = joint.covariance
        return log_density(residual.astype(S.dtype), S).astype(belief.mean.dtype)

    def _moved(self, t, u, belief):
        m = self.dynamics.control_size
        if u.shape != (m,):
            raise ValueError(
                f"{type(self).__name__}: u must have shape {(m,)}, as the controls of "
                f"its dynamics, got {u.shape}."
            )
        return self._transition(t, u.astype(belief.mean.dtype), belief)

    def _smoothed(self, t, u, belief, after):
        """The belief once that of the next state, `after`, is known from all data."""
        joint = self._moved(t, u, belief)
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


def first_belief(
    mean: Any, covariance: Any, default: Array, like: tuple[Array, ...], where: str
) -> tuple[Array, Array]:
    """The mean and covariance to start from, in the precision of all."""
    (n,) = default.shape
    mean = default if mean is None else as_vector(mean, n, "mean", where)
    check_finite(mean, "mean", where)
    if covariance is None:
        covariance = jnp.eye(n, dtype=mean.dtype)
    covariance = covariance_matrix(covariance, n, "covariance", "the state", where)
    dtype = jnp.result_type(mean, covariance, *like)
    return mean.astype(dtype), covariance.astype(dtype)
