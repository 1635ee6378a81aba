"""Environments, and the named tasks."""

from ._acrobot import (
    acrobot as acrobot,
    acrobot_features as acrobot_features,
    GymAcrobot as GymAcrobot,
)
from ._cartpole import (
    cartpole as cartpole,
    cartpole_linear as cartpole_linear,
    GymCartPole as GymCartPole,
)
from ._cstr import cstr as cstr
from ._double_integrator import double_integrator as double_integrator
from ._dynamic_bicycle import dynamic_bicycle as dynamic_bicycle
from ._environment import Environment as Environment, Step as Step
from ._kinematic_bicycle import kinematic_bicycle as kinematic_bicycle
from ._lane import bicycle_features as bicycle_features
from ._lds import lds as lds
from ._lorenz import lorenz as lorenz
from ._mass_spring_damper import mass_spring_damper as mass_spring_damper
from ._motor import permanent_magnet_motor as permanent_magnet_motor
from ._mountain_car import (
    GymMountainCar as GymMountainCar,
    mountain_car as mountain_car,
    mountain_car_discrete as mountain_car_discrete,
)
from ._neural import neural as neural
from ._pendulum import (
    GymPendulum as GymPendulum,
    pendulum as pendulum,
    pendulum_features as pendulum_features,
)
from ._planar_quadrotor import planar_quadrotor as planar_quadrotor
from ._quadrotor import (
    quadrotor as quadrotor,
    quadrotor_features as quadrotor_features,
)
from ._randomise import randomise as randomise
from ._reacher import reacher as reacher, ReacherCost as ReacherCost
from ._registry import (
    default_horizon as default_horizon,
    make as make,
    register as register,
    registered as registered,
)
from ._two_tank import two_tank as two_tank
from ._uniform_state import UniformState as UniformState
from ._van_der_pol import van_der_pol as van_der_pol
