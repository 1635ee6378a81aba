"""The spaces of an environment."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from gymnasium.spaces import Box, Discrete

from ..._check import check_bool
from ...environments import Environment
from ...environments._environment import LARGEST


# Samples are drawn of an action space, which has to end somewhere.
_LARGEST_ACTION = 1e3


def is_discrete(env: Environment, discrete: bool | None, where: str) -> bool:
    """Whether actions are indices into the table of `actions`."""
    if discrete is not None:
        check_bool(discrete, "discrete", where)
    if discrete and env.actions is None:
        raise ValueError(
            f"{where}: discrete needs a table of actions in the environment, which has "
            "none."
        )
    return env.actions is not None if discrete is None else discrete


def read_options(options: Any, names: tuple[str, ...], where: str) -> list[Any]:
    """What the options of a reset say, none where they do not."""
    if options is not None and not isinstance(options, Mapping):
        raise ValueError(f"{where}: options must be a dictionary, got {options!r}.")
    options = dict(options or {})
    found = [options.pop(name, None) for name in names]
    if options:
        raise ValueError(
            f"{where}: options takes {' and '.join(map(repr, names))} alone, got "
            f"{', '.join(map(repr, options))}."
        )
    return found


def action_space(env: Environment, discrete: bool) -> Box | Discrete:
    if discrete:
        assert env.actions is not None
        return Discrete(len(env.actions))
    low, high = (-np.inf, np.inf) if env.control_bounds is None else env.control_bounds
    ends = [
        np.where(np.isfinite(end), end, np.sign(end) * _LARGEST_ACTION)
        for end in (low, high)
    ]
    return _box(ends, env.control_size)


def observation_space(env: Environment) -> Box:
    bounds = env.observation_bounds
    return _box((-LARGEST, LARGEST) if bounds is None else bounds, env.feature_size)


def _box(ends: Any, size: int) -> Box:
    low, high = (np.broadcast_to(np.asarray(end, np.float32), size) for end in ends)
    return Box(low, high, dtype=np.float32)
