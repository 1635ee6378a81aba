"""An environment as compiled functions of one packed array.

A call of a compiled function costs a few microseconds for each array that goes in or
comes out, which is more than the arithmetic. So all that a step returns is one array,
`[state, observation, reward, terminated, truncated, failed, step]`, which goes back in
with the action at its end; and the numbers of the environment are compiled in.
"""

import functools
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np

from ..._results import RESULTS
from ...disturbances import Zero
from ...environments import Environment


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


class Signals(NamedTuple):
    """What is drawn for a whole episode."""

    disturbance: Any  # (horizon, w), or none
    noise: Any  # (horizon + 1, y), or none


class Program(NamedTuple):
    """The compiled functions."""

    start: Any  # (key, state or None) -> packed, signals
    step: Any  # (packed and action, signals) -> packed
    start_batch: Any
    step_batch: Any
    layout: Layout


def program(env: Environment, discrete: bool) -> Program:
    """The program of an environment; one that is the same compiles no more."""
    return _compiled(_ByValue(env), discrete)


class _ByValue:
    """An environment that equals another if all of their numbers do."""

    def __init__(self, env: Environment):
        self.env = env
        arrays, static = eqx.partition(env, eqx.is_array)
        leaves, treedef = jax.tree.flatten(arrays)
        values = [(a.shape, str(a.dtype), _bytes(a)) for a in leaves]
        self.value = (*values, treedef, static)

    def __hash__(self):
        return hash(self.value)

    def __eq__(self, other):
        return isinstance(other, _ByValue) and self.value == other.value


def _bytes(array):
    if jnp.issubdtype(array.dtype, jax.dtypes.prng_key):
        array = jr.key_data(array)
    return np.asarray(array).tobytes()


@functools.lru_cache(maxsize=64)
def _compiled(same: _ByValue, discrete: bool) -> Program:
    env = same.env
    layout = Layout(env.state_size, env.feature_size)

    def move(packed, action, signals):
        action = action[0].astype(int) if discrete else action
        return _step(env, packed, action, signals)

    def step(given, signals):
        return move(given[: layout.size], given[layout.size :], signals)

    start = functools.partial(_start, env)
    start_batch = jax.vmap(start, in_axes=(0, None))
    step_batch = functools.partial(_step_batch, move, start_batch)
    return Program(
        jax.jit(start),
        jax.jit(step),
        jax.jit(start_batch),
        jax.jit(step_batch, static_argnums=0),
        layout,
    )


def _packed(env, t, k, x, noise, reward, terminated, truncated, failed):
    y = env.dynamics.observe(t, x)
    y = y if noise is None else y + noise
    observation = env.encode(y)
    failed = failed | ~jnp.all(jnp.isfinite(x)) | ~jnp.isfinite(reward)
    rest = (reward, terminated, truncated, failed, k)
    rest = jnp.stack([jnp.asarray(part, x.dtype) for part in rest])
    return jnp.concatenate([x, observation.astype(x.dtype), rest])


def _start(env, key, state):
    start_key, w_key, noise_key = jr.split(key, 3)
    x = env.reset(start_key) if state is None else state
    times = (jnp.arange(max(env.horizon, 2) + 1) * env.dt).astype(x.dtype)
    w = noise = None
    if not isinstance(env.disturbance, Zero):
        w = env.disturbance.sequence(w_key, times[:-1]).astype(x.dtype)
    if env.sensor_noise is not None:
        noise = env.sensor_noise.sequence(noise_key, times).astype(x.dtype)
    first = None if noise is None else noise[0]
    nothing = 0, False, False, False
    return _packed(env, 0.0, 0, x, first, *nothing), Signals(w, noise)


def _step(env, packed, action, signals):
    n, dtype = env.state_size, packed.dtype
    x, k = packed[:n], packed[STEP].astype(int)
    w = None if signals.disturbance is None else signals.disturbance[k]
    t, after = (k * env.dt).astype(dtype), k + 1
    t_after = (after * env.dt).astype(dtype)
    step = env.step(t, x, action, w)
    x_next = step.state.astype(dtype)
    truncated = after >= env.horizon
    ended = step.terminated | truncated
    final = jnp.where(ended, env.cost.final(t_after, x_next), 0)
    failed = (step.result != RESULTS.successful) | ~jnp.all(jnp.isfinite(action))
    noise = None if signals.noise is None else signals.noise[after]
    reward = -(step.cost + final)
    flags = step.terminated, truncated, failed
    return _packed(env, t_after, after, x_next, noise, reward, *flags)


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

    def anew(_):
        use, left = jr.split(key)
        fresh, drawn = start_batch(jr.split(use, len(packed)), None)
        pick = lambda new, old: jnp.where(  # noqa: E731
            ended.reshape(-1, *[1] * (old.ndim - 1)), new, old
        )
        if mode == "SameStep":  # the reward and the end are those of the old episode
            told = slice(REWARD, STEP)
            fresh = fresh.at[:, told].set(moved[:, told])
        return pick(fresh, moved), jax.tree.map(pick, drawn, signals), left

    seen, signals, key = jax.lax.cond(
        jnp.any(ended), anew, lambda _: (moved, signals, key), None
    )
    return seen, moved, signals, key
