"""What the two bicycles' task shares: to follow a straight lane."""

from typing import Any

import jax.numpy as jnp
from jaxtyping import Array

from ..costs import Quadratic
from ..math import cos, sin, wrap
from ._environment import LARGEST


def bicycle_features(x: Array) -> Array:
    """The state of a car with the cosine and sine of the heading in its place.

    **Arguments:** `x`: the state of a [`delucax.systems.KinematicBicycle`][] or
        [`delucax.systems.DynamicBicycle`][].

    **Returns:** (x, y, cos(heading), sin(heading), the rest).

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp

        dlx.environments.bicycle_features(jnp.array([0.0, 1.0, 0.1, 10.0]))
        ```
    """
    turned = jnp.stack([x[0], x[1], cos(x[2]), sin(x[2])])
    return jnp.concatenate([turned, x[3:]])


def lane_bounds(states: int) -> tuple[Array, Array]:
    """Between which the features lie: the cosine and the sine have bounds."""
    high = jnp.full(states + 1, LARGEST).at[2:4].set(1.0)
    return -high, high


def lane_cost(speed: Any, states: int) -> Quadratic:
    """`y^2 + heading^2 + 0.1 (speed - speed*)^2`, 0.1 times the squares of what else
    moves, and `0.1 acceleration^2 + steering^2`."""
    weights = jnp.array([0.0, 1.0, 1.0] + [0.1] * (states - 3))
    target = jnp.zeros(states).at[3].set(speed)
    effort = jnp.array([0.1, 1.0])
    return Quadratic(
        weights, effort, state_target=target, difference=heading_difference
    )


def heading_difference(x: Array, x_ref: Array) -> Array:
    """`x - x_ref` with the heading wrapped."""
    d = x - x_ref
    rest = [d[i] for i in range(3, x.shape[0])]
    return jnp.stack([d[0], d[1], wrap(d[2]), *rest])
