"""The linear regulator that `synthesise` starts from."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np

from .._typing import PRNGKey
from ..controllers import local_lqr, local_model, LQG, LQR
from ..environments import Environment
from ._episode_costs import is_hidden


# Draws of the initial state, and steps of the disturbance and of the sensor noise.
_DRAWS = 1000
# What a Kalman filter adds to the covariances of a step and of a reading, relative to
# that of the initial state. Without it a plant without noise has no filter.
_STEP, _READING = 1e-4, 1e-6
# The smallest variance of an initial state, relative to the largest one.
_LEAST = 1e-6


def regulator(environment: Environment, key: PRNGKey) -> LQR | LQG:
    """The LQR of an environment, or the LQG if the state is hidden.

    **Raises:** `ValueError` or `RuntimeError` if there is no such regulator.
    """
    dynamics = environment.dynamics
    if not is_hidden(environment):
        return local_lqr(environment)
    plant, Q, R, S = local_model(environment)
    start, W, V = (np.asarray(e, float) for e in _covariances(environment, key))
    least = _LEAST * max(np.max(np.diag(start)), _LEAST)
    start = start + least * np.eye(len(start))
    E, C, x_ref = plant.E, np.asarray(plant.C, float), plant.x_ref
    driven = np.zeros_like(start) if E is None else np.asarray(E @ W @ E.T, float)
    # Without `E`, the covariance of a step is that of the state itself.
    plant = eqx.tree_at(lambda p: p.E, plant, None, is_leaf=lambda leaf: leaf is None)
    noise = driven + _STEP * start, V + _READING * C @ start @ C.T
    y_ref = dynamics.observe(jnp.zeros(()), x_ref)
    return LQG(plant, Q, R, *noise, S, y_ref=y_ref, difference=dynamics.difference)


@eqx.filter_jit
def _covariances(environment: Environment, key: PRNGKey) -> Any:
    """The covariance of the initial state, and the second moments of the disturbance
    and of the sensor noise."""
    start_key, w_key, noise_key = jr.split(key, 3)
    starts = jax.vmap(environment.reset)(jr.split(start_key, _DRAWS))
    n, p = environment.state_size, environment.observation_size
    start = jnp.cov(starts, rowvar=False).reshape(n, n)

    def moment(noise, key, size):
        if noise is None:
            return jnp.zeros((size, size), start.dtype)
        rows = noise.draw(key, environment.dt, _DRAWS, start.dtype)
        return rows.T @ rows / _DRAWS

    W = moment(environment.disturbance, w_key, environment.disturbance_size)
    return start, W, moment(environment.sensor_noise, noise_key, p)
