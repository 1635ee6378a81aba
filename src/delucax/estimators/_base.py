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
    """A normal distribution of a state, `x ~ N(mean, covariance)`.

    **Arguments:**

    - `mean`: shape `(n,)`; of a record, with a leading time axis.
    - `covariance`: shape `(n, n)`, likewise.

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp

        dlx.estimators.Belief(jnp.zeros(2), jnp.eye(2)).mean
        ```
    """

    mean: Float[Array, "*T n"]
    covariance: Float[Array, "*T n n"]

    @property
    def is_finite(self) -> BoolScalar:
        """Whether no entry is NaN or infinite."""
        return jnp.all(jnp.isfinite(self.mean)) & jnp.all(jnp.isfinite(self.covariance))


class AbstractEstimator(eqx.Module):
    r"""Estimates the state of a plant, recursively, from controls and observations

    `x_{k+1} = F(t_k, x_k, u_k, w_k)`, `y_k = h(t_k, x_k) + v_k`.

    At each step, in this order: `update` takes in the observation `y_k`; `predict`
    moves on over the step from `t_k`, with the control `u_k` that was really applied.
    Whatever the estimator carries from step to step is its state, a pytree of arrays.
    `estimate` computes a belief from it, and `status` the status of the last step.
    [`delucax.controllers.OutputFeedback`][] makes the calls in a closed loop. On a
    record [`delucax.estimators.run_estimator`][] makes them, and of the Kalman filters
    [`delucax.estimators.run_filter`][], which also computes their log-likelihood.

    To write an estimator, subclass this and give `init`, `update` and `predict`. The
    state of a filter is a [`delucax.estimators.Belief`][], and needs no other methods.
    One that carries something else also gives `estimate`: a
    [`delucax.estimators.MHE`][] carries the observations and controls of its window and
    the last solution. One that solves a problem gives `status`.

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
    """

    __repr__ = shown

    def __check_init__(self):
        check_parameters(self)

    @abc.abstractmethod
    def init(self, *, key: PRNGKey | None = None) -> PyTree:
        """The state before the first observation.

        **Arguments:** `key`: a random key, for estimators that draw.

        **Returns:** a pytree of arrays.
        """

    @abc.abstractmethod
    def update(self, t: RealScalar, y: Observation, state: PyTree) -> PyTree:
        """The measurement update, with the observation `y`.

        **Arguments:**

        - `t`: time of the observation, a scalar.
        - `y`: the observation, shape `(p,)`.
        - `state`: the estimator's state; its estimate is of the plant at `t`.

        **Returns:** the new state; its estimate is of the plant at `t`.
        """

    @abc.abstractmethod
    def predict(self, t: RealScalar, u: Control, state: PyTree) -> PyTree:
        """The time update, over one step.

        **Arguments:**

        - `t`: time at the start of the step, a scalar.
        - `u`: the control that was applied over the step, shape `(m,)`.
        - `state`: the estimator's state; its estimate is of the plant at `t`.

        **Returns:** the new state; its estimate is of the plant at the end of the step.
        """

    def estimate(self, state: PyTree) -> Belief:
        """The mean and covariance of a state; by default the state itself, a belief.

        **Arguments:** `state`: the estimator's state.

        **Returns:** a [`delucax.estimators.Belief`][].
        """
        return state

    def status(self, state: PyTree) -> Result:
        """The status of the last `update` or `predict`.

        **Arguments:** `state`: the estimator's state after it.

        **Returns:** one of `delucax.RESULTS`; by default `RESULTS.diverged` if the
        estimate is not finite, and success otherwise.
        """
        finite = self.estimate(state).is_finite
        return choose(finite, RESULTS.successful, RESULTS.diverged)
