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
from ._environment import Environment as Environment, Step as Step
from ._lane import (
    bicycle_features as bicycle_features,
    dynamic_bicycle as dynamic_bicycle,
    kinematic_bicycle as kinematic_bicycle,
)
from ._lds import lds as lds
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
from ._regulation import (
    cstr as cstr,
    double_integrator as double_integrator,
    lorenz as lorenz,
    mass_spring_damper as mass_spring_damper,
    permanent_magnet_motor as permanent_magnet_motor,
    two_tank as two_tank,
    van_der_pol as van_der_pol,
)
from ._uniform_state import UniformState as UniformState
