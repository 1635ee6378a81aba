"""A task whose vector field is a network, drawn at random or fitted."""

from typing import Any

import jax.numpy as jnp

from .._check import check_range
from .._typing import PRNGKey
from ..costs import Quadratic
from ..systems import AbstractSystem, NeuralSystem
from ._task import task
from ._uniform_state import UniformState


def _drawn(
    *, key: PRNGKey | None = None, states: Any = 2, controls: Any = 1, width: int = 32
) -> dict[str, Any]:
    """The arguments of a network with random weights."""
    if key is None:
        raise ValueError(
            "neural: give a system, or a key to draw the weights of one, such as "
            "key=jax.random.key(0), got neither."
        )
    return dict(key=key, states=states, controls=controls, width=width)


@task(NeuralSystem, dt=0.05, horizon=100, arguments=_drawn, accepts=AbstractSystem)
def neural(system: AbstractSystem, *, max_control: Any = 1.0) -> dict[str, Any]:
    """Bring the state of a learned vector field to the origin.

    Starts with each state uniform in +-1. Cost `|x|^2 + 0.1 |u|^2` a step. Never
    terminates.

    **Arguments:**

    - `system`: a [`delucax.systems.NeuralSystem`][], such as one that was fitted to
        data, or any other system. One with random weights by default.
    - `key`: a random key, for random weights.
    - `states`, `controls`, `width`: of a network with random weights, 2, 1 and 32 by
        default; see [`delucax.systems.NeuralSystem`][].
    - `max_control`: of each control, to either side; 1 by default.
    - `dt`: the control interval, 0.05 by default.
    - `horizon`: steps an episode, 100 by default.
    - `solver`: a Diffrax solver, [`delucax.dynamics.RK4`][] by default.
    - `substeps`: solver steps an interval, 1 by default.
    - `**others`: arguments of [`delucax.Environment`][], such as `disturbance`, or,
        without a `system`, of [`delucax.systems.NeuralSystem`][].

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
    corner = jnp.ones(system.state_size)
    return dict(
        cost=Quadratic(corner, 0.1 * jnp.ones(system.control_size)),
        initial_state=UniformState(-corner, corner),
        control_bounds=(-max_control, max_control),
    )
