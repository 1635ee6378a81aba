"""How far from rest a point is, in units of its equations' terms."""

import jax.numpy as jnp
from jaxtyping import Array


ULPS = 4
"""What rounding leaves, in units of the last place."""


def relative_drift(
    drift: Array, jacobian: Array, x: Array, u: Array, *, is_map: bool
) -> Array:
    """How far from rest a point is: the largest share of `drift` among its terms,

    `|drift_i| / (|drift_i| + sum_j |jacobian_ij| unit_j)`, row by row. Of a map the
    drift is `F(x) - x`, and what the rounding of `x_i` may leave is taken off. Axes in
    front are times, along which a unit is that of the largest value.
    """
    largest = lambda z: jnp.max(jnp.abs(z).reshape(-1, z.shape[-1]), axis=0)
    terms = jnp.abs(jacobian) @ jnp.concatenate(
        [units_of(largest(x)), units_of(largest(u))]
    )
    left = jnp.abs(drift)
    if is_map:
        rounding = ULPS * jnp.finfo(x.dtype).eps * largest(x)
        left = jnp.maximum(left - rounding, 0)
    return jnp.max(jnp.where(left == 0, 0, left / (left + terms)))


def units_of(z: Array) -> Array:
    """The size of each entry, or where it is zero up to rounding 1, or that of the
    largest entry if this is less and not zero."""
    size = jnp.abs(z)
    largest = jnp.max(size, initial=0)
    floor = jnp.where(largest > 0, jnp.minimum(largest, 1), 1)
    return jnp.where(size > 100 * jnp.finfo(z.dtype).eps * floor, size, floor)
