"""A task whose vector field is a network, drawn at random or fitted."""

from typing import Any

import diffrax
import jax.numpy as jnp

from .._check import check_range
from .._typing import PRNGKey
from ..costs import Quadratic
from ..dynamics import Discretized
from ..systems import AbstractSystem, NeuralSystem
from ._environment import Environment, UniformState
from ._registry import finish


def neural(
    system: AbstractSystem | None = None,
    *,
    key: PRNGKey | None = None,
    states: int = 2,
    controls: int = 1,
    width: int = 32,
    depth: int = 2,
    dt: Any = 0.05,
    horizon: int = 100,
    max_control: Any = 1.0,
    solver: diffrax.AbstractSolver | None = None,
    substeps: int = 1,
    **environment: Any,
) -> Environment:
    """Bring the state of a learned vector field to the origin.

    Starts with each state uniform in +-1. Cost `|x|^2 + 0.1 |u|^2` a step. Never
    terminates.

    **Arguments:**

    - `system`: a [`delucax.systems.NeuralSystem`][], such as one that was fitted to
        data, or any other system. One with random weights by default.
    - `key`: a random key, for random weights.
    - `states`, `controls`, `width`, `depth`: of a random
        [`delucax.systems.NeuralSystem`][], 2, 1, 32 and 2 by default.
    - `max_control`: of each control, to either side; 1 by default.
    - `dt`: the control interval, 0.05 by default.
    - `horizon`: steps an episode, 100 by default.
    - `solver`: a Diffrax solver, [`delucax.dynamics.RK4`][] by default.
    - `substeps`: solver steps an interval, 1 by default.
    - `**environment`: other arguments of [`delucax.Environment`][], such as
        `disturbance`.

    **Returns:** an [`delucax.Environment`][].

    **Raises:** `ValueError` on illegal numbers, without a system and a key, or with
        both.

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
        assert key is not None
        system = NeuralSystem(states, controls, width, depth, key=key)
    dynamics = Discretized(system, dt, solver, substeps)
    n, m = dynamics.state_size, dynamics.control_size
    arguments: dict[str, Any] = dict(
        dynamics=dynamics,
        cost=Quadratic(jnp.ones(n), 0.1 * jnp.ones(m)),
        initial_state=UniformState(-jnp.ones(n), jnp.ones(n)),
        control_bounds=(-max_control, max_control),
        horizon=horizon,
    )
    return finish(neural, arguments, environment)
