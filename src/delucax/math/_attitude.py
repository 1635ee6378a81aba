"""States whose entries 3 to 6 are a quaternion, the attitude of a body."""

from typing import Any

import jax.numpy as jnp

from .._typing import State


def attitude_difference(x: State, x_ref: State) -> State:
    """`x - x_ref` with the quaternion, entries 3 to 6, of the sign closer to that of
    `x_ref`; both turn alike."""
    along = sum(x[i] * x_ref[i] for i in range(3, 7))
    sign = jnp.where(along < 0, -1.0, 1.0).astype(x.dtype)
    q = [sign * x[i] - x_ref[i] for i in range(3, 7)]
    d = x - x_ref
    return jnp.stack([d[0], d[1], d[2], *q, *(d[i] for i in range(7, 13))])


def unit_attitude(x: State) -> State:
    """`x` with the quaternion, entries 3 to 6, of length 1."""
    square = x[3] * x[3] + x[4] * x[4] + x[5] * x[5] + x[6] * x[6]
    # A quaternion of zeros has no direction; it is left, not turned into NaN.
    scale = jnp.where(square > 0, square, 1.0) ** -0.5
    q = [scale * x[i] for i in range(3, 7)]
    return jnp.stack([x[0], x[1], x[2], *q, *(x[i] for i in range(7, 13))])


def rotation_entries(x: Any) -> list[Any]:
    """The rotation matrix from body to world, row by row, of a state that is an array
    of JAX or of NumPy."""
    w, a, b, c = x[3], x[4], x[5], x[6]
    return [
        *(1 - 2 * (b * b + c * c), 2 * (a * b - w * c), 2 * (a * c + w * b)),
        *(2 * (a * b + w * c), 1 - 2 * (a * a + c * c), 2 * (b * c - w * a)),
        *(2 * (a * c - w * b), 2 * (b * c + w * a), 1 - 2 * (a * a + b * b)),
    ]
