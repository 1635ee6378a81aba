"""A task whose vector field is a network, drawn at random or fitted."""

from typing import Any

import diffrax
import jax.numpy as jnp

from .._check import check_range
from .._typing import PRNGKey
from ..costs import Quadratic
from ..dynamics import Discretized
from ..systems import AbstractSystem, NeuralSystem
from ._environment import Environment
from ._task import system_of, task_environment
from ._uniform_state import UniformState


def neural(
    system: AbstractSystem | None = None,
    *,
    key: PRNGKey | None = None,
    max_control: Any = 1.0,
    dt: Any = 0.05,
    horizon: int = 100,
    solver: diffrax.AbstractSolver | None = None,
    substeps: int = 1,
    **others: Any,
) -> Environment:
    """Bring the state of a learned vector field to the origin.

    Starts with each state uniform in +-1. Cost `|x|^2 + 0.1 |u|^2` a step. Never
    terminates.

    **Arguments:**

    - `system`: a [`delucax.systems.NeuralSystem`][], such as one that was fitted to
        data, or any other system. One with random weights by default.
    - `key`: a random key, for random weights.
    - `max_control`: of each control, to either side; 1 by default.
    - `dt`: the control interval, 0.05 by default.
    - `horizon`: steps an episode, 100 by default.
    - `solver`: a Diffrax solver, [`delucax.dynamics.RK4`][] by default.
    - `substeps`: solver steps an interval, 1 by default.
    - `**others`: arguments of [`delucax.Environment`][], such as `disturbance`, or,
        without a `system`, of [`delucax.systems.NeuralSystem`][]: `states`, `controls`
        and `width` are 2, 1 and 32 by default.

    **Returns:** an [`delucax.Environment`][].

    **Raises:** `ValueError` on illegal numbers, without a system and a key, or with a
        system and arguments of another.

    Source: Chen, Rubanova, Bettencourt and Duvenaud, 2018.

    !!! example

        ```python
        import delucax as dlx
        import jax

        env = dlx.make("neural", key=jax.random.key(0), states=3)
        again = dlx.make("neural", system=env.dynamics.system)
        ```
    """
    check_range(max_control, "max_control", "neural")
    if (system is None) == (key is None):
        got = "neither" if key is None else "both"
        raise ValueError(
            "neural: give a system, or a key to draw the weights of one, such as "
            f"key=jax.random.key(0), got {got}."
        )
    if system is None:
        others = dict(states=2, controls=1, width=32, key=key) | others
    system, others = system_of(
        neural, NeuralSystem, system, others, base=AbstractSystem
    )
    n, m = system.state_size, system.control_size
    return task_environment(
        others,
        dynamics=Discretized(system, dt, solver, substeps),
        cost=Quadratic(jnp.ones(n), 0.1 * jnp.ones(m)),
        initial_state=UniformState(-jnp.ones(n), jnp.ones(n)),
        control_bounds=(-max_control, max_control),
        horizon=horizon,
    )
