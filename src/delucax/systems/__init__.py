"""Vector fields `dx/dt = f(t, x, u, w)`. Independent of steps, costs and solvers."""

from ._base import AbstractPlant as AbstractPlant, AbstractSystem as AbstractSystem
from ._classic_control import (
    Acrobot as Acrobot,
    CartPole as CartPole,
    MountainCar as MountainCar,
    Pendulum as Pendulum,
)
from ._general import (
    FunctionSystem as FunctionSystem,
    LinearSystem as LinearSystem,
    NeuralSystem as NeuralSystem,
    system as system,
)
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
from ._quadrotors import (
    ConstantWind as ConstantWind,
    DissipativeWind as DissipativeWind,
    PlanarQuadrotor as PlanarQuadrotor,
    Quadrotor as Quadrotor,
    VortexWind as VortexWind,
)
from ._robots import (
    DynamicBicycle as DynamicBicycle,
    KinematicBicycle as KinematicBicycle,
    Reacher as Reacher,
)
