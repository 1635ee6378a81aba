"""The reset and the step of an environment, which the adapters share."""

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
    """A hashable environment. Two are equal if all their numbers are equal.

    It is the key in a cache of compiled functions, which hold the numbers as constants.
    """

    def __init__(self, env: Environment):
        self.env = env
        arrays, static = eqx.partition(env, eqx.is_array)
        leaves, treedef = jax.tree.flatten(arrays)
        is_key = lambda a: jnp.issubdtype(a.dtype, jax.dtypes.prng_key)
        raw = lambda a: np.asarray(jr.key_data(a) if is_key(a) else a)
        values = [(a.shape, str(a.dtype), raw(a).tobytes()) for a in leaves]
        # Flattened, because a list or a dictionary has no hash.
        rest, structure = jax.tree.flatten(static)
        self.value = (*values, treedef, tuple(rest), structure)
        self._hash = hash(self.value)

    def __hash__(self):
        return self._hash

    def __eq__(self, other):
        return isinstance(other, HashableEnvironment) and self.value == other.value


class Signals(NamedTuple):
    """The disturbances and the sensor noise of a whole episode; `None` if not drawn."""

    disturbances: Float[Array, "steps disturbances"] | None = None
    noise: Float[Array, "times observations"] | None = None


NO_SIGNALS = Signals()


class EpisodeState(eqx.Module):
    """The state of an episode: the state of the plant, the number of steps, and the
    signals that were drawn.

    **Arguments:**

    - `state`: the state of the environment, shape `(state_size,)`.
    - `time`: the number of steps since the start of the episode.
    - `signals`: the disturbances and the sensor noise of the whole episode, drawn at
        its start; none by default.
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
    """Whether disturbances or sensor noise are drawn for an episode."""
    return not isinstance(env.disturbance, Zero) or env.sensor_noise is not None


def begin(env: Environment, key: PRNGKey, state: State | None = None) -> EpisodeState:
    """Start an episode: the one that `rollout` runs with this key, or from `state`."""
    start_key, w_key, noise_key, _ = env.split_key(key)
    x = env.reset(start_key) if state is None else state
    w = noise = None
    if env.disturbance is not None and not isinstance(env.disturbance, Zero):
        w = env.disturbance.draw(w_key, env.dt, env.horizon, x.dtype)
    if env.sensor_noise is not None:
        # The state after the last step is observed too. If the recorded noise has no
        # row for it, repeat its last row.
        recorded = env.sensor_noise.recorded_steps
        ends = recorded is not None and recorded <= env.horizon
        steps = env.horizon + (not ends)
        noise = env.sensor_noise.draw(noise_key, env.dt, steps, x.dtype)
        noise = jnp.concatenate([noise, noise[-1:]]) if ends else noise
    return EpisodeState(x, jnp.zeros((), int), Signals(w, noise))


def time_of(env: Environment, episode: EpisodeState) -> Scalar:
    """The time of an episode, in the precision of its state."""
    return (episode.time * env.dt).astype(episode.state.dtype)


def observe(env: Environment, episode: EpisodeState) -> Float[Array, " features"]:
    """The encoded observation with sensor noise, shape `(feature_size,)`."""
    x, noise = episode.state, episode.signals.noise
    y = env.dynamics.observe(time_of(env, episode), x)
    return env.encode(y if noise is None else (y + noise[episode.time]).astype(x.dtype))


def step(
    env: Environment, episode: EpisodeState, action: Array, truncate: bool = True
) -> tuple[EpisodeState, StepOutcome]:
    """One step. The last step adds the final cost. With `truncate` the horizon ends an
    episode."""
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
    """Whether the function uses the first of its arguments, an array."""
    jaxpr = jax.make_jaxpr(function)(*args).jaxpr
    return any(jaxpr.invars[0] is v for e in jaxpr.eqns for v in e.invars)
