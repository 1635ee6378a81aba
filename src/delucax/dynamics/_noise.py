"""Whether dynamics that hold others say what becomes of their noise."""

import jax

from ..systems import AbstractSystem
from ._base import AbstractDynamics
from ._discretized import has_diffusion


def check_increments(dynamics: AbstractDynamics, where: str) -> None:
    """Raise where noise would be lost: `dynamics`, or others that they hold, do not say
    how many increments they take, while something in them takes some."""
    name = type(dynamics).__name__
    if dynamics.is_stochastic and not dynamics.increments:
        raise ValueError(
            f"{where}: {name} says that w is Brownian, so its increments must be at "
            "least 1, got 0. A subclass of delucax.dynamics.AbstractWrapper forwards "
            "them."
        )
    held = _held(dynamics)
    for part in held:
        if isinstance(part, AbstractDynamics):
            check_increments(part, where)
    if type(dynamics).increments is not AbstractDynamics.increments:
        return
    for part in filter(_is_noisy, held):
        raise ValueError(
            f"{where}: {name} hides the Brownian noise of the {type(part).__name__} "
            "that it holds. Derive it from delucax.dynamics.AbstractWrapper, or give "
            f"{name} `increments` of its own: those of what it holds, or "
            "`increments = 0` where w is not Brownian."
        )


def _held(dynamics: AbstractDynamics) -> list[AbstractDynamics | AbstractSystem]:
    """The outermost dynamics and systems inside."""

    def is_held(node):
        either = isinstance(node, AbstractDynamics | AbstractSystem)
        return either and node is not dynamics

    return [
        part for part in jax.tree.leaves(dynamics, is_leaf=is_held) if is_held(part)
    ]


def _is_noisy(part: AbstractDynamics | AbstractSystem) -> bool:
    try:
        if isinstance(part, AbstractDynamics):
            return part.is_stochastic
        return has_diffusion(part)
    except (TypeError, ValueError):  # a batch: what has no diffusion does not fail
        return True
