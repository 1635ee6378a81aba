"""An environment for Gymnasium: its spaces, and compiled functions of one array.

A call of a compiled function costs a few microseconds for each input and output, which
is more than the arithmetic. So a step returns a single array,
`[state, observation, reward, terminated, truncated, failed, step]`. The next step takes
this array with the action at its end, in memory that NumPy and JAX share. The numbers
of the environment are constants of the compiled functions.
"""

import functools
from collections.abc import Mapping
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
from gymnasium.spaces import Box, Discrete
from jaxtyping import Array

from ..._check import check_finite, check_real
from ..._message import shortened
from ..._module import as_float_array
from ..._typing import PRNGKey, State
from ...environments import Environment
from .. import _episode as episodes
from .._episode import EpisodeState, HashableEnvironment, NO_SIGNALS, StepOutcome
from .._spaces import action_ends, observation_ends


def read_options(
    options: Any, env: Environment, where: str, count: int | None = None
) -> tuple[jax.Array | None, Any]:
    """The options of a reset: the first state and the mask of the environments to
    reset, each `None` if it is left out. There are `count` environments, or one."""
    names = ("state",) if count is None else ("state", "reset_mask")
    if options is not None and not isinstance(options, Mapping):
        raise ValueError(f"{where}: options must be a dictionary, got {options!r}.")
    options = dict(options or {})
    if unknown := [repr(name) for name in options if name not in names]:
        raise ValueError(
            f"{where}: options takes only {' and '.join(map(repr, names))}, got "
            f"{', '.join(unknown)}."
        )
    state, mask = options.get("state"), options.get("reset_mask")
    if state is None:
        return None, mask
    shape = (env.state_size,)
    each = shape if count is None else (count, *shape)
    state = as_float_array(state)
    if not eqx.is_inexact_array(state) or state.shape not in (shape, each):
        shapes = shape if count is None else f"{shape}, or {each} for one each"
        got = f"shape {state.shape}" if eqx.is_array(state) else shortened(state)
        raise ValueError(f"{where}: state must have shape {shapes}, got {got}.")
    check_real(state, "state", where)
    check_finite(state, "state", where)
    return jnp.broadcast_to(state.astype(float), each), mask


def spaces(env: Environment, discrete: bool) -> tuple[Box | Discrete, Box]:
    """The spaces of the actions (indices or controls) and of the observations."""
    box = lambda ends: Box(ends[0].astype(np.float32), ends[1].astype(np.float32))
    actions: Any = env.actions
    # As in Gymnasium, the bounds of observations may be infinite.
    observations = box(observation_ends(env, np.inf))
    return Discrete(len(actions)) if discrete else box(action_ends(env)), observations


BACKENDS = ("jax", "c")
REWARD, TERMINATED, TRUNCATED, FAILED, STEP = range(-5, 0)
# JAX shares memory with NumPy only if its address is a multiple of this.
_ALIGNMENT = 64


class Program(NamedTuple):
    """The compiled functions of an environment."""

    start: Any  # (key, state or None) -> packed, signals
    step: Any  # (packed and action, signals if there are any) -> packed
    start_batch: Any
    step_batch: Any
    states: slice  # the place of the state in the packed array
    observation: slice
    size: int


def program(env: Environment, discrete: bool, truncate: bool = True) -> Program:
    """The program of an environment. Equal environments share one."""
    return _compiled(HashableEnvironment(env), discrete, truncate)


def shared(size: int, dtype: Any) -> tuple[np.ndarray, jax.Array]:
    """A NumPy array, and a JAX array in the same memory.

    What you write to the NumPy array is in the JAX array too, so a call of a compiled
    function transfers nothing. Use the JAX array only for such calls, and write only
    when the call has returned, because JAX takes its arrays to be constant.
    """
    itemsize = np.dtype(dtype).itemsize
    memory = np.zeros(size * itemsize + _ALIGNMENT, np.uint8)
    start = -memory.ctypes.data % _ALIGNMENT
    written = memory[start : start + size * itemsize].view(dtype)
    return written, jax.dlpack.from_dlpack(written, copy=False)


