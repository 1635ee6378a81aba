"""Plants in continuous time. A system is a vector field `dx/dt = f(t, x, u, w)`: it
knows no step, no cost and no solver."""

from typing import TYPE_CHECKING

from .._lazy import lazily as _lazily
from ._base import AbstractPlant as AbstractPlant, AbstractSystem as AbstractSystem
from ._delayed import AbstractDelaySystem as AbstractDelaySystem
from ._general import (
    FunctionSystem as FunctionSystem,
    LinearSystem as LinearSystem,
    NeuralSystem as NeuralSystem,
    system as system,
)
from ._hybrid_base import AbstractHybridSystem as AbstractHybridSystem
from ._wrappers import (
    AbstractSystemWrapper as AbstractSystemWrapper,
    Calibrated as Calibrated,
    Corrected as Corrected,
)


if TYPE_CHECKING:
    from ._classic_control import (
        Acrobot as Acrobot,
        CartPole as CartPole,
        MountainCar as MountainCar,
        Pendulum as Pendulum,
    )
    from ._hybrid import BouncingBall as BouncingBall, RimlessWheel as RimlessWheel
    from ._industrial import (
        CSTR as CSTR,
        PermanentMagnetMotor as PermanentMagnetMotor,
        TwoTank as TwoTank,
    )
    from ._oscillators import (
        DoubleIntegrator as DoubleIntegrator,
        Lorenz as Lorenz,
        MassSpringDamper as MassSpringDamper,
        VanDerPol as VanDerPol,
    )
    from ._pendulums import (
        DoublePendulumCart as DoublePendulumCart,
        FurutaPendulum as FurutaPendulum,
    )
    from ._quadrotors import PlanarQuadrotor as PlanarQuadrotor, Quadrotor as Quadrotor
    from ._robots import (
        DynamicBicycle as DynamicBicycle,
        KinematicBicycle as KinematicBicycle,
        Reacher as Reacher,
    )
    from ._switching import (
        StickSlip as StickSlip,
        Thermostat as Thermostat,
        ValveWithStops as ValveWithStops,
    )
    from ._vehicles import DriftingCar as DriftingCar, SlungLoad as SlungLoad
    from ._walkers import CompassGait as CompassGait, SimplestWalker as SimplestWalker
    from ._winds import (
        ConstantWind as ConstantWind,
        DissipativeWind as DissipativeWind,
        VortexWind as VortexWind,
    )
else:
    # Each plant is imported when it is first used, so that the package loads quickly.
    __getattr__, __dir__ = _lazily(
        __name__,
        {
            "_classic_control": "Acrobot CartPole MountainCar Pendulum",
            "_hybrid": "BouncingBall RimlessWheel",
            "_industrial": "CSTR PermanentMagnetMotor TwoTank",
            "_oscillators": "DoubleIntegrator Lorenz MassSpringDamper VanDerPol",
            "_pendulums": "DoublePendulumCart FurutaPendulum",
            "_quadrotors": "PlanarQuadrotor Quadrotor",
            "_robots": "DynamicBicycle KinematicBicycle Reacher",
            "_switching": "StickSlip Thermostat ValveWithStops",
            "_vehicles": "DriftingCar SlungLoad",
            "_walkers": "CompassGait SimplestWalker",
            "_winds": "ConstantWind DissipativeWind VortexWind",
        },
    )
del TYPE_CHECKING
