"""The spaces of an environment."""

from typing import Any

import numpy as np
from gymnasium.spaces import Box, Discrete

from ...environments import Environment


# A space has to end somewhere, and of an action space samples are drawn.
_LARGEST = float(np.finfo(np.float32).max)
_LARGEST_ACTION = 1e3


def is_discrete(env: Environment, discrete: bool | None, where: str) -> bool:
    """Whether actions are indices into the table of `actions`."""
    if discrete and env.actions is None:
        raise ValueError(
            f"{where}: discrete needs a table of actions in the environment, which has "
            "none."
        )
    return env.actions is not None if discrete is None else bool(discrete)


def action_space(env: Environment, discrete: bool) -> Box | Discrete:
    if discrete:
        assert env.actions is not None
        return Discrete(len(env.actions))
    return _box(env.control_bounds, env.control_size, _LARGEST_ACTION)


def observation_space(env: Environment) -> Box:
    return _box(env.observation_bounds, env.feature_size, _LARGEST)


def _box(bounds: Any, size: int, largest: float) -> Box:
    """A box; a side without a bound ends at the largest number."""
    low, high = (-np.inf, np.inf) if bounds is None else bounds
    ends = [
        np.where(np.isfinite(end), end, np.sign(end) * largest)
        for end in (np.broadcast_to(np.asarray(e, float), size) for e in (low, high))
    ]
    low, high = (end.astype(np.float32) for end in ends)
    return Box(low, high, dtype=np.float32)
