"""Our tasks in Gymnasium's interface beside Gymnasium's own, step by step from Python.

Only steps are timed: the resets between episodes are not. The same actions for both,
drawn beforehand from the action space. One environment is raced as it is (`unwrapped`)
and as `gymnasium.make` returns it, with the wrappers that Gymnasium puts around it.
"""

import time
from collections.abc import Callable
from typing import Any

import gymnasium
import numpy as np

import delucax.interop.gymnasium  # noqa: F401, tells Gymnasium of our tasks
from benchmarks._timing import Contender, Missing


IDS = (
    "Acrobot-v1",
    "CartPole-v1",
    "MountainCar-v0",
    "MountainCarContinuous-v0",
    "Pendulum-v1",
)
OURS = "delucax"
THEIRS = "Gymnasium"
SYNC = "Gymnasium SyncVectorEnv"
VECTOR = "Gymnasium vectorised"


def single(name: str, steps: int, **options: Any) -> list[Contender]:
    """One environment of an id, by us with `options` and by Gymnasium, plain and as it
    is made."""
    return [
        contender
        for wrapped in (False, True)
        for contender in (
            _single(f"delucax/{name}", OURS, steps, wrapped, **options),
            _single(name, THEIRS, steps, wrapped),
        )
    ]


def _single(id: str, who: str, steps: int, wrapped: bool, **options: Any) -> Contender:
    env = gymnasium.make(id, **options)
    space = env.action_space
    if not wrapped:
        env = env.unwrapped
    space.seed(0)
    actions = [space.sample() for _ in range(1000)]
    seeds = iter(range(10**9))

    def measure() -> float:
        seconds, done = 0.0, 0
        step = env.step
        while done < steps:
            env.reset(seed=next(seeds))
            start = time.perf_counter()
            for action in actions:
                _, _, terminated, truncated, _ = step(action)
                done += 1
                if terminated or truncated:
                    break
            seconds += time.perf_counter() - start
        return seconds * steps / done

    return Contender(f"{who}, as made" if wrapped else who, steps, measure)


def vector(name: str, lanes: int, steps: int) -> list[Contender | Missing]:
    """A batch of an id: ours, a loop over Gymnasium's, and Gymnasium's own batch."""
    made: dict[str, Callable[[], Any]] = {
        OURS: lambda: gymnasium.make_vec(
            f"delucax/{name}", lanes, vectorization_mode="vector_entry_point"
        ),
        SYNC: lambda: gymnasium.make_vec(name, lanes, vectorization_mode="sync"),
        VECTOR: lambda: gymnasium.make_vec(
            name, lanes, vectorization_mode="vector_entry_point"
        ),
    }
    found: list[Contender | Missing] = []
    for who, make in made.items():
        if who == VECTOR and gymnasium.spec(name).vector_entry_point is None:
            found.append(
                Missing(who, "Gymnasium has no batch of its own for this task")
            )
            continue
        # A loop over a thousand environments takes a thousand times as long.
        found.append(_vector(who, make(), lanes, max(1, steps // 50 ** (who == SYNC))))
    return found


def _vector(who: str, envs: Any, lanes: int, steps: int) -> Contender:
    envs.action_space.seed(0)
    actions = [np.asarray(envs.action_space.sample()) for _ in range(10)]
    envs.reset(seed=0)

    def measure() -> float:
        start = time.perf_counter()
        for k in range(steps):
            envs.step(actions[k % 10])
        return time.perf_counter() - start

    return Contender(who, lanes * steps, measure)
