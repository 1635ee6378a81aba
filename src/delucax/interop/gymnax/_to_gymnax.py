"""Conversion of an `Environment` to gymnax's protocol."""

import functools
import sys
from typing import Any, TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array

from ..._check import check_bool, check_instance, check_key, is_concrete
from ..._message import shortened
from ..._module import as_float_array
from ..._typing import PRNGKey
from ...environments import Environment
from .. import _episode as episodes
from .._episode import EpisodeState
from .._spaces import (
    action_ends,
    gymnax_space,
    has_discrete_actions,
    observation_ends,
)


class GymnaxParams(eqx.Module):
    """The numbers of an environment, in a form that gymnax's protocol takes as
    `params`.

    **Arguments:**

    - `environment`: the environment, a [`delucax.Environment`][].

    **Raises:** `ValueError` if `environment` is not an environment.

    !!! example

        ```python
        import delucax as dlx
        import jax
        import jax.numpy as jnp
        from delucax.interop.gymnax import GymnaxParams, to_gymnax

        env, key = to_gymnax(dlx.make("pendulum")), jax.random.key(0)
        longer = GymnaxParams(dlx.make("pendulum", length=1.2))
        observation, state = env.reset(key, longer)
        env.step_env(key, state, jnp.ones(1), longer)[2]
        ```

        ```text
        Array(-4.667, dtype=float32)
        ```
    """

    arrays: Any
    static: Any = eqx.field(static=True)

    def __init__(self, environment: Environment):
        check_instance(environment, Environment, "environment", "GymnaxParams")
        self.arrays, static = eqx.partition(environment, eqx.is_array)
        # Flattened, because a list or a dictionary has no hash.
        leaves, structure = jax.tree.flatten(static)
        self.static = tuple(leaves), structure

    @property
    def environment(self) -> Environment:
        """The environment with these numbers."""
        leaves, structure = self.static
        return eqx.combine(self.arrays, jax.tree.unflatten(structure, leaves))

    @property
    def max_steps_in_episode(self) -> int:
        """The horizon of the environment."""
        return self.environment.horizon


Params: TypeAlias = GymnaxParams | None
"""The parameters of a call; `None` means `default_params`."""


