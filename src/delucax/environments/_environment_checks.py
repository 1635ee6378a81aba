"""Checks of the disturbances of an environment, and the default disturbance."""

from typing import Any

from .._check import check_instance
from .._module import parts_of
from ..disturbances import AbstractDisturbance, Brownian, Zero
from ..dynamics import AbstractDynamics
from ..systems import AbstractPlant


def check_signal(signal: Any, size: int, name: str) -> None:
    """Raise unless `signal` is a disturbance of the given size."""
    check_instance(signal, AbstractDisturbance, name, "Environment")
    if signal.size != size:
        raise ValueError(
            f"Environment: {name} must have size {size}, got size {signal.size}."
        )


def default_disturbance(dynamics: AbstractDynamics) -> AbstractDisturbance:
    """Brownian increments for dynamics with a diffusion, else no disturbance."""
    k, count = dynamics.disturbance_size, dynamics.increments
    return Brownian(k // count, substeps=count) if count else Zero(k)


def check_noise(plant: AbstractPlant, where: str) -> None:
    """Raise unless `plant` and each plant inside it forward the Brownian noise of the
    plants that they wrap."""
    name, noise = type(plant).__name__, plant.noise
    if isinstance(plant, AbstractDynamics):
        if (plant.increments > 0) != (noise == "brownian"):
            raise ValueError(
                f"{where}: increments of {name} must be at least 1 if its noise is "
                f"'brownian', else 0, got noise {noise!r} and increments "
                f"{plant.increments}. Derive it from delucax.dynamics.AbstractWrapper, "
                "which forwards both."
            )
    for part in parts_of(plant, AbstractPlant):
        check_noise(part, where)
        try:
            is_brownian = part.noise == "brownian"
        except (TypeError, ValueError):  # only a batch with noise fails
            is_brownian = True
        if is_brownian and not plant.declares_noise():
            raise ValueError(
                f"{where}: {name} must forward `noise` of the "
                f"{type(part).__name__} that it wraps. Derive it from "
                f"delucax.dynamics.AbstractWrapper, or define `noise` in {name}: the "
                "noise of the wrapped plant, or None if w is not Brownian."
            )
