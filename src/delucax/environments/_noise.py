"""Whether plants that hold others say what becomes of their noise."""

import jax

from ..dynamics import AbstractDynamics
from ..systems import AbstractPlant


def check_noise(plant: AbstractPlant, where: str) -> None:
    """Raise where noise would be lost: `plant`, or another inside it, does not say how
    `w` acts, while something in it takes Brownian increments."""
    name, noise = type(plant).__name__, plant.noise
    if isinstance(plant, AbstractDynamics):
        if (plant.increments > 0) != (noise == "brownian"):
            raise ValueError(
                f"{where}: {name} has noise = {noise!r} and increments = "
                f"{plant.increments}, but increments must be at least 1 where w is "
                "Brownian, and 0 where it is not. A subclass of "
                "delucax.dynamics.AbstractWrapper forwards both."
            )
    for part in _inside(plant):
        check_noise(part, where)
        if _is_noisy(part) and not plant.declares_noise():
            raise ValueError(
                f"{where}: {name} hides the Brownian noise of the "
                f"{type(part).__name__} that it holds. Derive it from "
                f"delucax.dynamics.AbstractWrapper, or give {name} `noise` of its own: "
                "that of what it holds, or `noise = None` where w is not Brownian."
            )


def _inside(plant: AbstractPlant) -> list[AbstractPlant]:
    """The outermost plants inside."""

    def is_inside(node):
        return isinstance(node, AbstractPlant) and node is not plant

    return [
        part for part in jax.tree.leaves(plant, is_leaf=is_inside) if is_inside(part)
    ]


def _is_noisy(part: AbstractPlant) -> bool:
    try:
        return part.noise == "brownian"
    except (TypeError, ValueError):  # a batch: what has no diffusion does not fail
        return True
