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
    """The numbers of an environment, as the `params` of gymnax's protocol.

    **Arguments:** `environment`: the environment.

    !!! example

        ```python
        import delucax as dlx
        from delucax.interop.gymnax import GymnaxParams, to_gymnax

        env = to_gymnax(dlx.make("pendulum"))
        longer = GymnaxParams(dlx.make("pendulum", length=1.2))
        env.action_space(longer)
        ```
    """

    arrays: Any
    static: Any = eqx.field(static=True)

    def __init__(self, environment: Environment):
        check_instance(environment, Environment, "environment", "GymnaxParams")
        self.arrays, self.static = eqx.partition(environment, eqx.is_array)

    @property
    def environment(self) -> Environment:
        """The environment."""
        return eqx.combine(self.arrays, self.static)

    @property
    def max_steps_in_episode(self) -> int:
        """The horizon."""
        return self.environment.horizon


Params: TypeAlias = GymnaxParams | None
"""`default_params` by default."""


class GymnaxEnv:
    """A [`delucax.Environment`][] in gymnax's protocol; see
    [`delucax.interop.gymnax.to_gymnax`][].

    It holds no arrays that JAX sees, has a hash, and equals another if all numbers do.

    **Arguments:**

    - `env`: the environment, whose numbers are the `default_params`.
    - `discrete`: whether actions are whole numbers, indices into `env.actions`. By
        default they are if there is such a table.
    - `separate_ends`: whether `step` returns `terminated` and `truncated`, as gymnax
        does from 1.0 on, in place of `done`; by default as
        [`delucax.interop.gymnax.to_gymnax`][] says.

    **Raises:** `ValueError` on a wrong argument; in a step, on an action of the wrong
    size or kind, or one that is not in the table. Traced actions are truncated to whole
    numbers and clamped to the table.

    !!! example

        ```python
        import delucax as dlx
        import jax
        from delucax.interop.gymnax import GymnaxEnv

        env = GymnaxEnv(dlx.make("cartpole"))
        observation, state = env.reset(jax.random.key(0))
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
            # rejax, which imports any gymnax, expects `done`.
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
        """The numbers of the environment that it was made of."""
        return GymnaxParams(self._made.env)

    @property
    def name(self) -> str:
        """The name of the plant."""
        dynamics = self._made.env.dynamics
        return type(getattr(dynamics, "system", dynamics)).__name__

    @property
    def num_actions(self) -> int:
        """The number of actions; of controls if they are not whole numbers."""
        env: Any = self._made.env
        return len(env.actions) if self.discrete else env.control_size

    @functools.partial(jax.jit, static_argnames=("self",))
    def reset(self, key: PRNGKey, params: Params = None) -> tuple[Array, EpisodeState]:
        """Begin an episode, the one of `delucax.rollout` with the same key.

        **Arguments:**

        - `key`: a random key.
        - `params`: `default_params` by default.

        **Returns:** the observation, and the state of the episode: a module with the
        state of the environment, `state`, the steps since it began, `time`, and the
        disturbances and the noise of the whole episode, `signals`.
        """
        return self.reset_env(key, params)

    def step(
        self, key: PRNGKey, state: EpisodeState, action: Any, params: Params = None
    ) -> tuple[Any, ...]:
        """One step; at the end of the episode, the first state of the next.

        **Arguments:**

        - `key`: a random key, of the next episode.
        - `state`: of the episode.
        - `action`: in the action space; a control beyond the bounds is clipped.
        - `params`: `default_params` by default.

        **Returns:** observation, state, reward, done and a dictionary; `terminated` and
        `truncated` in place of `done` with `separate_ends`. The dictionary has these
        two, `"final_observation"` (before the reset), `"discount"` (0 if terminated)
        and `"failed"` (whether the solver did not converge, or the action or the next
        state is not finite: compiled code raises nothing, and NaN goes on as NaN).
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
        # One of the two where nothing is batched: a reset may draw a whole episode.
        done = terminated | truncated
        observation, after = jax.lax.cond(done, reset, lambda: here)
        info["final_observation"] = last
        ends = (terminated, truncated) if self.separate_ends else (done,)
        return observation, after, reward, *ends, info

    def reset_env(
        self, key: PRNGKey, params: Params = None
    ) -> tuple[Array, EpisodeState]:
        """`reset`, not compiled.

        **Arguments:** `key`, `params`: of `reset`.

        **Returns:** as `reset` does.
        """
        check_key(key, "GymnaxEnv.reset")
        state = episodes.begin(self._environment(params), key)
        return self.get_obs(state, params), state

    def step_env(
        self, key: PRNGKey, state: EpisodeState, action: Any, params: Params = None
    ) -> tuple[Any, ...]:
        """One step, without a reset and not compiled.

        **Arguments:** `key`: not used. `state`, `action`, `params`: of `step`.

        **Returns:** observation, state, reward, done (`terminated` alone with
        `separate_ends`) and a dictionary.
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

        **Arguments:** `state`, `params`: of `step`. `key`: not used.

        **Returns:** the observation.
        """
        return episodes.observe(self._environment(params), state)

    def is_terminal(self, state: EpisodeState, params: Params = None) -> Array:
        """Whether the episode ends at a state, by itself or at the horizon.

        **Arguments:** `state`, `params`: of `step`.

        **Returns:** a boolean.
        """
        env = self._environment(params)
        truncated = state.time >= env.horizon
        if env.terminated is None:
            return truncated
        return env.terminated(episodes.time_of(env, state), state.state) | truncated

    def action_space(self, params: Params = None) -> Any:
        """The actions.

        **Arguments:** `params`: `default_params` by default.

        **Returns:** a space with `shape` and `dtype`, `low` and `high` or `n`, and
        `sample(key)` and `contains(x)`: gymnax's own where gymnax is in use.
        """
        ends = action_ends(self._environment(params))
        return gymnax_space(self.num_actions if self.discrete else ends)

    def observation_space(self, params: Params = None) -> Any:
        """The observations.

        **Arguments:** `params`: `default_params` by default.

        **Returns:** a space as of `action_space`.
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
    """An environment in gymnax's protocol, without gymnax.

    What trains on gymnax's environments (rejax, PureJaxRL, ...) trains on it. The
    observation is what `encode` makes of the environment's; the reward is minus the
    cost, with the final cost in the last step; the episode is truncated at the horizon,
    and `step` then begins the next. Gradients pass through a step, not through a reset.

    All numbers are in `params`, [`delucax.interop.gymnax.GymnaxParams`][], so that
    `jax.vmap` over params runs many plants at once.

    The disturbances and the sensor noise of an episode are drawn for the whole horizon
    when it is reset, from the key of the reset, and are carried in its state. Under
    `jax.vmap` a `step` computes a reset for each environment, whether its episode ends
    or not, and so draws them; `step_env` draws nothing.

    **Arguments:**

    - `env`: the environment.
    - `discrete`: whether actions are whole numbers, indices into `env.actions`. By
        default they are if there is such a table.
    - `separate_ends`: whether `step` returns `terminated` and `truncated`, as gymnax
        does from 1.0 on, in place of `done`, which rejax and PureJaxRL want. By default
        it does where gymnax 1.0 or later has been imported, whose wrappers want it, and
        rejax has not.

    **Returns:** a [`delucax.interop.gymnax.GymnaxEnv`][].

    **Raises:** `ValueError` on a wrong argument, or if `env` is being traced.

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
        ```
    """
    return GymnaxEnv(env, discrete=discrete, separate_ends=separate_ends)
