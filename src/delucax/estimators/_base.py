"""The protocol of state estimators."""

import abc
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float, PyTree

from .._module import check_parameters, shown
from .._results import choose, Result, RESULTS
from .._typing import BoolScalar, Control, Observation, PRNGKey, RealScalar


class Belief(NamedTuple):
    """A normal distribution of the state, given by its mean and covariance.

    **Arguments:**

    - `mean`: the mean of the state, shape `(n,)`. The beliefs of a whole record have a
        leading time axis.
    - `covariance`: the covariance of the state, shape `(n, n)`, with the same leading
        time axis for a whole record.

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp

        dlx.estimators.Belief(jnp.zeros(2), jnp.eye(2)).mean
        ```

        ```text
        Array([0., 0.], dtype=float32)
        ```
    """

    mean: Float[Array, "*T n"]
    covariance: Float[Array, "*T n n"]

    @property
    def is_finite(self) -> BoolScalar:
        """Whether all entries are finite."""
        return jnp.all(jnp.isfinite(self.mean)) & jnp.all(jnp.isfinite(self.covariance))


class AbstractEstimator(eqx.Module):
    r"""Estimates the state of a plant recursively, from its controls and observations.

    $$x_{k+1} = F(t_k, x_k, u_k, w_k), \qquad y_k = h(t_k, x_k) + v_k$$

    At each step, `update` is called first, with the observation $y_k$. Then `predict`
    is called, with the control $u_k$ that was actually applied over the step from
    $t_k$. The estimator keeps all that it needs of past observations and controls in
    its own state, a pytree of arrays. `estimate` returns the estimated mean and
    covariance of the plant's state. `status` tells whether the last call succeeded.

    In a closed loop, [`delucax.controllers.OutputFeedback`][] calls `update` and
    `predict` for you. For recorded observations and controls,
    [`delucax.estimators.run_estimator`][] does. For Kalman filters,
    [`delucax.estimators.run_filter`][] also computes the log-likelihood of the
    observations.

    To write an estimator, subclass this class and write `init`, `update` and `predict`.
    If the state of the estimator is a [`delucax.estimators.Belief`][], as in a Kalman
    filter, you need no other methods. If the state holds something else, write
    `estimate` too. The state of [`delucax.estimators.MHE`][], for example, holds the
    observations and controls of its window and the last solution. By default `status`
    only reports estimates that are not finite, so override `status` if the estimator
    can also fail in other ways.

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp
        from jaxtyping import Array

        class Luenberger(dlx.estimators.AbstractEstimator):
            dynamics: dlx.AbstractDynamics
            L: Array = dlx.weight()

            def init(self, *, key=None):
                n = self.dynamics.state_size
                return dlx.estimators.Belief(jnp.zeros(n), jnp.eye(n))

            def update(self, t, y, state):
                error = y - self.dynamics.observe(t, state.mean)
                return state._replace(mean=state.mean + self.L @ error)

            def predict(self, t, u, state):
                return state._replace(mean=self.dynamics(t, state.mean, u))

        observer = Luenberger(dlx.make("pendulum").dynamics, 0.5 * jnp.eye(2))
        observer.update(0.0, jnp.array([0.1, 0.0]), observer.init()).mean
        ```

        ```text
        Array([0.05, 0.  ], dtype=float32)
        ```
    """

    __repr__ = shown

    def __check_init__(self):
        check_parameters(self)

    @abc.abstractmethod
    def init(self, *, key: PRNGKey | None = None) -> PyTree:
        """The state of the estimator before the first observation.

        **Arguments:** `key`: a random key, for estimators that use random numbers.

        **Returns:** a pytree of arrays.
        """

    @abc.abstractmethod
    def update(self, t: RealScalar, y: Observation, state: PyTree) -> PyTree:
        """The measurement update, with the observation `y`.

        **Arguments:**

        - `t`: time of the observation, a scalar.
        - `y`: the observation, shape `(p,)`.
        - `state`: the state of the estimator, which describes the plant at `t`.

        **Returns:** the new state, which describes the plant at `t`.
        """

    @abc.abstractmethod
    def predict(self, t: RealScalar, u: Control, state: PyTree) -> PyTree:
        """The time update, over one step.

        **Arguments:**

        - `t`: time at the start of the step, a scalar.
        - `u`: the control that was applied over the step, shape `(m,)`.
        - `state`: the state of the estimator, which describes the plant at `t`.

        **Returns:** the new state, which describes the plant at the end of the step.
        """

    def estimate(self, state: PyTree) -> Belief:
        """The estimated mean and covariance of the plant's state.

        By default the state of the estimator is itself this belief, and the method
        returns it.

        **Arguments:** `state`: the state of the estimator.

        **Returns:** a [`delucax.estimators.Belief`][].
        """
        return state

    def status(self, state: PyTree) -> Result:
        """The status of the last `update` or `predict`.

        **Arguments:** `state`: the state of the estimator after the call.

        **Returns:** one of `delucax.RESULTS`. By default the status is
        `RESULTS.diverged` if the estimate is not finite, and success otherwise.
        """
        finite = self.estimate(state).is_finite
        return choose(finite, RESULTS.successful, RESULTS.diverged)
