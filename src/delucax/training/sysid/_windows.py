"""Records cut into windows of equal length."""

from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from ._record import Record


class Windows(NamedTuple):
    """Recorded data cut into windows, and the noise of each output with its floor."""

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
    """The guesses of the first states, and the windows.

    Without `noise`, each output is weighed by its spread at first, and its noise has a
    floor at the rounding of a whole window. The last window of a record may be shorter;
    it is padded with points that do not count.
    """
    parts = []
    for guess, group, own in zip(guesses, groups, rows, strict=True):
        begins, steps = begins_of(group, window), group.times.shape[1] - 1
        inside = begins[:, None] + np.arange(window + 1)
        # A sample at the end of one window and the start of the next counts once.
        counts = (inside <= steps) & (np.arange(window + 1) >= burn_in)
        counts[:-1, -1] = False
        counts = np.broadcast_to(counts, (len(guess), *counts.shape))
        at, of_step = np.minimum(inside, steps), np.minimum(inside[:, :-1], steps - 1)
        taken = guess[:, begins], group.times[:, at], own[:, of_step]
        taken += group.outputs[:, at], jnp.asarray(counts)
        parts.append([array.reshape(-1, *array.shape[2:]) for array in taken])
    joined = (jnp.concatenate(part) for part in zip(*parts, strict=True))
    starts, times, inputs, observed, counts = joined
    # The spread of a constant output is rounding: then take its size instead.
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
