"""An environment as compiled functions of one packed array.

A call of a compiled function costs a few microseconds for each array that goes in or
comes out, which is more than the arithmetic. So all that a step returns is one array,
`[state, observation, reward, terminated, truncated, failed, step]`, which goes back in
with the action at its end, in memory that NumPy and JAX share; and the numbers of the
environment are compiled in.
"""

import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np

from ...environments import Environment
from .._by_value import ByValue
from .._episode import draw_signals, has_signals, move, NO_SIGNALS, see, split_key


class Layout(NamedTuple):
    """Where things are in the packed array."""

    states: int
    features: int

    @property
    def observation(self) -> slice:
        return slice(self.states, self.states + self.features)

    @property
    def size(self) -> int:
        return self.states + self.features + 5


REWARD, TERMINATED, TRUNCATED, FAILED, STEP = range(-5, 0)
# The memory that JAX shares with NumPy begins at a multiple of it.
_ALIGNMENT = 64


class Program(NamedTuple):
    """The compiled functions."""

    start: Any  # (key, state or None) -> packed, signals
    step: Any  # (packed and action, signals if there are any) -> packed
    start_batch: Any
    step_batch: Any
    layout: Layout


def program(env: Environment, discrete: bool, truncate: bool = True) -> Program:
    """The program of an environment; one that is the same compiles no more."""
    return _compiled(ByValue(env), discrete, truncate)


def shared(size: int, dtype: Any) -> tuple[np.ndarray, jax.Array]:
    """An array of NumPy, and one of JAX in the same memory.

    What is written to the first is in the second, so that nothing is transferred when a
    compiled function is called with it. It is for the function alone: JAX takes it to
    be constant, and nothing may be written before what was called has returned.
    """
    itemsize = np.dtype(dtype).itemsize
    memory = np.zeros(size * itemsize + _ALIGNMENT, np.uint8)
    start = -memory.ctypes.data % _ALIGNMENT
    written = memory[start : start + size * itemsize].view(dtype)
    return written, jax.dlpack.from_dlpack(written, copy=False)


@functools.lru_cache(maxsize=64)
def _compiled(same: ByValue, discrete: bool, truncate: bool) -> Program:
    env = same.env
    layout = Layout(env.state_size, env.feature_size)

    def act(packed, action, signals):
        action = action[0].astype(int) if discrete else action
        return _step(env, packed, action, signals, truncate)

    def step(given, signals=NO_SIGNALS):
        return act(given[: layout.size], given[layout.size :], signals)

    start = functools.partial(_start, env)
    start_batch = jax.vmap(start)
    step_batch = functools.partial(_step_batch, act, start_batch)
    return Program(
        jax.jit(start),
        jax.jit(step),
        jax.jit(start_batch),
        jax.jit(step_batch, static_argnums=0),
        layout,
    )


def _packed(env, k, x, signals, reward, terminated, truncated, failed):
    observation = see(env, k, x, signals)
    failed = failed | ~jnp.all(jnp.isfinite(x)) | ~jnp.isfinite(reward)
    rest = (reward, terminated, truncated, failed, k)
    rest = jnp.stack([jnp.asarray(part, x.dtype) for part in rest])
    return jnp.concatenate([x, observation.astype(x.dtype), rest])


def _start(env, key, state):
    # A key that is not split saves a batch a third of the time of a reset.
    key, keys = split_key(key) if has_signals(env) else (key, None)
    x = env.reset(key) if state is None else state
    signals = draw_signals(env, keys, x.dtype)
    return _packed(env, jnp.asarray(0), x, signals, 0, False, False, False), signals


def _step(env, packed, action, signals, truncate):
    x, k = packed[: env.state_size], packed[STEP].astype(int)
    x_next, *told = move(env, k, x, action, signals, truncate)
    return _packed(env, k + 1, x_next, signals, *told)


def _step_batch(move, start_batch, mode, packed, actions, signals, key):
    """A step of each; those that have ended begin anew as `mode` says.

    **Returns:** what is seen, the last of what has ended, the signals and a key.
    """
    ended = (packed[:, TERMINATED] + packed[:, TRUNCATED]) > 0
    moved = jax.vmap(move)(packed, actions.astype(packed.dtype), signals)
    if mode == "Disabled":
        # What has ended rests until it is reset.
        seen = jnp.where(ended[:, None], packed.at[:, REWARD].set(0), moved)
        return seen, seen, signals, key
    if mode == "SameStep":
        ended = (moved[:, TERMINATED] + moved[:, TRUNCATED]) > 0

    # A few at a time, for most steps end few episodes.
    count = len(packed)
    few = min(count, max(16, count // 16))

    def anew(carry):
        ended, seen, signals, key = carry
        which = jnp.flatnonzero(ended, size=few, fill_value=count)
        use, key = jr.split(key)
        fresh, drawn = start_batch(jr.split(use, few), None)
        if mode == "SameStep":  # the reward and the end are those of the old episode
            told = slice(REWARD, STEP)
            fresh = fresh.at[:, told].set(moved[which, told])
        put = lambda new, old: old.at[which].set(new, mode="drop")
        after = put(False, ended), put(fresh, seen), jax.tree.map(put, drawn, signals)
        return *after, key

    carry = ended, moved, signals, key
    _, seen, signals, key = jax.lax.while_loop(lambda c: jnp.any(c[0]), anew, carry)
    return seen, moved, signals, key