class GymnaxEnv:
    """A [`delucax.Environment`][] in gymnax's protocol.
    [`delucax.interop.gymnax.to_gymnax`][] makes one.

    A `GymnaxEnv` is hashable, so it can be a static argument of `jax.jit`. Two
    environments are equal if all their numbers are equal.

    **Arguments:**

    - `env`: the environment. Its numbers are the `default_params`.
    - `discrete`: whether actions are whole numbers, which are indices into
        `env.actions`. By default `discrete` is true if the environment has a table of
        actions.
    - `separate_ends`: whether `step` returns `terminated` and `truncated`, as in gymnax
        1.0, in place of `done`. [`delucax.interop.gymnax.to_gymnax`][] describes the
        default.

    **Raises:** `ValueError` if an argument is wrong, or `env` is being traced. A step
    raises a `ValueError` if the action has the wrong size or type, or is not in the
    table. Under `jax.jit`, actions cannot be checked, so they are truncated to whole
    numbers and clamped to the table.

    !!! example

        ```python
        import delucax as dlx
        import jax
        from delucax.interop.gymnax import GymnaxEnv

        env = GymnaxEnv(dlx.make("cartpole"))
        observation, state = env.reset(jax.random.key(0))
        observation.shape
        ```

        ```text
        (4,)
        ```
    """

    def __init__(
        self,
        env: Environment,
        *,
        discrete: bool | None = None,
        separate_ends: bool | None = None,
    ):
        where = "to_gymnax"
        check_instance(env, Environment, "env", where)
        leaves = jax.tree.leaves(eqx.filter(env, eqx.is_array))
        if not all(map(is_concrete, leaves)):
            raise ValueError(
                f"{where}: env must be concrete, got one that is being traced (by "
                "jax.jit, jax.vmap or jax.grad); give traced numbers as params, "
                "GymnaxParams(env)."
            )
        self.discrete = has_discrete_actions(env, discrete, where)
        if separate_ends is None:
            # rejax expects `done`, with every version of gymnax that it imports.
            theirs = sys.modules.get("gymnax.environments.environment")
            since_1 = hasattr(getattr(theirs, "Environment", None), "is_truncated")
            separate_ends = since_1 and "rejax" not in sys.modules
        self.separate_ends = check_bool(separate_ends, "separate_ends", where)
        self._made = episodes.HashableEnvironment(env)
        self._identity = (self._made, self.discrete, self.separate_ends)

    def __hash__(self):
        return hash(self._identity)

    def __eq__(self, other):
        return isinstance(other, GymnaxEnv) and self._identity == other._identity

    @property
    def default_params(self) -> GymnaxParams:
        """The numbers of the original environment."""
        return GymnaxParams(self._made.env)

    @property
    def name(self) -> str:
        """The name of the plant."""
        dynamics = self._made.env.dynamics
        return type(getattr(dynamics, "system", dynamics)).__name__

    @property
    def num_actions(self) -> int:
        """The number of actions, or of controls if actions are not whole numbers."""
        env: Any = self._made.env
        return len(env.actions) if self.discrete else env.control_size

    @functools.partial(jax.jit, static_argnames=("self",))
    def reset(self, key: PRNGKey, params: Params = None) -> tuple[Array, EpisodeState]:
        """Start an episode: the same one as [`delucax.rollout`][] with this key.

        **Arguments:**

        - `key`: a random key.
        - `params`: the numbers of the environment; `default_params` by default.

        **Returns:** the observation, and the state of the episode. That is a module
        with the state of the environment (`state`), the number of steps since the start
        (`time`), and the disturbances and the noise of the whole episode (`signals`).
        """
        return self.reset_env(key, params)

    def step(
        self, key: PRNGKey, state: EpisodeState, action: Any, params: Params = None
    ) -> tuple[Any, ...]:
        """One step. If the step ends the episode, it also starts the next episode.

        **Arguments:**

        - `key`: a random key for the start of the next episode.
        - `state`: the state of the episode.
        - `action`: an action in the action space. Controls outside the bounds are
            clipped.
        - `params`: the numbers of the environment; `default_params` by default.

        **Returns:** the observation, state, reward, `done` and a dictionary; with
        `separate_ends`, `terminated` and `truncated` in place of `done`. The dictionary
        holds

        - `"terminated"` and `"truncated"`;
        - `"final_observation"`: the observation before the reset;
        - `"discount"`: 0 if terminated, else 1;
        - `"failed"`: whether the solver did not converge, or the action or the next
            state is not finite. Compiled code cannot raise an error.
        """
        self._check_action(action)
        return self._step(key, state, action, params)

    @functools.partial(jax.jit, static_argnames=("self",))
    def _step(self, key: Any, state: EpisodeState, action: Any, params: Any):
        last, after, reward, _, info = self.step_env(key, state, action, params)
        terminated, truncated = info["terminated"], info["truncated"]

        as_now = lambda new, now: jnp.asarray(new, now.dtype)
        here = (last, after)
        reset = lambda: jax.tree.map(as_now, self.reset_env(key, params), here)
        # Without `vmap` only one branch runs: a reset may draw a whole episode.
        done = terminated | truncated
        observation, after = jax.lax.cond(done, reset, lambda: here)
        info["final_observation"] = last
        ends = (terminated, truncated) if self.separate_ends else (done,)
        return observation, after, reward, *ends, info

    def reset_env(
        self, key: PRNGKey, params: Params = None
    ) -> tuple[Array, EpisodeState]:
        """As `reset`, but not compiled.

        **Arguments:** `key`, `params`: as in `reset`.

        **Returns:** what `reset` returns.

        **Raises:** `ValueError` if `key` is not one random key.
        """
        check_key(key, "GymnaxEnv.reset")
        state = episodes.begin(self._environment(params), key)
        return self.get_obs(state, params), state

    def step_env(
        self, key: PRNGKey, state: EpisodeState, action: Any, params: Params = None
    ) -> tuple[Any, ...]:
        """One step without a reset. It is not compiled.

        **Arguments:** `key`: not used. `state`, `action`, `params`: as in `step`.

        **Returns:** the observation, state, reward, `done` and a dictionary. With
        `separate_ends`, `terminated` takes the place of `done`.
        """
        env, given = self._environment(params), self._check_action(action)
        if self.discrete:
            u = jnp.clip(given.reshape(()).astype(int), 0, self.num_actions - 1)
        else:
            u = given.reshape(env.control_size)
        after, outcome = episodes.step(env, state, u)
        info = {
            "terminated": outcome.terminated,
            "truncated": outcome.truncated,
            "discount": 1 - outcome.terminated.astype(outcome.reward.dtype),
            "failed": outcome.failed | ~jnp.all(jnp.isfinite(given)),
        }
        ended = outcome.terminated | outcome.truncated
        done = outcome.terminated if self.separate_ends else ended
        return episodes.observe(env, after), after, outcome.reward, done, info

    def get_obs(
        self, state: EpisodeState, params: Params = None, key: Any = None
    ) -> Array:
        """The observation of a state.

        **Arguments:** `state`, `params`: as in `step`. `key`: not used.

        **Returns:** the observation, shape `(feature_size,)`.
        """
        return episodes.observe(self._environment(params), state)

    def is_terminal(self, state: EpisodeState, params: Params = None) -> Array:
        """Whether the episode ends at a state, by termination or at the horizon.

        **Arguments:** `state`, `params`: as in `step`.

        **Returns:** a boolean.
        """
        env = self._environment(params)
        truncated = state.time >= env.horizon
        if env.terminated is None:
            return truncated
        return env.terminated(episodes.time_of(env, state), state.state) | truncated

    def action_space(self, params: Params = None) -> Any:
        """The space of actions.

        **Arguments:** `params`: the numbers of the environment; `default_params` by
            default.

        **Returns:** a space with `shape`, `dtype`, `sample(key)` and `contains(x)`, and
        either `low` and `high`, or `n`. The space is an object of gymnax if gymnax has
        been imported.
        """
        ends = action_ends(self._environment(params))
        return gymnax_space(self.num_actions if self.discrete else ends)

    def observation_space(self, params: Params = None) -> Any:
        """The space of observations.

        **Arguments:** `params`: the numbers of the environment; `default_params` by
            default.

        **Returns:** a space with the same attributes as the result of `action_space`.
        """
        return gymnax_space(observation_ends(self._environment(params)))

    def _environment(self, params: Params) -> Environment:
        if params is None:
            return self._made.env
        hint = ", such as default_params"
        check_instance(params, GymnaxParams, "params", "GymnaxEnv", hint)
        return params.environment

    def _check_action(self, action: Any) -> Array:
        given = as_float_array(action)
        size = 1 if self.discrete else self._made.env.control_size
        if not eqx.is_inexact_array(given) or given.size != size:
            got = f"shape {given.shape}" if eqx.is_array(given) else shortened(action)
            raise ValueError(f"GymnaxEnv: action must have {size} entries, got {got}.")
        if self.discrete and is_concrete(given):
            index, last = given.item(), self.num_actions - 1
            if not (index.is_integer() and 0 <= index <= last):
                raise ValueError(
                    f"GymnaxEnv: action must be a whole number from 0 to {last}, got "
                    f"{shortened(action)}."
                )
        return given


