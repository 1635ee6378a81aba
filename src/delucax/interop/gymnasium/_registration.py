"""Registration of the tasks with Gymnasium, and functions that make them."""

import inspect
from typing import Any

import gymnasium
import jax
import jax.numpy as jnp
from gymnasium.envs.registration import EnvSpec

from ... import environments, lung
from ..._check import check_count
from ...environments import Environment, make as make_task
from .._episode import has_signals, reads_first_argument
from ._single_env import GymnasiumEnv
from ._vector_env import GymnasiumVectorEnv


_FUNCTIONS = {n: getattr(p, n) for p in (lung, environments) for n in dir(p)}
# The name of a task, whether its actions are whole numbers, and the mean return from
# which Gymnasium counts it as solved.
_IDS = {
    "Acrobot-v1": ("acrobot", True, -100.0),
    "AcrobotContinuous-v1": ("acrobot", False),
    "CartPole-v1": ("cartpole", True, 475.0),
    "CartPoleContinuous-v1": ("cartpole", False),
    "CartPoleLinear-v1": ("cartpole_linear", False),
    "CSTR-v1": ("cstr", False),
    "LDS-v1": ("lds", False),
    "MountainCar-v0": ("mountain_car_discrete", True, -110.0),
    "MountainCarContinuous-v0": ("mountain_car", False, 90.0),
}
_OTHERS = {*environments.registered()} & {*_FUNCTIONS} - {n for n, *_ in _IDS.values()}
_IDS |= {f"{n.title().replace('_', '')}-v1": (n, False) for n in sorted(_OTHERS)}


# Tasks whose plant is random, and the arguments that set it or its key.
_DRAWN = {"lds": ("A", "B", "system", "key"), "neural": ("system", "key")}


def _made(task: str, kwargs: dict[str, Any]) -> Environment:
    if task in _DRAWN and not any(name in kwargs for name in _DRAWN[task]):
        kwargs = kwargs | {"key": jax.random.key(0)}
    return make_task(task, **kwargs)


def make(
    task: str,
    *,
    discrete: bool | None = None,
    render_mode: str | None = None,
    backend: str = "jax",
    **kwargs: Any,
) -> GymnasiumEnv:
    """Make a task by name as a `gymnasium.Env`.

    After the import of `delucax.interop.gymnasium`, you can also make it with
    `gymnasium.make("delucax/Pendulum-v1", length=1.2)`. There Gymnasium's
    `max_episode_steps` ends the episodes. By default it is the horizon of the task.

    **Arguments:**

    - `task`: the name of a task, as in [`delucax.make`][].
    - `discrete`, `render_mode`, `backend`: arguments of
        [`delucax.interop.gymnasium.GymnasiumEnv`][].
    - `**kwargs`: arguments of the task. The random plants of `lds` and `neural` are
        drawn with the fixed key `jax.random.key(0)` unless you give a `key` or a plant,
        also in `gymnasium.make`.

    **Returns:** a [`delucax.interop.gymnasium.GymnasiumEnv`][].

    **Raises:** `ValueError` if an argument is wrong.

    !!! example

        ```python
        import delucax.interop.gymnasium
        import gymnasium

        env = gymnasium.make("delucax/Pendulum-v1", length=1.2)
        observation, info = env.reset(seed=0)
        observation.shape
        ```

        ```text
        (3,)
        ```
    """
    options: Any = dict(discrete=discrete, render_mode=render_mode, backend=backend)
    return GymnasiumEnv(_made(task, kwargs), **options)


def make_registered(task: str, **kwargs: Any) -> GymnasiumEnv:
    """The entry point of all ids. The time limit of Gymnasium ends the episodes.

    Some tasks end at their own horizon too, if it comes first: tasks with an explicit
    horizon; tasks with disturbances or noise, because these are drawn for the whole
    horizon; and tasks with an explicit cost that has a final cost.
    """
    options = "discrete", "render_mode", "backend"
    own = {name: kwargs.pop(name) for name in options if name in kwargs}
    env = _made(task, kwargs)
    ends = "horizon" in kwargs or has_signals(env)
    if kwargs.get("cost") is not None:
        final = lambda x: env.cost.final(0.0, x)
        ends = ends or reads_first_argument(final, jnp.zeros(env.state_size))
    return GymnasiumEnv(env, truncate=ends, **own)


def make_vector(
    task: str,
    num_envs: int = 1,
    *,
    discrete: bool | None = None,
    autoreset_mode: Any = "NextStep",
    max_episode_steps: int | None = None,
    **kwargs: Any,
) -> GymnasiumVectorEnv:
    """Make many copies of a task by name as one `gymnasium.vector.VectorEnv`.

    `gymnasium.make_vec("delucax/Pendulum-v1", num_envs=1024,
    vectorization_mode="vector_entry_point")` calls this function.

    **Arguments:**

    - `task`: the name of a task, as in [`delucax.make`][].
    - `num_envs`: the number of copies; 1 by default.
    - `discrete`, `autoreset_mode`: arguments of
        [`delucax.interop.gymnasium.GymnasiumVectorEnv`][].
    - `max_episode_steps`: the number of steps in an episode. If a `horizon` is given
        too, the smaller number counts. By default it is the horizon of the task.
    - `**kwargs`: arguments of the task.

    **Returns:** a [`delucax.interop.gymnasium.GymnasiumVectorEnv`][].

    **Raises:** `ValueError` if an argument is wrong, or if there is a `render_mode`:
    only a single environment can be rendered.

    !!! example

        ```python
        from delucax.interop.gymnasium import make_vector

        envs = make_vector("pendulum", 16)
        observations, infos = envs.reset(seed=0)
        observations.shape
        ```

        ```text
        (16, 3)
        ```
    """
    where = "make_vector"
    if kwargs.pop("render_mode", None) is not None:
        raise ValueError(
            f"{where}: render_mode must be left out, because only a single environment "
            'can be rendered (`gymnasium.make`, or `vectorization_mode="sync"`).'
        )
    if max_episode_steps == -1:
        raise ValueError(
            f"{where}: max_episode_steps must be positive, got -1. Only a single "
            "environment can run without a limit."
        )
    if max_episode_steps is not None:
        steps = check_count(max_episode_steps, "max_episode_steps", where)
        kwargs["horizon"] = min(steps, kwargs.get("horizon", steps))
    num_envs = check_count(num_envs, "num_envs", where)
    options: Any = dict(discrete=discrete, autoreset_mode=autoreset_mode)
    return GymnasiumVectorEnv(_made(task, kwargs), num_envs, **options)


for _name, (_task, _discrete, *_threshold) in _IDS.items():
    _arguments = inspect.signature(_FUNCTIONS[_task]).parameters
    _spec = EnvSpec(
        id=f"delucax/{_name}",
        entry_point=f"{__name__}:make_registered",
        vector_entry_point=f"{__package__}:make_vector",
        max_episode_steps=_arguments["horizon"].default,
        reward_threshold=_threshold[0] if _threshold else None,
        # The environment itself raises if `step` is called before `reset`.
        order_enforce=False,
        kwargs={"task": _task, "discrete": _discrete},
    )
    gymnasium.registry.setdefault(_spec.id, _spec)
