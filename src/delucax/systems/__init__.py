"""Vector fields `dx/dt = f(t, x, u, w)`. They know of no step, cost or solver."""

from ._acrobot import Acrobot as Acrobot
from ._base import AbstractSystem as AbstractSystem
from ._cartpole import CartPole as CartPole
from ._cstr import CSTR as CSTR
from ._double_integrator import DoubleIntegrator as DoubleIntegrator
from ._dynamic_bicycle import DynamicBicycle as DynamicBicycle
from ._function import FunctionSystem as FunctionSystem, system as system
from ._kinematic_bicycle import KinematicBicycle as KinematicBicycle
from ._linear import LinearSystem as LinearSystem
from ._lorenz import Lorenz as Lorenz
from ._mass_spring_damper import MassSpringDamper as MassSpringDamper
from ._motor import PermanentMagnetMotor as PermanentMagnetMotor
from ._mountain_car import MountainCar as MountainCar
from ._neural import NeuralSystem as NeuralSystem
from ._pendulum import Pendulum as Pendulum
from ._planar_quadrotor import PlanarQuadrotor as PlanarQuadrotor
from ._plant import AbstractPlant as AbstractPlant
from ._quadrotor import Quadrotor as Quadrotor
from ._reacher import Reacher as Reacher
from ._two_tank import TwoTank as TwoTank
from ._van_der_pol import VanDerPol as VanDerPol
from ._winds import (
    ConstantWind as ConstantWind,
    DissipativeWind as DissipativeWind,
    VortexWind as VortexWind,
)
