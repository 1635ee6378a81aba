"""The LQG regulator of an environment."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np

from .._check import check_key, is_concrete
from .._typing import PRNGKey
from ..environments import Environment
from ._local import _local_model
from ._output_feedback import LQG


# Draws of the initial state, and steps of the disturbance and of the sensor noise.
_DRAWS = 1000
# What the Kalman filter adds to the covariances of a step and of a reading, relative to
# that of the initial state. Without it a plant without noise has no filter.
_STEP, _READING = 1e-4, 1e-6
# The smallest variance of an initial state, relative to the largest one.
_LEAST = 1e-6


def local_lqg(
    environment: Environment, *, key: PRNGKey, regularisation: float = 1e-4
) -> LQG:
    r"""The LQG of an environment, for an observation that need not be the full state.

    [`delucax.controllers.local_model`][] computes the linear-quadratic model. The
    covariances $W$ of a step and $V$ of a reading are estimated from random draws:

    $$W = E\, \mathrm{E}[w w^\top]\, E^\top + 10^{-4}\, \Sigma_0, \qquad
    V = \mathrm{E}[v v^\top] + 10^{-6}\, C\, \Sigma_0\, C^\top$$

    Here $w$ is the disturbance, $v$ is the sensor noise, and $\Sigma_0$ is the
    covariance of the initial state. A millionth of the largest variance of the initial
    state is added to each variance in $\Sigma_0$. The terms with $\Sigma_0$ are needed
    because without them a plant without noise would have no Kalman filter.

    The Kalman filter estimates the state of the plant, and uses its steady-state gain
    from the first step on. The first estimate of the filter is the operating point.
    Differences of states come from `environment.dynamics.difference`, which wraps
    angles.

    **Arguments:**

    - `environment`: the environment.
    - `key`: a random key. With this key, the function draws 1000 initial states, and
        1000 steps of the disturbance and of the sensor noise.
    - `regularisation`: the ratio of the smallest allowed weight of the cost to the
        largest weight, 1e-4 by default.

    **Returns:** a [`delucax.controllers.LQG`][].

    **Raises:** `ValueError` if `key` is traced, or for the same reasons as
    [`delucax.controllers.local_model`][]; an error at run time if there is no
    stabilising gain or the filter has no steady state.

    Source: Åström, 1970.

    !!! example

        ```python
        import delucax as dlx
        import jax


        class AngleOnly(dlx.systems.Pendulum):
            def observe(self, t, x):
                return x[:1]


        noise = dlx.disturbances.Gaussian(0.01, size=1)
        dynamics = dlx.Discretized(AngleOnly(), dt=0.05)
        sensors = dict(encode=lambda y: y, sensor_noise=noise)
        env = dlx.make("pendulum", dynamics=dynamics, **sensors)
        dlx.controllers.local_lqg(env, key=jax.random.key(0)).estimator.L.shape
        ```

        ```text
        (2, 1)
        ```
    """
    where = "local_lqg"
    key = check_key(key, where)
    if not is_concrete(key):
        raise ValueError(f"{where}: key must hold a value, got a traced array.")
    plant, Q, R, S = _local_model(environment, regularisation, where)
    start, W, V = (np.asarray(e, float) for e in _covariances(environment, key))
    least = _LEAST * max(np.max(np.diag(start)), _LEAST)
    start = start + least * np.eye(len(start))
    E, C = (np.asarray(e, float) for e in (plant.E, plant.C))
    noise = E @ W @ E.T + _STEP * start, V + _READING * C @ start @ C.T
    # Without `E`, the covariance of a step is that of the state itself.
    plant = eqx.tree_at(lambda p: p.E, plant, None)
    dynamics = environment.dynamics
    options: Any = dict(difference=dynamics.difference)
    options["y_ref"] = dynamics.observe(jnp.zeros(()), plant.x_ref)
    if dynamics.observes_state:
        options["observation_difference"] = dynamics.difference
    return LQG(plant, Q, R, *noise, S, **options)


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
