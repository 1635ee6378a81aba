"""A state feedback that acts on an estimate."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, PyTree

from .._check import check_instance
from .._controller import AbstractController, check_controller
from ..estimators import AbstractEstimator, Belief


class _State(NamedTuple):
    controller: PyTree
    belief: Belief
    time: Array


class OutputFeedback(AbstractController):
    """Any controller of the state, run on an estimate of it.

    At each step the estimator's belief is updated with the observation, the controller
    acts on its mean, and the belief is moved on with the control that was really
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
        belief = self.estimator.init(key=keys[1])
        time = jnp.zeros((), belief.mean.dtype)
        return _State(self.controller.init(key=keys[0]), belief, time)

    def __call__(self, t, y, state):
        belief = self.estimator.update(t, y, state.belief)
        u, memory = self.controller(t, belief.mean.astype(y.dtype), state.controller)
        time = jnp.asarray(t, state.time.dtype)
        return u, _State(memory, belief, time)

    def applied(self, u, cost, state):
        memory = self.controller.applied(u, cost, state.controller)
        belief: Any = self.estimator.predict(state.time, u, state.belief)
        return _State(memory, belief, state.time)
