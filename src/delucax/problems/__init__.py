"""Optimal control problems with published optima."""

from ._base import OptimalControl as OptimalControl, Simulated as Simulated
from ._fixed_time import (
    catalyst_mixing as catalyst_mixing,
    CatalystMixing as CatalystMixing,
    hanging_chain as hanging_chain,
    HangingChain as HangingChain,
)
from ._flight import (
    goddard_rocket as goddard_rocket,
    GoddardRocket as GoddardRocket,
    hang_glider as hang_glider,
    HangGlider as HangGlider,
)
from ._kinetics import (
    alpha_pinene as alpha_pinene,
    gas_oil_cracking as gas_oil_cracking,
    methanol_to_hydrocarbons as methanol_to_hydrocarbons,
    Reactions as Reactions,
    Sampled as Sampled,
)
from ._least_time import (
    particle_steering as particle_steering,
    ParticleSteering as ParticleSteering,
    robot_arm as robot_arm,
    RobotArm as RobotArm,
)


NAMES = (
    "particle_steering",
    "robot_arm",
    "goddard_rocket",
    "hang_glider",
    "catalyst_mixing",
    "hanging_chain",
    "gas_oil_cracking",
    "methanol_to_hydrocarbons",
    "alpha_pinene",
)
"""The names of the functions that make a problem."""
