"""The spaces of an environment."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from gymnasium.spaces import Box, Discrete

from ..._check import LARGEST
from ...environments import Environment
from .._spaces import finite_ends, LARGEST_ACTION


def read_options(options: Any, names: tuple[str, ...], where: str) -> list[Any]:
    """The options of a reset, none for those that are left out."""
    if options is not None and not isinstance(options, Mapping):
        raise ValueError(f"{where}: options must be a dictionary, got {options!r}.")
    options = dict(options or {})
    values = [options.pop(name, None) for name in names]
    if options:
        raise ValueError(
            f"{where}: options takes {' and '.join(map(repr, names))} alone, got "
            f"{', '.join(map(repr, options))}."
        )
    return values


def action_space(env: Environment, discrete: bool) -> Box | Discrete:
    """Indices into the table of actions, or controls."""
    if discrete:
        assert env.actions is not None
        return Discrete(len(env.actions))
    return _box(finite_ends(env.control_bounds, env.control_size, LARGEST_ACTION))


def observation_space(env: Environment) -> Box:
    """What `encode` returns."""
    bounds = env.observation_bounds
    # Gymnasium's own spaces are infinite where bounds are.
    ends = (-LARGEST, LARGEST) if bounds is None else bounds
    return _box(finite_ends(ends, env.feature_size, np.inf))


def _box(ends: Any) -> Box:
    low, high = (np.asarray(end, np.float32) for end in ends)
    return Box(low, high, dtype=np.float32)
