"""A batch of environments with the interface of Stable-Baselines3."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from gymnasium.vector import AutoresetMode
from stable_baselines3.common.vec_env import VecEnv  # pyright: ignore

from ...environments import Environment
from ..gymnasium import GymnasiumVectorEnv
from ..gymnasium._vector_env import dones_and_infos


class SB3VecEnv(VecEnv):
    """Many copies of a [`delucax.Environment`][] as one `VecEnv` of Stable-Baselines3.

    Pass it to the algorithms of Stable-Baselines3. A step of all copies, with the
    resets of those that have ended, is one call of one compiled function. To see the
    returns of episodes in the logs, wrap it in
    `stable_baselines3.common.vec_env.VecMonitor`.

    **Arguments:**

    - `env`: the environment.
    - `num_envs`: the number of copies.
    - `discrete`: whether actions are whole numbers, indices into `env.actions`. By
        default they are if the environment has such a table.

    `seed` and `set_options({"state": x})` apply to the next `reset`.

    **Raises:** `ValueError` if an argument is wrong. A step raises the errors of
    [`delucax.interop.gymnasium.GymnasiumVectorEnv`][].

    !!! example

        ```python
        import delucax as dlx
        from delucax.interop.stable_baselines3 import SB3VecEnv
        from stable_baselines3 import PPO

        envs = SB3VecEnv(dlx.make("pendulum"), 16)
        PPO("MlpPolicy", envs, n_steps=64, device="cpu").learn(2_048)
        ```

    Source: Raffin, Hill, Gleave, Kanervisto, Ernestus and Dormann, 2021.
    """

    def __init__(
        self, env: Environment, num_envs: int, *, discrete: bool | None = None
    ):
        options: Any = dict(autoreset_mode=AutoresetMode.SAME_STEP, discrete=discrete)
        self.vector = vector = GymnasiumVectorEnv(env, num_envs, **options)
        spaces = vector.single_observation_space, vector.single_action_space
        super().__init__(vector.num_envs, *spaces)

    def reset(self) -> np.ndarray:
        """Start an episode in each copy.

        **Returns:** the observations.
        """
        options = None
        if any(self._options):
            if any(set(options) != {"state"} for options in self._options):
                raise ValueError(
                    "SB3VecEnv.reset: options must be {'state': ...} for each copy, "
                    f"got {self._options}."
                )
            states = [options["state"] for options in self._options]
            options = {"state": np.stack(states)}
        observations, _ = self.vector.reset(seed=self._seeds, options=options)
        self.reset_infos = [{} for _ in range(self.num_envs)]
        self._reset_seeds()
        self._reset_options()
        return observations

    def step_async(self, actions: np.ndarray) -> None:
        """Store the actions for `step_wait`.

        **Arguments:** `actions`: one for each copy.
        """
        self._actions = actions

    def step_wait(
        self,
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, list[dict[str, Any]]]:
        """One step of each copy.

        **Returns:** the observations, the rewards, whether each episode has ended, and
        a list with a dictionary for each copy.
        """
        return dones_and_infos(self.vector.step(self._actions))

    def close(self) -> None:
        """Does nothing: there is nothing to close."""

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        """An attribute, which is the same for all copies.

        **Arguments:** `attr_name`: the name of the attribute. `indices`: the indices of
            the copies; all by default.

        **Returns:** a list with the attribute for each of these copies.
        """
        return [getattr(self.vector, attr_name) for _ in self._get_indices(indices)]

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        """Always raises: copies have no attributes of their own.

        **Arguments:** `attr_name`, `value`, `indices`: not used.

        **Raises:** `ValueError` always.
        """
        raise ValueError(
            f"SB3VecEnv: {attr_name} cannot be set, because the copies are one "
            "program; make another from a changed environment (`delucax.replace`)."
        )

    def env_method(
        self, method_name: str, *method_args: Any, indices: Any = None, **kwargs: Any
    ) -> list[Any]:
        """Always raises: copies have no methods of their own.

        **Arguments:** `method_name`, `method_args`, `indices`, `kwargs`: not used.

        **Raises:** `ValueError` always.
        """
        raise ValueError(
            f"SB3VecEnv: {method_name} cannot be called on a copy, because the copies "
            "are one program."
        )

    def env_is_wrapped(self, wrapper_class: Any, indices: Any = None) -> Sequence[bool]:
        """Whether copies are wrapped: never.

        **Arguments:** `wrapper_class`: not used. `indices`: the indices of the copies;
            all by default.

        **Returns:** a list with `False` for each of these copies.
        """
        return [False for _ in self._get_indices(indices)]
