"""An episode, step by step: what every adapter of an environment does."""

from typing import Any, NamedTuple

import jax.numpy as jnp
import jax.random as jr
from jaxtyping import Array

from .._results import RESULTS
from ..disturbances import Zero
from ..disturbances._base import times_to_draw
from ..environments import Environment


class Signals(NamedTuple):
    """What is drawn for a whole episode."""

    disturbance: Any  # (horizon, w), or none
    noise: Any  # (horizon + 1, y), or none


NO_SIGNALS = Signals(None, None)


class Moved(NamedTuple):
    """What a step makes."""

    state: Array
    reward: Array
    terminated: Array
    truncated: Array
    failed: Array


def has_signals(env: Environment) -> bool:
    """Whether anything is drawn for an episode."""
    return not isinstance(env.disturbance, Zero) or env.sensor_noise is not None


def split_key(key: Any) -> tuple[Any, Any]:
    """A key for the first state and one for the signals, as `rollout` splits them."""
    keys = jr.split(key, 4)
    return keys[0], keys[1:3]


def draw_signals(env: Environment, keys: Any, dtype: Any) -> Signals:
    """What is drawn for a whole episode, with the second of `split_key`."""
    steps = env.horizon
    times = (jnp.arange(steps + 1) * env.dt).astype(dtype)
    w = noise = None
    if not isinstance(env.disturbance, Zero):
        shown = times_to_draw(env.disturbance, times, steps)
        w = env.disturbance.sequence(keys[0], shown).astype(dtype)
    if env.sensor_noise is not None:
        # The state after the last step is observed too. Where what is recorded ends
        # there, its last row is the noise of that.
        recorded = env.sensor_noise.recorded_steps
        ends = recorded is not None and recorded <= steps
        shown = times_to_draw(env.sensor_noise, times, steps + (not ends))
        noise = env.sensor_noise.sequence(keys[1], shown).astype(dtype)
        noise = jnp.concatenate([noise, noise[-1:]]) if ends else noise
    return Signals(w, noise)


def time_of(env: Environment, k: Any, dtype: Any) -> Array:
    """The time of step `k`."""
    return (k * env.dt).astype(dtype)


def see(env: Environment, k: Any, x: Array, signals: Signals) -> Array:
    """What a network is given of the state `x` at step `k`."""
    y = env.dynamics.observe(time_of(env, k, x.dtype), x)
    return env.encode(y if signals.noise is None else y + signals.noise[k])


def move(
    env: Environment,
    k: Any,
    x: Array,
    action: Array,
    signals: Signals,
    truncate: bool = True,
) -> Moved:
    """One step; the final cost is charged with the last, which is at the horizon if
    episodes are to be truncated there."""
    w = None if signals.disturbance is None else signals.disturbance[k]
    step = env.step(time_of(env, k, x.dtype), x, action, w)
    x_next, after = step.state.astype(x.dtype), k + 1
    truncated = (after >= env.horizon) & truncate
    ended = step.terminated | truncated
    final = jnp.where(ended, env.cost.final(time_of(env, after, x.dtype), x_next), 0)
    finite = jnp.all(jnp.isfinite(action)) & jnp.all(jnp.isfinite(x_next))
    failed = (step.result != RESULTS.successful) | ~finite
    return Moved(x_next, -(step.cost + final), step.terminated, truncated, failed)
