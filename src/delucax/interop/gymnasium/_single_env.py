"""A single environment with Gymnasium's interface."""

import functools
import operator
from typing import Any, NoReturn

import gymnasium
import numpy as np
from gymnasium.error import InvalidAction, ResetNeeded

from ..._check import check_bool, check_choice, check_instance
from ..._message import shortened
from ...environments import Environment
from .._episode import has_signals
from .._spaces import has_discrete_actions
from . import _program as programs


RENDER_MODES = ("rgb_array", "human")


class GymnasiumEnv(gymnasium.Env):
    """A [`delucax.Environment`][] as a `gymnasium.Env`.

    The observation is `encode` of the observation of the environment, in float32. The
    reward is minus the cost. The last step adds minus the final cost. `terminated` is
    the condition of the environment, and `truncated` is true at its horizon. Controls
    outside the bounds are clipped; a control without bounds has the action space from
    -1000 to 1000. Each step is one call of one compiled function.

    **Arguments:**

    - `env`: the environment.
    - `discrete`: whether actions are whole numbers, indices into `env.actions`. By
        default they are if the environment has such a table.
    - `render_mode`: `"rgb_array"`, `"human"`, or `None` (default).
    - `truncate`: whether episodes are truncated at the horizon, True by default. With
        False, a wrapper such as Gymnasium's `TimeLimit` may end them, and no final cost
        is charged there. An environment with disturbances or sensor noise needs True.
    - `backend`: `"jax"` (default) or `"c"`. With `"c"`, a step is a call of C, which is
        exported and compiled when you make the environment, and kept on disk. This
        needs a C compiler. Resets still run in JAX.

    `reset(seed=..., options={"state": x})` starts at the state `x`.

    **Raises:** `ValueError` if an argument is wrong; with `backend="c"`, also if
    [`delucax.export.c`][] cannot export the environment, or no compiler is found.
    `step` raises `gymnasium.error.ResetNeeded` before the first `reset` and after the
    end of an episode. It raises `gymnasium.error.InvalidAction` if the action has the
    wrong shape or type, is not finite, or is not in the table; and `RuntimeError` if
    the simulation fails.

    !!! example

        ```python
        import delucax as dlx
        from delucax.interop.gymnasium import GymnasiumEnv

        env = GymnasiumEnv(dlx.make("pendulum", length=1.2))
        observation, info = env.reset(seed=0)
        observation, reward, terminated, truncated, info = env.step([0.5])
        terminated, truncated
        ```

        ```text
        (False, False)
        ```
    """

    metadata: dict[str, Any] = {"render_modes": list(RENDER_MODES), "render_fps": 30}

    def __init__(
        self,
        env: Environment,
        *,
        discrete: bool | None = None,
        render_mode: str | None = None,
        truncate: bool = True,
        backend: str = "jax",
    ):
        where = "GymnasiumEnv"
        check_instance(env, Environment, "env", where)
        check_choice(render_mode, (*RENDER_MODES, None), "render_mode", where)
        check_choice(backend, programs.BACKENDS, "backend", where)
        if not check_bool(truncate, "truncate", where) and has_signals(env):
            raise ValueError(
                f"{where}: truncate must be True if there are disturbances or sensor "
                "noise, because these are drawn up to the horizon, got False."
            )
        self.environment = env
        self.discrete = has_discrete_actions(env, discrete, where)
        self.truncate, self.backend = bool(truncate), backend
        self.render_mode = render_mode
        fps = int(np.clip(np.round(1 / float(env.dt)), 1, 60))
        self.metadata = type(self).metadata | {"render_fps": fps}
        self.action_space, self.observation_space = programs.spaces(env, self.discrete)
        self._program, self._stepper = self._compile()
        self._table = np.asarray(env.actions) if self.discrete else np.zeros((0, 1))
        self._count, self._shape = len(self._table), (env.control_size,)
        self._read: Any = operator.index if self.discrete else np.asarray
        self._buffer: Any = None
        self._ended = True
        self._picture: Any = None

    def _compile(self) -> tuple[programs.Program, Any]:
        """The compiled functions, and a function that allocates the memory of steps."""
        given = self.environment, self.discrete, self.truncate
        program = programs.program(*given)
        if self.backend == "jax":
            return program, programs.stepper(program)
        from ._exported import exported_stepper

        return program, exported_stepper(*given)

    @property
    def state(self) -> np.ndarray:
        """The current state, shape `(state_size,)`."""
        if self._buffer is None:
            raise ResetNeeded("GymnasiumEnv: there is no state before reset().")
        return self._buffer[self._program.states].copy()

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Start an episode.

        **Arguments:**

        - `seed`: the seed of all that is random from now on. By default the random
            numbers continue.
        - `options`: `{"state": x}` starts at the state `x`.

        **Returns:** the observation, and an empty dictionary.
        """
        super().reset(seed=seed)
        state, _ = programs.read_options(options, self.environment, "GymnasiumEnv")
        key = programs.draw_key(self.np_random)
        packed, self._signals = self._program.start(key, state)
        packed = np.asarray(packed)
        if self._buffer is None or self._buffer.dtype != packed.dtype:
            self._allocate(packed.dtype)
        self._packed[...] = packed
        self._action[...] = 0
        self._advance = self._step_in_place(self._signals)
        self._ended, self._stepped = False, False
        if self.render_mode == "human":
            self.render()
        return packed[self._program.observation].astype(np.float32), {}

    def _allocate(self, dtype: Any) -> None:
        """Allocate the arrays of steps."""
        size, actions = self._program.size, self.action_space.shape or (1,)
        # One array holds the packed array and the action, another the packed array
        # after the step. The other attributes are views of their parts.
        self._step_in_place, self._buffer, self._after = self._stepper(
            size + actions[0], dtype
        )
        self._packed, self._action = np.split(self._buffer, [size])
        self._outcome = self._after[programs.REWARD :].tolist
        view, single = self._after[self._program.observation], np.float32
        copy = functools.partial(view.astype, single)
        self._observation = view.copy if view.dtype == single else copy

    def __getstate__(self):
        """The attributes to copy: all except compiled functions and views."""
        views = "_program _stepper _packed _action _after _outcome _observation"
        drop = {*views.split(), "_step_in_place", "_advance"}
        state = {k: v for k, v in self.__dict__.items() if k not in drop}
        return state | {"_picture": None}

    def __setstate__(self, state):
        self.__dict__.update(state)
        self._program, self._stepper = self._compile()
        if (given := self._buffer) is not None:
            self._allocate(given.dtype)
            self._buffer[...] = given
            self._advance = self._step_in_place(self._signals)

    def step(self, action: Any) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """One step.

        **Arguments:** `action`: an action in the action space.

        **Returns:** the observation, the reward, `terminated`, `truncated`, and an
        empty dictionary.
        """
        # Here the overhead of Python costs as much as the arithmetic.
        if self._ended:
            what = "not begun" if self._buffer is None else "ended"
            raise ResetNeeded(
                f"GymnasiumEnv: call reset() before step(): the episode has {what}."
            )
        try:
            control = self._read(action)
        except (TypeError, ValueError):  # not an integer, or ragged
            self._invalid_action(action)
        if self.discrete:
            is_valid = 0 <= control < self._count
        else:
            is_valid = control.shape == self._shape and control.dtype.kind in "iuf"
        if not is_valid:
            self._invalid_action(action)
        self._action[...] = control
        flag = self._advance()
        reward, terminated, truncated, failed, _ = self._outcome()
        if flag or failed:
            self._fail(action)
        self._packed[...] = self._after
        self._stepped = True
        self._ended = bool(terminated or truncated)
        if self.render_mode == "human":
            self.render()
        return self._observation(), reward, terminated > 0, truncated > 0, {}

    def _invalid_action(self, action: Any) -> NoReturn:
        """Raise the error for an invalid action."""
        if self.discrete:
            raise InvalidAction(
                f"GymnasiumEnv: action must be a whole number from 0 to "
                f"{self._count - 1}, got {shortened(action)}; to pass the control "
                "itself, use discrete=False."
            )
        raise InvalidAction(
            f"GymnasiumEnv: action must be numbers of shape {self._shape}, got "
            f"{shortened(action)}."
        )

    def _fail(self, action: Any) -> NoReturn:
        """Raise after a failed step. A non-finite action does not end the episode."""
        if not np.all(np.isfinite(action)):
            raise InvalidAction(f"GymnasiumEnv: action must be finite, got {action}.")
        self._ended = True
        step = int(self._packed[programs.STEP])
        raise RuntimeError(
            f"GymnasiumEnv: the simulation failed at step {step}: the state or the "
            "reward is not finite, or the solver did not converge. Call reset()."
        )

    def render(self) -> np.ndarray | None:
        """Draw the plant as a picture, or in a window.

        **Returns:** in the mode `"rgb_array"` the picture, shape `(height, width, 3)`,
        else `None`.
        """
        if self.render_mode is None:
            gymnasium.logger.warn(
                "GymnasiumEnv: render() needs a render_mode, 'rgb_array' or 'human'. "
                "Give it when you make the environment."
            )
            return None
        if self._buffer is None:
            raise ResetNeeded("GymnasiumEnv: call reset() before render().")
        if self._picture is None:
            from ...plotting import Renderer

            self._picture = Renderer(self.environment, self.render_mode == "human")
        control = self._action
        if self.discrete:
            control = self._table[int(control[0])] * self._stepped
        step = int(self._packed[programs.STEP])
        frame = self._picture.frame(self.state, control, step)
        return frame if self.render_mode == "rgb_array" else None

    def close(self) -> None:
        """Close the window, if there is one."""
        if self._picture is not None:
            self._picture.close()
            self._picture = None
