"""The tasks under Gymnasium's own `make`."""

from typing import Any

import gymnasium
import jax
from gymnasium.envs.registration import EnvSpec

from ..._check import check_count
from ...environments import Environment, make as make_task
from ._env import GymnasiumEnv
from ._vector import GymnasiumVectorEnv


# The name of a task, and whether its actions are whole numbers.
_IDS = {
    "Acrobot-v1": ("acrobot", True),
    "AcrobotContinuous-v1": ("acrobot", False),
    "CartPole-v1": ("cartpole", True),
    "CartPoleContinuous-v1": ("cartpole", False),
    "CartPoleLinear-v1": ("cartpole_linear", False),
    "DoubleIntegrator-v1": ("double_integrator", False),
    "DynamicBicycle-v1": ("dynamic_bicycle", False),
    "KinematicBicycle-v1": ("kinematic_bicycle", False),
    "LDS-v1": ("lds", False),
    "Lorenz-v1": ("lorenz", False),
    "MassSpringDamper-v1": ("mass_spring_damper", False),
    "MountainCar-v0": ("mountain_car_discrete", True),
    "MountainCarContinuous-v0": ("mountain_car", False),
    "Neural-v1": ("neural", False),
    "Pendulum-v1": ("pendulum", False),
    "PermanentMagnetMotor-v1": ("permanent_magnet_motor", False),
    "PlanarQuadrotor-v1": ("planar_quadrotor", False),
    "Quadrotor-v1": ("quadrotor", False),
    "Reacher-v1": ("reacher", False),
    "TwoTank-v1": ("two_tank", False),
    "VanDerPol-v1": ("van_der_pol", False),
}


# Tasks whose plants are drawn at random, unless one is given.
_DRAWN = {"lds": ("A", "B", "system", "key"), "neural": ("system", "key")}


def _task(task: str, kwargs: dict[str, Any]) -> Environment:
    if task in _DRAWN and not any(name in kwargs for name in _DRAWN[task]):
        kwargs = kwargs | {"key": jax.random.key(0)}
    return make_task(task, **kwargs)


def make(
    task: str,
    *,
    discrete: bool | None = None,
    render_mode: str | None = None,
    **kwargs: Any,
) -> GymnasiumEnv:
    """The task of that name as a `gymnasium.Env`: the entry point of all ids.

    `gymnasium.make("delucax/Pendulum-v1", length=1.2)` calls it, once
    `delucax.interop.gymnasium` has been imported.

    **Arguments:**

    - `task`: a name that [`delucax.make`][] knows.
    - `discrete`, `render_mode`: of [`delucax.interop.gymnasium.GymnasiumEnv`][].
    - `**kwargs`: passed to the task. Plants that are drawn at random are drawn with
        `jax.random.key(0)` unless a `key` or a plant is given.

    **Returns:** a [`delucax.interop.gymnasium.GymnasiumEnv`][].

    !!! example

        ```python
        import delucax.interop.gymnasium
        import gymnasium

        env = gymnasium.make("delucax/Pendulum-v1", length=1.2)
        env.reset(seed=0)
        ```
    """
    env = _task(task, kwargs)
    return GymnasiumEnv(env, discrete=discrete, render_mode=render_mode)


def make_vector(
    task: str,
    num_envs: int = 1,
    *,
    discrete: bool | None = None,
    autoreset_mode: Any = "NextStep",
    **kwargs: Any,
) -> GymnasiumVectorEnv:
    """Many of the task of that name as one `gymnasium.vector.VectorEnv`.

    `gymnasium.make_vec("delucax/Pendulum-v1", num_envs=1024,
    vectorization_mode="vector_entry_point")` calls it.

    **Arguments:**

    - `task`: a name that [`delucax.make`][] knows.
    - `num_envs`: how many.
    - `discrete`, `autoreset_mode`: of
        [`delucax.interop.gymnasium.GymnasiumVectorEnv`][].
    - `**kwargs`: passed to the task.

    **Returns:** a [`delucax.interop.gymnasium.GymnasiumVectorEnv`][].

    !!! example

        ```python
        from delucax.interop.gymnasium import make_vector

        envs = make_vector("pendulum", 16)
        envs.reset(seed=0)
        ```
    """
    kwargs.pop("render_mode", None)
    env = _task(task, kwargs)
    num_envs = check_count(num_envs, "num_envs", "make_vector")
    return GymnasiumVectorEnv(
        env, num_envs, discrete=discrete, autoreset_mode=autoreset_mode
    )


def register_ids() -> tuple[str, ...]:
    """Tell Gymnasium of the tasks, as `delucax/Pendulum-v1` and so on.

    Importing `delucax.interop.gymnasium` does it; to do it again changes nothing.

    **Returns:** the ids.

    !!! example

        ```python
        from delucax.interop.gymnasium import register_ids

        register_ids()
        ```
    """
    ids = []
    for name, (task, discrete) in _IDS.items():
        spec = EnvSpec(
            id=f"delucax/{name}",
            entry_point=f"{__package__}:make",
            vector_entry_point=f"{__package__}:make_vector",
            # Ends and orders are checked by the environment itself.
            order_enforce=False,
            kwargs={"task": task, "discrete": discrete},
        )
        gymnasium.registry.setdefault(spec.id, spec)
        ids.append(spec.id)
    return tuple(ids)
