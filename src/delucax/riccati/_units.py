"""Units of the states in which a Riccati equation is solved."""

import jax.lax as lax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..math._size import power_of_two


_SWEEPS = 20
_APART = 2.0**4
"""Units that are no further apart are left as they are."""


def units(
    A: Float[Array, "n n"],
    B: Float[Array, "n m"],
    Q: Float[Array, "n n"],
    E: Float[Array, "n n"] | None,
) -> Float[Array, " n"]:
    """Powers of two, by which the states are multiplied.

    In them, the size of what moves a state (its rows of A, E and B) is that of what the
    state moves (its columns of A and E, its weight): a state in unfit units is lost in
    the rounding of the others. States that nothing moves, or that move nothing, keep
    their units.

    Source: Parlett and Reinsch, 1969 (balancing); Benner, 2001 (of a Riccati equation).
    """
    n, dtype = A.shape[0], A.dtype
    inside = jnp.abs(A) if E is None else jnp.abs(A) + jnp.abs(E)
    inside = inside.at[jnp.arange(n), jnp.arange(n)].set(0)
    force, weight = jnp.max(jnp.abs(B), axis=1), jnp.sqrt(jnp.abs(jnp.diagonal(Q)))
    lowest = jnp.finfo(dtype).minexp

    def logarithm(M):
        return jnp.where(M > 0, jnp.log2(M), lowest)

    def largest(M, axis):
        return jnp.max(M, axis=axis)

    inside, force, weight = (logarithm(M) for M in (inside, force, weight))

    def sweep(_, d):
        moved = inside + d[:, None] - d
        most = jnp.max(moved)
        forced, weighed = force + d, weight - d
        in_rows = jnp.maximum(largest(moved, 1) - most, forced - jnp.max(forced))
        in_columns = jnp.maximum(largest(moved, 0) - most, weighed - jnp.max(weighed))
        change = (in_columns - in_rows) / 2
        return d + jnp.where(jnp.abs(change) < -lowest / 4, change, 0)

    d = lax.fori_loop(0, _SWEEPS, sweep, jnp.zeros(n, dtype))
    d -= jnp.mean(d)
    apart = jnp.max(d) - jnp.min(d) > jnp.log2(_APART)
    return lax.stop_gradient(power_of_two(jnp.exp2(jnp.where(apart, d, 0))))


def in_units(d: Float[Array, " n"], A, B, Q, R, S, E) -> tuple:
    """The data of the equation in states that are `d` times those of these."""
    up, across = d[:, None], d[:, None] / d
    E = None if E is None else E * across
    return A * across, B * up, Q / (up * up.T), R, S / up, E
