"""One environment with Gymnasium's interface."""

from typing import Any, NoReturn

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
from gymnasium.error import InvalidAction, ResetNeeded

from ..._check import as_vector, check_finite
from ...environments import Environment
from ._program import program, REWARD, STEP
from ._spaces import action_space, is_discrete, observation_space


RENDER_MODES = ("rgb_array", "human")


class GymnasiumEnv(gymnasium.Env):
    """A [`delucax.Environment`][] as a `gymnasium.Env`.

    The observation is what `encode` makes of the environment's, in float32; the reward
    is minus the cost, with the final cost in the last step. `terminated` is the
    environment's; `truncated` is true at its horizon. Controls beyond the bounds are
    clipped; without bounds, the action space ends at 1000. One step is one call of one
    compiled function.

    **Arguments:**

    - `env`: the environment.
    - `discrete`: whether actions are whole numbers, indices into `env.actions`. By
        default they are if there is such a table.
    - `render_mode`: `"rgb_array"`, `"human"`, or none (default).

    `reset(seed=..., options={"state": x})` starts at the state `x`.

    **Raises:** `ValueError` on a wrong argument. `step` raises
    `gymnasium.error.ResetNeeded` before `reset` and after the end,
    `gymnasium.error.InvalidAction` on an action of the wrong shape or kind, not finite,
    or not in the table; and `RuntimeError` if the simulation fails.

    !!! example

        ```python
        import delucax as dlx
        from delucax.interop.gymnasium import GymnasiumEnv

        env = GymnasiumEnv(dlx.make("pendulum", length=1.2))
        observation, info = env.reset(seed=0)
        observation, reward, terminated, truncated, info = env.step([0.5])
        ```
    """

    metadata: dict[str, Any] = {"render_modes": list(RENDER_MODES), "render_fps": 30}

    def __init__(
        self,
        env: Environment,
        *,
        discrete: bool | None = None,
        render_mode: str | None = None,
    ):
        where = "GymnasiumEnv"
        if not isinstance(env, Environment):
            raise ValueError(
                f"{where}: env must be a delucax.Environment, got {type(env).__name__}."
            )
        if render_mode is not None and render_mode not in RENDER_MODES:
            raise ValueError(
                f"{where}: render_mode must be one of {RENDER_MODES} or None, got "
                f"{render_mode!r}."
            )
        self.environment = env
        self.discrete = is_discrete(env, discrete, where)
        self.render_mode = render_mode
        fps = int(np.clip(np.round(1 / float(env.dt)), 1, 60))
        self.metadata = type(self).metadata | {"render_fps": fps}
        self.action_space = action_space(env, self.discrete)
        self.observation_space = observation_space(env)
        self._program = program(env, self.discrete)
        self._observation = self._program.layout.observation
        self._table = np.asarray(env.actions) if self.discrete else None
        self._shape, self._kinds = (
            ((), "iu")
            if self.discrete
            else (
                (env.control_size,),
                "iuf",
            )
        )
        # The packed array, and the action after it.
        self._given: Any = None
        self._signals: Any = None
        self._ended = True
        self._picture: Any = None

    @property
    def state(self) -> np.ndarray:
        """The state, shape `(state_size,)`."""
        if self._given is None:
            raise ResetNeeded("GymnasiumEnv: there is no state before reset().")
        return self._given[: self._program.layout.states].copy()

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Begin an episode.

        **Arguments:**

        - `seed`: of all that is random from now on; by default it goes on as it was.
        - `options`: `{"state": x}` starts at the state `x`.

        **Returns:** the observation, and an empty dictionary.
        """
        super().reset(seed=seed)
        options = dict(options or {})
        state = options.pop("state", None)
        if options:
            raise ValueError(
                "GymnasiumEnv: options takes 'state' alone, got "
                f"{', '.join(map(repr, options))}."
            )
        if state is not None:
            size, where = self.environment.state_size, "GymnasiumEnv"
            state = as_vector(jnp.asarray(state, float), size, "state", where)
            check_finite(state, "state", where)
        key = jax.random.key(int(self.np_random.integers(2**32)))
        packed, self._signals = self._program.start(key, state)
        packed = np.asarray(packed)
        action = np.zeros(self.action_space.shape or 1, packed.dtype)
        self._given = np.concatenate([packed, action])
        self._ended, self._moved = False, False
        if self.render_mode == "human":
            self.render()
        return packed[self._observation].astype(np.float32), {}

    def step(self, action: Any) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """One step.

        **Arguments:** `action`: in the action space.

        **Returns:** observation, reward, terminated, truncated, and an empty
        dictionary.
        """
        # Little Python: each line counts for about as much as the arithmetic.
        if self._ended:
            raise ResetNeeded(
                "GymnasiumEnv: call reset() before step(): the episode has "
                + ("not begun." if self._given is None else "ended.")
            )
        asked, given, size = np.asarray(action), self._given, self._program.layout.size
        if asked.shape != self._shape or asked.dtype.kind not in self._kinds:
            self._refuse(action)
        if self._table is not None and not 0 <= asked < len(self._table):
            self._refuse(action)
        given[size:] = asked
        packed = np.asarray(self._program.step(given, self._signals))
        reward, terminated, truncated, failed, _ = packed[REWARD:].tolist()
        if failed:
            self._fail(action)
        given[:size] = packed
        if terminated or truncated:
            self._ended = True
        self._moved = True
        if self.render_mode == "human":
            self.render()
        observation = packed[self._observation].astype(np.float32)
        return observation, reward, terminated > 0, truncated > 0, {}

    def _refuse(self, action: Any) -> NoReturn:
        """Say what an action must be."""
        if self._table is not None:
            raise InvalidAction(
                "GymnasiumEnv: action must be a whole number from 0 to "
                f"{len(self._table) - 1}, got {action!r}; discrete=False takes the "
                "control itself."
            )
        raise InvalidAction(
            f"GymnasiumEnv: action must be numbers of shape {self._shape}, got "
            f"{action!r}."
        )

    def _fail(self, action: Any) -> NoReturn:
        """Say why a step failed. An illegal action leaves the episode where it was."""
        if not np.all(np.isfinite(action)):
            raise InvalidAction(f"GymnasiumEnv: action must be finite, got {action}.")
        self._ended = True
        step = int(self._given[self._program.layout.size + STEP])
        raise RuntimeError(
            f"GymnasiumEnv: the simulation failed at step {step}: the state or the "
            "reward is not finite, or the solver did not converge. Call reset()."
        )

    def render(self) -> np.ndarray | None:
        """The plant as a picture, shape `(height, width, 3)`, or in a window.

        **Returns:** the picture in the mode `"rgb_array"`, else none.
        """
        if self.render_mode is None:
            gymnasium.logger.warn(
                "GymnasiumEnv: render() needs a render_mode, 'rgb_array' or 'human', "
                "given when the environment is made."
            )
            return None
        if self._given is None:
            raise ResetNeeded("GymnasiumEnv: call reset() before render().")
        if self._picture is None:
            from ...plotting._picture import Picture

            self._picture = Picture(self.environment, self.render_mode == "human")
        control = self._given[self._program.layout.size :]
        if self._table is not None:
            shown = self._table[int(control[0])]
            control = shown if self._moved else np.zeros_like(shown)
        frame = self._picture.frame(self.state, control)
        return frame if self.render_mode == "rgb_array" else None

    def close(self) -> None:
        """Close the window, if there is one."""
        if self._picture is not None:
            self._picture.close()
            self._picture = None
