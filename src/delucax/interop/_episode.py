"""An episode, step by step: what every adapter of an environment does."""

from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jax.typing import DTypeLike
from jaxtyping import Array, Float

from .._results import RESULTS
from .._typing import BoolScalar, Control, PRNGKey, Scalar, State
from ..disturbances import AbstractDisturbance, Zero
from ..environments import Environment


class Signals(NamedTuple):
    """The disturbances and the sensor noise of a whole episode, where there are any."""

    disturbances: Float[Array, "steps disturbances"] | None = None
    noise: Float[Array, "times observations"] | None = None


NO_SIGNALS = Signals()


class EpisodeState(eqx.Module):
    """Where an episode is.

    **Arguments:**

    - `state`: of the environment, shape `(state_size,)`.
    - `time`: steps since it began.
    - `signals`: the disturbances and the noise of the whole episode, drawn when it
        began; none by default.

    !!! example

        ```python
        import jax.numpy as jnp
        from delucax.interop.gymnax import EpisodeState

        EpisodeState(jnp.array([0.5, 0.0]), jnp.asarray(0))
        ```
    """

    state: Array
    time: Array
    signals: Signals = NO_SIGNALS


class Outcome(NamedTuple):
    """What a step says of itself."""

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
    if not isinstance(env.disturbance, Zero):
        w = env.disturbance.draw(w_key, env.dt, env.horizon, x.dtype)
    if env.sensor_noise is not None:
        noise = _draw_noise(env, env.sensor_noise, noise_key, x.dtype)
    return EpisodeState(x, jnp.zeros((), int), Signals(w, noise))


def _draw_noise(
    env: Environment, noise: AbstractDisturbance, key: PRNGKey, dtype: DTypeLike
) -> Float[Array, "times observations"]:
    # The state after the last step is observed too. Where what is recorded ends there,
    # its last row is the noise of that.
    recorded = noise.recorded_steps
    ends = recorded is not None and recorded <= env.horizon
    rows = noise.draw(key, env.dt, env.horizon + (not ends), dtype)
    return jnp.concatenate([rows, rows[-1:]]) if ends else rows


def time_of(env: Environment, episode: EpisodeState) -> Scalar:
    """The time, in the precision of the state."""
    return (episode.time * env.dt).astype(episode.state.dtype)


def observe(env: Environment, episode: EpisodeState) -> Float[Array, " features"]:
    """What a network is given."""
    x, noise = episode.state, episode.signals.noise
    y = env.dynamics.observe(time_of(env, episode), x)
    return env.encode(y if noise is None else (y + noise[episode.time]).astype(x.dtype))


def step(
    env: Environment,
    episode: EpisodeState,
    action: Control | Array,
    truncate: bool = True,
) -> tuple[EpisodeState, Outcome]:
    """One step; the final cost is charged with the last, which is at the horizon if
    episodes are to be truncated there."""
    x, w = episode.state, episode.signals.disturbances
    w = None if w is None else w[episode.time]
    transition = env.step(time_of(env, episode), x, action, w)
    terminated, x_next = transition.terminated, transition.state.astype(x.dtype)
    after = EpisodeState(x_next, episode.time + 1, episode.signals)
    truncated = (after.time >= env.horizon) & truncate
    final = jnp.where(
        terminated | truncated, env.cost.final(time_of(env, after), x_next), 0
    )
    finite = jnp.all(jnp.isfinite(action)) & jnp.all(jnp.isfinite(x_next))
    failed = (transition.result != RESULTS.successful) | ~finite
    return after, Outcome(-(transition.cost + final), terminated, truncated, failed)
