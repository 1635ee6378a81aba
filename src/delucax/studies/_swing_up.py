"""The recipe to swing up Gym's pendulum by differentiating the rollout."""

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Bool

from .._module import replace
from .._typing import PRNGKey
from ..controllers import mlp_policy
from ..environments import Environment, pendulum
from ..math import wrap
from ..simulation import Trajectory
from ..training import expected_cost, fit, Fitted


BATCH = 128
HORIZON = 100
STEPS = 800


def train_swing_up(
    environment: Environment | None = None,
    *,
    key: PRNGKey,
    steps: int = STEPS,
    progress: bool = True,
) -> Fitted:
    """Train an MLP to swing up a pendulum and balance it, by differentiating the ODE.

    The gradient through a long swing explodes at the unstable upright position, so
    plain gradient descent ends with a pendulum that spins. The gradient is therefore
    multiplied by 0.92 at each step back in time. The network has one hidden layer of
    width 32. The optimiser is Adam, with a learning rate that decays from 0.01 along a
    cosine. Each step of Adam uses 128 new initial states and a horizon of 100 steps.

    **Arguments:**

    - `environment`: a pendulum; [`delucax.environments.pendulum`][] by default.
    - `key`: a random key, for the initial weights and the initial states.
    - `steps`: the number of optimiser steps, 800 by default.
    - `progress`: whether to show a progress bar, `True` by default.

    **Returns:** a [`delucax.training.Fitted`][]; its `model` is the controller.

    !!! example

        ```python
        import jax
        from delucax import studies

        fitted = studies.train_swing_up(key=jax.random.key(0), steps=20)
        ```
    """
    environment = pendulum() if environment is None else environment
    init_key, fit_key = jax.random.split(key)
    policy = mlp_policy(environment, width=32, depth=1, key=init_key)
    starts = spread_starts(environment)
    loss = expected_cost(starts, batch=BATCH, horizon=HORIZON, gradient_decay=0.92)
    adam = optax.adam(optax.cosine_decay_schedule(0.01, steps))
    return fit(loss, policy, adam, steps, key=fit_key, progress=progress)


def spread_starts(environment: Environment) -> Environment:
    """The pendulum with starts at all angles and speeds, so that training sees every
    part of the swing."""
    corner = jnp.asarray(np.array([np.pi, 8.0]))
    starts = {"initial_state.low": -corner, "initial_state.high": corner}
    return replace(environment, starts)


def holds_upright(
    trajectory: Trajectory, *, seconds: float = 5.0, tolerance: float = 0.2
) -> Bool[Array, "..."]:
    r"""Whether the pendulum stayed upright to the end.

    A pendulum counts as upright if $|\theta| < \mathrm{tolerance}$ during the last
    `seconds` seconds of the trajectory, where $\theta$ is the angle from upright.

    **Arguments:**

    - `trajectory`: a trajectory of a pendulum, or a batch of them.
    - `seconds`: the length of the final part of the trajectory that is checked [s], 5
        by default.
    - `tolerance`: the largest angle from upright that is allowed [rad], 0.2 by default.

    **Returns:** a boolean for each trajectory.

    **Raises:** `ValueError` if the states were not kept.

    !!! example

        ```python
        import delucax as dlx
        import jax
        from delucax import studies

        env = dlx.make("pendulum")
        zero = dlx.controllers.Zero(1)
        trajectory = dlx.rollout(env, zero, key=jax.random.key(0), x0=[0.1, 0.0])
        studies.holds_upright(trajectory)
        ```
    """
    if trajectory.states is None:
        raise ValueError("holds_upright: trajectory must have its states kept.")
    times = trajectory.times
    late = times > times[..., -1:] - seconds
    upright = jnp.abs(wrap(trajectory.states[..., 0])) < tolerance
    return jnp.all(upright | ~late, axis=-1)
