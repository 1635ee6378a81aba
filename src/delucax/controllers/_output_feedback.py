"""A state feedback that acts on an estimate."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, PyTree

from .._check import check_instance
from .._controller import AbstractController, check_controller
from ..estimators import AbstractEstimator


class _State(NamedTuple):
    controller: PyTree
    estimator: PyTree
    time: Array


class OutputFeedback(AbstractController):
    """Any controller of the state, run on an estimate of it.

    At each step the estimator takes in the observation, the controller acts on the mean
    of its estimate, and the estimator moves on with the control that was really
    applied, after saturation.

    **Arguments:**

    - `controller`: a controller that reads the state.
    - `estimator`: what estimates it, such as a [`delucax.estimators.KalmanFilter`][].

    **Raises:** `ValueError` if either is of the wrong kind.

    !!! example

        ```python
        import delucax as dlx
        import jax
        import jax.numpy as jnp

        env = dlx.make("pendulum")
        noise = dlx.disturbances.Gaussian(0.1, size=2)
        env = dlx.replace(env, {"sensor_noise": noise})
        regulator = dlx.controllers.LQR(
            dlx.linearize(env.dynamics), jnp.eye(2), jnp.eye(1)
        )
        ekf = dlx.estimators.ExtendedKalmanFilter(
            env.dynamics, 1e-6 * jnp.eye(2), 1e-2 * jnp.eye(2)
        )
        controller = dlx.controllers.OutputFeedback(regulator, ekf)
        dlx.rollout(env, controller, key=jax.random.key(0)).total_cost
        ```
    """

    controller: AbstractController
    estimator: AbstractEstimator

    def __check_init__(self):
        check_controller(self.controller, "controller", "OutputFeedback")
        check_instance(self.estimator, AbstractEstimator, "estimator", "OutputFeedback")

    def init(self, *, key=None):
        keys = (None, None) if key is None else jax.random.split(key)
        state = self.estimator.init(key=keys[1])
        time = jnp.zeros((), self.estimator.estimate(state).mean.dtype)
        return _State(self.controller.init(key=keys[0]), state, time)

    def __call__(self, t, y, state):
        after = self.estimator.update(t, y, state.estimator)
        mean = self.estimator.estimate(after).mean.astype(y.dtype)
        u, memory = self.controller(t, mean, state.controller)
        time = jnp.asarray(t, state.time.dtype)
        return u, _State(memory, after, time)

    def applied(self, u, cost, state):
        memory = self.controller.applied(u, cost, state.controller)
        after = self.estimator.predict(state.time, u, state.estimator)
        return _State(memory, after, state.time)
