"""What a state estimator is; the protocol alone."""

import abc
from typing import NamedTuple

import equinox as eqx
from jaxtyping import Array, Float

from .._module import check_parameters
from .._typing import PRNGKey, RealScalar


class Belief(NamedTuple):
    """What is known of a state: it is taken to be normal, `x ~ N(mean, covariance)`.

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


class AbstractEstimator(eqx.Module):
    """Estimates a state from observations.

    At each step, in this order: `update` takes in the observation at `t`; `predict`
    moves the belief on over the step from `t`, with the control that was really
    applied. [`delucax.controllers.OutputFeedback`][] makes the calls in a closed loop,
    and [`delucax.estimators.run_filter`][] on a record.

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

            def update(self, t, y, belief):
                error = y - self.dynamics.observe(t, belief.mean)
                return belief._replace(mean=belief.mean + self.L @ error)

            def predict(self, t, u, belief):
                return belief._replace(mean=self.dynamics(t, belief.mean, u))

        observer = Luenberger(dlx.make("pendulum").dynamics, 0.5 * jnp.eye(2))
        observer.update(0.0, jnp.array([0.1, 0.0]), observer.init()).mean
        ```
    """

    def __check_init__(self):
        check_parameters(self)

    @abc.abstractmethod
    def init(self, *, key: PRNGKey | None = None) -> Belief:
        """What is known before the first observation.

        **Arguments:** `key`: a random key, for estimators that draw.

        **Returns:** a [`delucax.estimators.Belief`][].
        """

    @abc.abstractmethod
    def update(self, t: RealScalar, y: Array, belief: Belief) -> Belief:
        """The measurement update: what is known once `y` is observed.

        **Arguments:**

        - `t`: time of the observation, a scalar.
        - `y`: the observation, shape `(p,)`.
        - `belief`: what was known of the state at `t`.

        **Returns:** the new belief of the state at `t`.
        """

    @abc.abstractmethod
    def predict(self, t: RealScalar, u: Array, belief: Belief) -> Belief:
        """The time update: what is known of the next state.

        **Arguments:**

        - `t`: time at the start of the step, a scalar.
        - `u`: the control that was applied over the step, shape `(m,)`.
        - `belief`: what is known of the state at `t`.

        **Returns:** the belief of the state at the end of the step.
        """