def to_gymnax(
    env: Environment, *, discrete: bool | None = None, separate_ends: bool | None = None
) -> GymnaxEnv:
    """Convert an environment to gymnax's protocol. This does not need gymnax.

    Libraries such as rejax and PureJaxRL, which train on environments of gymnax, can
    train on the converted environment. Each observation is passed through the `encode`
    of the environment. The reward is minus the cost. In the last step, the final cost
    is also subtracted from the reward. When the horizon is reached, the episode is
    truncated, and `step` starts the next episode. Gradients pass through a step, but
    not through a reset.

    The numbers of the environment are in `params`, a
    [`delucax.interop.gymnax.GymnaxParams`][]. Use `jax.vmap` over `params` to run many
    plants at once.

    A reset draws the disturbances and the sensor noise of a whole episode from its key,
    and stores these arrays in the state. Under `jax.vmap`, each `step` computes a reset
    for every environment, whether its episode ends or not. If drawing these random
    numbers is slow, use `step_env`, which never resets and draws nothing.

    **Arguments:**

    - `env`: the environment.
    - `discrete`: whether actions are whole numbers, which are indices into
        `env.actions`. By default `discrete` is true if the environment has a table of
        actions.
    - `separate_ends`: whether `step` returns `terminated` and `truncated`, as in gymnax
        1.0, instead of `done`, which rejax and PureJaxRL expect. By default
        `separate_ends` is true if gymnax 1.0 or later has been imported and rejax has
        not been imported.

    **Returns:** a [`delucax.interop.gymnax.GymnaxEnv`][].

    **Raises:** `ValueError` if an argument is wrong, or if `env` is being traced.

    !!! example

        ```python
        import delucax as dlx
        import jax
        import jax.numpy as jnp
        from delucax.interop.gymnax import to_gymnax

        env = to_gymnax(dlx.make("pendulum"))
        params, key = env.default_params, jax.random.key(0)
        observation, state = env.reset(key, params)
        observation, state, reward, done, info = env.step(
            key, state, jnp.zeros(1), params
        )
        observation.shape, done
        ```

        ```text
        ((3,), Array(False, dtype=bool))
        ```
    """
    return GymnaxEnv(env, discrete=discrete, separate_ends=separate_ends)
