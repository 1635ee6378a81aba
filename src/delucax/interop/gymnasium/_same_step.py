"""Steps of a batch that resets at once, as Stable-Baselines3 tells of them."""

from typing import Any

import numpy as np


def dones_and_infos(
    step: tuple[Any, Any, Any, Any, dict[str, Any]],
) -> tuple[np.ndarray, np.ndarray, np.ndarray, list[dict[str, Any]]]:
    """A step of a `GymnasiumVectorEnv` that resets in the same step, as
    `(observations, rewards, dones, infos)`.

    The infos of what has ended hold the last observation of the episode and whether it
    was cut off by its time limit, after which the value of that observation counts.
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
