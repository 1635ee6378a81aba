"""Reset and step of an environment, shared by the adapters to other libraries."""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
from jaxtyping import Array, Float

from .._results import RESULTS
from .._typing import BoolScalar, PRNGKey, Scalar, State
from ..disturbances import Zero
from ..environments import Environment


class HashableEnvironment:
    """A hashable environment, equal to another if all of their numbers are.

    It is the key of a cache of functions that have the numbers as constants.
    """

    def __init__(self, env: Environment):
        self.env = env
        arrays, static = eqx.partition(env, eqx.is_array)
        leaves, treedef = jax.tree.flatten(arrays)
        is_key = lambda a: jnp.issubdtype(a.dtype, jax.dtypes.prng_key)
        raw = lambda a: np.asarray(jr.key_data(a) if is_key(a) else a)
        values = [(a.shape, str(a.dtype), raw(a).tobytes()) for a in leaves]
        self.value = (*values, treedef, static)
        self._hash = hash(self.value)

    def __hash__(self):
        return self._hash

    def __eq__(self, other):
        return isinstance(other, HashableEnvironment) and self.value == other.value


class Signals(NamedTuple):
    """The disturbances and the sensor noise of a whole episode, where there are any."""

    disturbances: Float[Array, "steps disturbances"] | None = None
    noise: Float[Array, "times observations"] | None = None


NO_SIGNALS = Signals()


class EpisodeState(eqx.Module):
    """The state of an episode: of the plant, the step count and the drawn signals.

    **Arguments:**

    - `state`: of the environment, shape `(state_size,)`.
    - `time`: steps since it began.
    - `signals`: the disturbances and the noise of the whole episode, drawn when it
        began; none by default.
    """

    state: Array
    time: Array
    signals: Signals = NO_SIGNALS


class StepOutcome(NamedTuple):
    """The reward and the flags of one step."""

    reward: Scalar
    terminated: BoolScalar
    truncated: BoolScalar
    failed: BoolScalar


def has_signals(env: Environment) -> bool:
    """Whether anything is drawn for an episode."""
    return not isinstance(env.disturbance, Zero) or env.sensor_noise is not None


def begin(env: Environment, key: PRNGKey, state: State | None = None) -> EpisodeState:
    """The start, by default that of the episode of `rollout` with the same key."""
    start_key, w_key, noise_key, _ = env.split_key(key)
    x = env.reset(start_key) if state is None else state
    w = noise = None
    if env.disturbance is not None and not isinstance(env.disturbance, Zero):
        w = env.disturbance.draw(w_key, env.dt, env.horizon, x.dtype)
    if env.sensor_noise is not None:
        # The state after the last step is observed too. Where what is recorded ends
        # there, its last row is the noise of that.
        recorded = env.sensor_noise.recorded_steps
        ends = recorded is not None and recorded <= env.horizon
        steps = env.horizon + (not ends)
        noise = env.sensor_noise.draw(noise_key, env.dt, steps, x.dtype)
        noise = jnp.concatenate([noise, noise[-1:]]) if ends else noise
    return EpisodeState(x, jnp.zeros((), int), Signals(w, noise))


def time_of(env: Environment, episode: EpisodeState) -> Scalar:
    """The time, in the precision of the state."""
    return (episode.time * env.dt).astype(episode.state.dtype)


def observe(env: Environment, episode: EpisodeState) -> Float[Array, " features"]:
    """The encoded observation, with sensor noise."""
    x, noise = episode.state, episode.signals.noise
    y = env.dynamics.observe(time_of(env, episode), x)
    return env.encode(y if noise is None else (y + noise[episode.time]).astype(x.dtype))


def step(
    env: Environment, episode: EpisodeState, action: Array, truncate: bool = True
) -> tuple[EpisodeState, StepOutcome]:
    """One step. The last one, at the horizon if `truncate`, adds the final cost."""
    x, w = episode.state, episode.signals.disturbances
    w = None if w is None else w[episode.time]
    transition = env.step(time_of(env, episode), x, action, w)
    terminated, x_next = transition.terminated, transition.state.astype(x.dtype)
    after = EpisodeState(x_next, episode.time + 1, episode.signals)
    truncated = (after.time >= env.horizon) & truncate
    final = env.cost.final(time_of(env, after), x_next)
    final = jnp.where(terminated | truncated, final, 0)
    finite = jnp.all(jnp.isfinite(action)) & jnp.all(jnp.isfinite(x_next))
    failed = (transition.result != RESULTS.successful) | ~finite
    return after, StepOutcome(-(transition.cost + final), terminated, truncated, failed)


def reads_first_argument(function: Callable[..., Any], *args: Any) -> bool:
    """Whether anything is computed of the first of `args`, an array."""
    jaxpr = jax.make_jaxpr(function)(*args).jaxpr
    return any(jaxpr.invars[0] is v for e in jaxpr.eqns for v in e.invars)
