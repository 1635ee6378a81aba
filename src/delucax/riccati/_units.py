"""Units of the states in which a Riccati equation is solved."""

import jax.lax as lax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..math._linear_solve import solve
from ..math._size import one_if_zero, power_of_two
from ._arguments import RiccatiData


_SWEEPS = 100
_APART = 4
"""Units that are no more powers of two apart are left as they are."""


def units(data: RiccatiData) -> Float[Array, "2 n"]:
    """Powers of two, by which the states and the rows of A, B and E are multiplied.

    In them a row of the Hamiltonian matrix is as large as its column: what moves a
    state, other states and controls, is as large as what the state moves, other states
    and costs. A state in a unit that does not fit is lost in the rounding of the
    others. States that nothing moves, or that move nothing, keep their units. The rows
    of an E that is given are then as large as each other.

    Source: Parlett and Reinsch, 1969 (balancing); Benner, 2001 (of a Hamiltonian).
    """
    A, B, Q, R, _, E = lax.stop_gradient(data)
    n, dtype = A.shape[0], A.dtype
    lowest = jnp.finfo(dtype).minexp
    plain_A, plain_B = (A, B) if E is None else (solve(E, A), solve(E, B))

    def logarithm(M):
        exponent = jnp.log2(M)
        return jnp.where(jnp.isfinite(exponent), exponent, lowest)

    effort = jnp.sqrt(_diagonal_sizes(R))
    force = jnp.max(jnp.abs(plain_B) / one_if_zero(effort), axis=1)
    weight = logarithm(jnp.sqrt(_diagonal_sizes(Q)))
    other = ~jnp.eye(n, dtype=bool)
    inside, force = logarithm(jnp.abs(plain_A) * other), logarithm(force)

    def more(carry):
        k, change, _ = carry
        return (k < _SWEEPS) & (jnp.max(jnp.abs(change)) > 1 / 4)

    def sweep(carry):
        k, _, d = carry
        moved = inside + d[:, None] - d
        forced, weighed = force + d, weight - d
        # The size of the cost is free: that at which both have the same weight.
        rows = jnp.maximum(jnp.max(moved, axis=1), forced + jnp.max(weighed))
        columns = jnp.maximum(jnp.max(moved, axis=0), weighed + jnp.max(forced))
        # Half of the step that each state would take alone.
        change = (columns - rows) / 4
        change = jnp.where(jnp.abs(change) < -lowest / 8, change, 0)
        return k + 1, change, d + change

    start = jnp.zeros(n, dtype)
    *_, d = lax.while_loop(more, sweep, (0, start + 1, start))
    d -= jnp.mean(d)
    f = d
    if E is not None:
        f = -jnp.max(logarithm(jnp.abs(E)) - d, axis=1)
    both = jnp.stack([d, f])
    apart = jnp.any(jnp.max(both, axis=1) - jnp.min(both, axis=1) > _APART)
    both = jnp.where(apart, both, 0)
    return power_of_two(jnp.exp2(both))


def _diagonal_sizes(M):
    # `jnp.diagonal` gathers, which is slower to compile.
    return jnp.max(jnp.where(jnp.eye(len(M), dtype=bool), jnp.abs(M), 0), axis=1)


def in_units(by: Float[Array, "2 n"], data: RiccatiData) -> RiccatiData:
    """The data of the equation with states and rows that are `by` times these."""
    A, B, Q, R, S, E = data
    state, row = (unit[:, None] for unit in by)
    across = row / by[0]
    E = None if E is None else E * across
    Q = Q / (state * by[0])
    return RiccatiData(A * across, B * row, Q, R, S / state, E)
