"""The first states of simulations along records: guessed, simulated, estimated."""

from typing import Any

import equinox as eqx
import jax
import jax.lax as lax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..._check import check_finite
from ..._module import as_float_array
from ...dynamics import AbstractDynamics
from .._trainable import Assembly
from ._latent import LatentDynamics
from ._multiple_shooting import Solution, solve
from ._record import Record
from ._sampled import Sampling
from ._windows import begins_of, Windows


# Iterations to estimate a state. A start that needs more is far from the solution.
_MAX_STEPS = 30


def guessed_starts(
    dynamics: AbstractDynamics, x0: Any, groups: list[Record], where: str
) -> list[Float[Array, "_ n"]]:
    """A guess of the first state of each record: `x0`, or the first measurement."""
    n, sizes = dynamics.state_size, [len(group.outputs) for group in groups]
    if x0 is None:
        if groups[0].outputs.shape[2] == n:
            return [group.outputs[:, 0] for group in groups]
        if isinstance(dynamics, LatentDynamics):
            # Its states are of size one, about zero.
            return [jnp.zeros((size, n), groups[0].outputs.dtype) for size in sizes]
        raise ValueError(
            f"{where}: x0 must be given, because the state (of size {n}) is not "
            f"measured: the record has {groups[0].outputs.shape[2]} outputs."
        )
    x0, count = as_float_array(x0), sum(sizes)
    if x0.shape not in ((n,), (count, n)):
        raise ValueError(
            f"{where}: x0 must have shape ({n},), or ({count}, {n}) with a row for "
            f"each record, got {x0.shape}."
        )
    check_finite(x0, "x0", where)
    x0 = jnp.broadcast_to(x0, (count, n)).astype(groups[0].outputs.dtype)
    return jnp.split(x0, np.cumsum(sizes)[:-1])


def simulated(
    dynamics: AbstractDynamics, sampling: Sampling, x0: Array, times: Array, rows: Array
) -> Float[Array, "samples n"]:
    """The states of a simulation driven by the rows. If the next state is not finite,
    the state is held."""
    advance = sampling(dynamics)

    def step(x, inputs):
        x_next = advance(inputs[0], x, inputs[1]).astype(x.dtype)
        x_next = jnp.where(jnp.all(jnp.isfinite(x_next)), x_next, x)
        return x_next, x_next

    _, states = lax.scan(step, x0, (times[:-1], rows))
    return jnp.concatenate([x0[None], states])


@eqx.filter_jit
def simulated_records(
    dynamics: AbstractDynamics,
    sampling: Sampling,
    firsts: list[Float[Array, "_ n"]],
    groups: list[Record],
    rows: list[Float[Array, "_ _ row"]],
) -> list[Float[Array, "_ _ n"]]:
    """The states of a simulation along each record, from its first state."""
    run = lambda x0, times, rows: simulated(dynamics, sampling, x0, times, rows)
    times = [group.times for group in groups]
    return [jax.vmap(run)(*one) for one in zip(firsts, times, rows, strict=True)]


@eqx.filter_jit
def stitched(
    dynamics: AbstractDynamics,
    sampling: Sampling,
    starts: Float[Array, "windows n"],
    groups: list[Record],
    rows: list[Float[Array, "_ _ row"]],
    window: int,
) -> list[Float[Array, "_ _ n"]]:
    """The states along each record, simulated from the first state of each window."""
    run = lambda x0, times, rows: simulated(dynamics, sampling, x0, times, rows)
    parts, count = [], 0
    for group, own in zip(groups, rows, strict=True):
        begins, steps = begins_of(group, window), group.times.shape[1] - 1
        inside = np.minimum(begins[:, None] + np.arange(window + 1), steps)
        of_step = np.minimum(inside[:, :-1], steps - 1)
        runs = len(group.outputs)
        firsts = starts[count : count + runs * len(begins)]
        count += len(firsts)
        flat = lambda array: array.reshape(-1, *array.shape[2:])
        states = jax.vmap(run)(
            firsts, flat(group.times[:, inside]), flat(own[:, of_step])
        )
        states = states.reshape(runs, len(begins), window + 1, -1)
        at = np.minimum(np.arange(steps + 1) // window, len(begins) - 1)
        parts.append(states[:, at, np.arange(steps + 1) - window * at])
    return parts


def estimated_starts(
    dynamics: AbstractDynamics,
    sampling: Sampling,
    guesses: Float[Array, "windows n"],
    data: Windows,
) -> Solution:
    """The first states of windows, by least squares on the outputs in each window."""
    nothing = {"": jnp.zeros(1, data.observations.dtype)}
    most: Any = np.asarray(_MAX_STEPS)
    leaves, structure = jax.tree.flatten(dynamics)
    known = Assembly(leaves, structure, holes=(), constraints={})
    return solve(known, nothing, guesses, data, sampling, most)


def whole_windows(times: Array, rows: Array, outputs: Array) -> Windows:
    """Windows whose points all count. Each output is weighed by its spread, so that
    none outweighs the others."""
    spread = jnp.std(outputs, axis=(0, 1))
    spread = jnp.where(spread > 0, spread, 1).astype(outputs.dtype)
    counts = jnp.ones(times.shape, bool)
    return Windows(times, rows, outputs, counts, spread, 0 * spread)
