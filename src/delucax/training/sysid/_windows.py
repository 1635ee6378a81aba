"""Records cut into windows of one length."""

from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from ._record import Record


class Windows(NamedTuple):
    """Recorded data cut into windows, and the scale of each output."""

    times: Float[Array, "windows points"]
    rows: Float[Array, "windows steps row"]
    observations: Float[Array, "windows points y"]
    counts: Bool[Array, "windows points"]
    noise: Float[Array, " y"]
    floor: Float[Array, " y"]


def begins_of(group: Record, window: int) -> np.ndarray:
    """The steps at which the windows of stacked records begin."""
    return np.arange(0, group.times.shape[1] - 1, window)


@eqx.filter_jit
def cut_into_windows(
    guesses: list[Float[Array, "_ _ n"]],
    groups: list[Record],
    rows: list[Float[Array, "_ _ row"]],
    window: int,
    burn_in: int,
    noise: Float[Array, " y"] | None,
) -> tuple[Float[Array, "windows n"], Windows]:
    """`(starts, windows)`, the noise of which is by default the spread of each
    output, and may then be no less than the rounding of a whole window.

    The last window of a record may be shorter; what fills it up does not count.
    """
    parts = []
    for guess, group, own in zip(guesses, groups, rows, strict=True):
        begins, steps = begins_of(group, window), group.times.shape[1] - 1
        inside = begins[:, None] + np.arange(window + 1)
        # The observation where a window ends and the next begins counts once.
        counts = (inside <= steps) & (np.arange(window + 1) >= burn_in)
        counts[:-1, -1] = False
        counts = np.broadcast_to(counts, (len(guess), *counts.shape))
        at, of_step = np.minimum(inside, steps), np.minimum(inside[:, :-1], steps - 1)
        taken = guess[:, begins], group.times[:, at], own[:, of_step]
        taken += group.outputs[:, at], jnp.asarray(counts)
        parts.append([array.reshape(-1, *array.shape[2:]) for array in taken])
    joined = (jnp.concatenate(part) for part in zip(*parts, strict=True))
    starts, times, inputs, observed, counts = joined
    # An output that never moves has a spread of rounding.
    weigh = counts[..., None]
    mean = jnp.mean(observed, axis=(0, 1), where=weigh)
    spread = jnp.sqrt(jnp.mean((observed - mean) ** 2, axis=(0, 1), where=weigh))
    largest = jnp.max(jnp.abs(observed), (0, 1))
    moves = spread > 1e3 * float(jnp.finfo(observed.dtype).eps) * largest
    spread = jnp.where(moves, spread, jnp.where(largest > 0, largest, 1))
    floor = 1e3 * float(jnp.finfo(spread.dtype).eps) * spread
    if noise is not None:
        spread, floor = noise, jnp.zeros_like(noise)
    return starts, Windows(times, inputs, observed, counts, spread, floor)