def stepper(program: Program) -> Any:
    """A function that allocates the memory of steps.

    It takes a size and a dtype. It returns `begin`, the array of the packed array and
    the action, and the packed array after a step. `begin` makes the step of an episode
    from its signals.
    """

    def allocate(size, dtype):
        given, in_jax = shared(size, dtype)
        after = np.zeros(program.size, dtype)

        def begin(signals):
            signals = jax.device_put(signals, in_jax.device)
            drawn = (signals,) if jax.tree.leaves(signals) else ()

            def advance():
                after[...] = program.step(in_jax, *drawn)

            return advance

        return begin, given, after

    return allocate


def draw_key(generator: np.random.Generator) -> PRNGKey:
    """A random key from the NumPy generator that Gymnasium seeds."""
    return jr.key(int(generator.integers(2**32)))


@functools.lru_cache(maxsize=64)
def _compiled(same: HashableEnvironment, discrete: bool, truncate: bool) -> Program:
    env, n = same.env, same.env.state_size
    end = n + env.feature_size
    size = end - REWARD

    def start(key: PRNGKey, state: State | None) -> tuple[Array, episodes.Signals]:
        if episodes.has_signals(env):
            episode = episodes.begin(env, key, state)
        else:
            # Without splitting the key, a batched reset takes a third less time.
            x = env.reset(key) if state is None else state
            episode = EpisodeState(x, jnp.zeros((), int))
        no = jnp.zeros((), bool)
        outcome = StepOutcome(jnp.zeros((), episode.state.dtype), no, no, no)
        return _packed(env, episode, outcome), episode.signals

    step = functools.partial(step_packed, env, discrete, truncate)

    def step_in_place(given, signals=NO_SIGNALS):
        return step(given[:size], given[size:], signals)

    start_batch = jax.vmap(start)
    step_batch = functools.partial(_step_batch, step, start_batch)
    compiled = jax.jit(start), jax.jit(step_in_place), jax.jit(start_batch)
    step_batch = jax.jit(step_batch, static_argnums=0)
    return Program(*compiled, step_batch, slice(n), slice(n, end), size)


def step_packed(
    env: Environment, discrete: bool, truncate: bool, packed, action, signals
) -> Array:
    """The packed array after a step."""
    action = action[0].astype(int) if discrete else action
    x, time = packed[: env.state_size], packed[STEP].astype(int)
    now = EpisodeState(x, time, signals)
    return _packed(env, *episodes.step(env, now, action, truncate))


def _packed(env: Environment, episode: EpisodeState, outcome: StepOutcome) -> Array:
    x, (reward, *ends, failed) = episode.state, outcome
    failed = failed | ~jnp.all(jnp.isfinite(x)) | ~jnp.isfinite(reward)
    parts = reward, *ends, failed, episode.time
    rest = jnp.stack([jnp.asarray(part, x.dtype) for part in parts])
    return jnp.concatenate([x, episodes.observe(env, episode).astype(x.dtype), rest])


def _step_batch(step, start_batch, mode, packed, actions, signals, key):
    """A step of each environment. Episodes that have ended are reset as `mode` says.

    **Returns:** the packed arrays, the packed arrays before the resets, the signals and
    the next key.
    """
    ended = (packed[:, TERMINATED] + packed[:, TRUNCATED]) > 0
    last = jax.vmap(step)(packed, actions.astype(packed.dtype), signals)
    if mode == "Disabled":
        # An episode that has ended does not change until it is reset.
        packed = jnp.where(ended[:, None], packed.at[:, REWARD].set(0), last)
        return packed, packed, signals, key
    if mode == "SameStep":
        ended = (last[:, TERMINATED] + last[:, TRUNCATED]) > 0

    # Reset a few episodes at a time, because most steps end only a few.
    count = len(packed)
    few = min(count, max(16, count // 16))

    def reset_few(carry):
        ended, packed, signals, key = carry
        which = jnp.flatnonzero(ended, size=few, fill_value=count)
        use, key = jr.split(key)
        first, drawn = start_batch(jr.split(use, few), None)
        if mode == "SameStep":  # keep the reward and the flags of the old episode
            outcome = slice(REWARD, STEP)
            first = first.at[:, outcome].set(last[which, outcome])
        put = lambda new, old: old.at[which].set(new, mode="drop")
        after = put(False, ended), put(first, packed), jax.tree.map(put, drawn, signals)
        return *after, key

    carry = ended, last, signals, key
    any_ended = lambda carry: jnp.any(carry[0])
    _, packed, signals, key = jax.lax.while_loop(any_ended, reset_few, carry)
    return packed, last, signals, key
