"""A batch of environments with Gymnasium's vector interface."""

import functools
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from gymnasium.error import InvalidAction, ResetNeeded
from gymnasium.spaces import Discrete
from gymnasium.utils.seeding import np_random
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space

from ..._check import check_count, check_instance
from ..._message import shortened
from ..._typing import PRNGKey
from ...environments import Environment
from .._spaces import has_discrete_actions
from . import _program as programs


class GymnasiumVectorEnv(VectorEnv):
    """Many copies of a [`delucax.Environment`][] as one `gymnasium.vector.VectorEnv`.

    A step of all copies, with the resets of those that have ended, is one call of one
    compiled function. Observations, rewards and ends are the same as in
    [`delucax.interop.gymnasium.GymnasiumEnv`][], which can also render.

    **Arguments:**

    - `env`: the environment.
    - `num_envs`: the number of copies.
    - `autoreset_mode`: when an episode that has ended is reset.
        `AutoresetMode.NEXT_STEP` (default): in the next step, which ignores its action.
        `SAME_STEP`: at once. The step returns the first observation of the next
        episode, and the last observation of the old one in `info["final_obs"]`.
        `DISABLED`: not before you call `reset`.
    - `discrete`: whether actions are whole numbers, indices into `env.actions`. By
        default they are if the environment has such a table.

    `reset(options={"state": x})` starts all copies at the state `x`, or each at its own
    state if `x` has shape `(num_envs, state_size)`. `options={"reset_mask": mask}`
    resets only some copies.

    **Raises:** `ValueError` if an argument is wrong. `step` raises
    `gymnasium.error.ResetNeeded` before the first `reset`,
    `gymnasium.error.InvalidAction` if actions have the wrong shape or type, are not
    finite, or are not in the table, and `RuntimeError` if a simulation fails.

    !!! example

        ```python
        import delucax as dlx
        import numpy as np
        from delucax.interop.gymnasium import GymnasiumVectorEnv

        envs = GymnasiumVectorEnv(dlx.make("pendulum"), 16)
        observations, infos = envs.reset(seed=0)
        observations, rewards, *_ = envs.step(np.zeros((16, 1), np.float32))
        observations.shape, rewards.shape
        ```

        ```text
        ((16, 3), (16,))
        ```
    """

    def __init__(
        self,
        env: Environment,
        num_envs: int,
        *,
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
        discrete: bool | None = None,
    ):
        where = "GymnasiumVectorEnv"
        check_instance(env, Environment, "env", where)
        try:
            self._mode = AutoresetMode(autoreset_mode)
        except ValueError:
            raise ValueError(
                f"{where}: autoreset_mode must be one of "
                f"{[mode.value for mode in AutoresetMode]}, got {autoreset_mode!r}."
            ) from None
        self.environment = env
        self.num_envs = check_count(num_envs, "num_envs", where)
        self.discrete = has_discrete_actions(env, discrete, where)
        self.metadata = {"autoreset_mode": self._mode, "render_modes": []}
        spaces = programs.spaces(env, self.discrete)
        self.single_action_space, self.single_observation_space = spaces
        batched = (batch_space(space, num_envs) for space in spaces)
        self.action_space, self.observation_space = batched
        self._program = programs.program(env, self.discrete)
        self._packed: Any = None

    @property
    def states(self) -> np.ndarray:
        """The current states, shape `(num_envs, state_size)`."""
        if self._packed is None:
            raise ResetNeeded("GymnasiumVectorEnv: there is no state before reset().")
        return np.array(self._packed)[:, self._program.states]

    def reset(
        self,
        *,
        seed: int | Sequence[int | None] | None = None,
        options: dict[str, Any] | None = None,
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Start an episode in each copy.

        **Arguments:**

        - `seed`: the seed of all that is random from now on. By default the random
            numbers continue. A list holds one seed, or `None`, for each copy. A copy
            then starts at the same state as a
            [`delucax.interop.gymnasium.GymnasiumEnv`][] with that seed.
        - `options`: `{"state": x}`: the first state, one for all copies or one for
            each. `{"reset_mask": mask}`: which copies are reset, booleans of shape
            `(num_envs,)`.

        **Returns:** the observations, and an empty dictionary.
        """
        where = "GymnasiumVectorEnv"
        plant, count = self.environment, self.num_envs
        state, mask = programs.read_options(options, plant, where, count)
        keys = self._start_keys(seed)
        packed, signals = self._program.start_batch(keys, state)
        if mask is not None:
            mask = np.asarray(mask)
            if mask.shape != (self.num_envs,) or mask.dtype != bool:
                raise ValueError(
                    f"{where}: reset_mask must be {self.num_envs} booleans, got "
                    f"{mask.dtype} of shape {mask.shape}."
                )
            if self._packed is None:
                raise ResetNeeded(
                    f"{where}: call reset() without reset_mask first, to start all."
                )
            select = functools.partial(jax.vmap(jnp.where), mask)
            current = self._packed, self._signals
            packed, signals = jax.tree.map(select, (packed, signals), current)
        self._packed, self._signals = packed, signals
        return self._observations(np.asarray(packed)), {}

    def _start_keys(self, seed: Any) -> PRNGKey:
        """The keys of this reset. Sets `_key`, the key of later automatic resets."""
        own: dict[int, int] = {}
        if isinstance(seed, Sequence | np.ndarray):
            integer = lambda one: isinstance(one, int | np.integer) and one >= 0
            valid = [one is None or integer(one) for one in seed]
            if len(valid) != self.num_envs or not all(valid):
                raise ValueError(
                    f"GymnasiumVectorEnv: seed must be one whole number from 0, or "
                    f"{self.num_envs} of them, one for each copy, got "
                    f"{shortened(seed)}."
                )
            own = {i: int(one) for i, one in enumerate(seed) if one is not None}
            mixed = np.random.SeedSequence(list(own.values())).generate_state(1)[0]
            seed = int(mixed) if own else None
        super().reset(seed=seed)
        self._key, use = jax.random.split(programs.draw_key(self.np_random))
        keys = jax.random.split(use, self.num_envs)
        for i, one in own.items():
            keys = keys.at[i].set(programs.draw_key(np_random(one)[0]))
        return keys

    def step(self, actions: Any) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        """One step of each copy.

        **Arguments:** `actions`: actions in the action space, one for each copy.

        **Returns:** the observations, rewards, terminations and truncations, and a
        dictionary.
        """
        if self._packed is None:
            raise ResetNeeded("GymnasiumVectorEnv: call reset() before step().")
        actions = self._as_actions(actions)
        self._packed, last, self._signals, self._key = self._program.step_batch(
            self._mode.value, self._packed, actions, self._signals, self._key
        )
        packed, last = np.asarray(self._packed), np.asarray(last)
        if last[:, programs.FAILED].any() and packed[:, programs.FAILED].any():
            which = np.flatnonzero(packed[:, programs.FAILED])[:5].tolist()
            self._packed = None
            raise RuntimeError(
                f"GymnasiumVectorEnv: the simulation of copies {which} failed: the "
                "state or the reward is not finite, or the solver did not converge. "
                "Call reset()."
            )
        terminations = packed[:, programs.TERMINATED] > 0
        truncations = packed[:, programs.TRUNCATED] > 0
        info: dict[str, Any] = {}
        ended = terminations | truncations
        if self._mode is AutoresetMode.SAME_STEP and ended.any():
            final = np.full(self.num_envs, None, dtype=object)
            observations = self._observations(last)
            for i in np.flatnonzero(ended):
                final[i] = observations[i]
            info = {"final_obs": final, "_final_obs": ended.copy()}
            info |= {"final_info": {}, "_final_info": ended.copy()}
        rewards = packed[:, programs.REWARD].astype(np.float64)
        return self._observations(packed), rewards, terminations, truncations, info

    def _observations(self, packed: np.ndarray) -> np.ndarray:
        return packed[:, self._program.observation].astype(np.float32)

    def _as_actions(self, actions: Any) -> np.ndarray:
        """The actions as an array for the compiled step. Raises if they are invalid."""
        where, space = "GymnasiumVectorEnv", self.single_action_space
        try:
            actions = np.asarray(actions)
        except ValueError:  # ragged
            raise InvalidAction(
                f"{where}: actions must have the shape {self.action_space.shape}, got "
                f"{shortened(actions)}."
            ) from None
        discrete = isinstance(space, Discrete)
        what, kinds = ("whole numbers", "iu") if discrete else ("numbers", "iuf")
        shape = (self.num_envs, *(space.shape or ()))
        if actions.shape != shape or actions.dtype.kind not in kinds:
            raise InvalidAction(
                f"{where}: actions must be {what} of shape {shape}, got "
                f"{actions.dtype} of shape {actions.shape}."
            )
        if not discrete:
            if not np.isfinite(actions).all():
                raise InvalidAction(f"{where}: actions must be finite.")
            return actions
        if not ((actions >= 0) & (actions < space.n)).all():
            raise InvalidAction(
                f"{where}: actions must be from 0 to {space.n - 1}, got {actions}."
            )
        return actions[:, None].astype(np.float32)


def dones_and_infos(
    step: tuple[Any, Any, Any, Any, dict[str, Any]],
) -> tuple[np.ndarray, np.ndarray, np.ndarray, list[dict[str, Any]]]:
    """The result of a step in the mode `SAME_STEP`, in the form
    `(observations, rewards, dones, infos)` of Stable-Baselines3.

    The info of an episode that has ended holds its last observation, and whether the
    time limit ended it. In that case learners add the value of the last observation.
    """
    observations, rewards, terminations, truncations, info = step
    dones = terminations | truncations
    infos: list[dict[str, Any]] = [{} for _ in dones]
    for i in np.flatnonzero(dones):
        infos[i] = {
            "terminal_observation": info["final_obs"][i],
            "TimeLimit.truncated": bool(truncations[i] and not terminations[i]),
        }
    return observations, rewards.astype(np.float32), dones, infos
