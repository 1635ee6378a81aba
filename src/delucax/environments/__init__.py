"""Environments, and the named tasks."""

from ._environment import (
    Environment as Environment,
    randomise as randomise,
    Step as Step,
    UniformState as UniformState,
)
from ._lds import lds as lds
from ._pendulum import (
    GymPendulum as GymPendulum,
    pendulum as pendulum,
    pendulum_features as pendulum_features,
)
from ._registry import make as make, register as register, registered as registered
