"""What the two bicycles' task shares: to follow a straight lane."""

from collections.abc import Sequence
from typing import Any

import jax.numpy as jnp

from .._check import check_number, check_range, LARGEST
from .._typing import State, Vector
from ..costs import Quadratic
from ..math import cos, sin, wrap
from ._uniform_state import UniformState


def bicycle_features(x: State) -> Vector:
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


def lane_keeping(
    where: str,
    spread: Sequence[float],
    speed: Any,
    max_acceleration: Any,
    max_steering: Any,
) -> dict[str, Any]:
    """What the task `where` of a bicycle adds, which starts within `spread` of driving
    along the lane.

    The cost is `y^2 + heading^2 + 0.1 (speed - speed*)^2`, 0.1 times the squares of
    what else moves, and `0.1 acceleration^2 + steering^2`. Of the features the cosine
    and the sine of the heading are bounded.
    """
    check_number(speed, "speed", where)
    check_range(max_acceleration, "max_acceleration", where)
    check_range(max_steering, "max_steering", where)
    states = len(spread)
    target = jnp.zeros(states).at[3].set(speed)
    corner = jnp.array(spread)
    limit = jnp.stack([jnp.asarray(max_acceleration), jnp.asarray(max_steering)])
    feature_bound = jnp.full(states + 1, LARGEST).at[2:4].set(1.0)
    return dict(
        cost=Quadratic(
            [0.0, 1.0, 1.0] + [0.1] * (states - 3),
            [0.1, 1.0],
            state_target=target,
            difference=heading_difference,
        ),
        initial_state=UniformState(target - corner, target + corner),
        control_bounds=(-limit, limit),
        encode=bicycle_features,
        observation_bounds=(-feature_bound, feature_bound),
    )


def heading_difference(x: State, x_ref: State) -> State:
    """`x - x_ref` with the heading wrapped."""
    d = x - x_ref
    rest = [d[i] for i in range(3, x.shape[0])]
    return jnp.stack([d[0], d[1], wrap(d[2]), *rest])
