"""Environments: control tasks, and the ready-made tasks by name."""

from typing import TYPE_CHECKING

from .._lazy import lazily as _lazily
from ._environment import Environment as Environment, Step as Step
from ._randomise import randomise as randomise
from ._registry import (
    make as make,
    register as register,
    registered as registered,
    TASKS as _TASKS,
)
from ._task import UniformState as UniformState


if TYPE_CHECKING:
    from ._classic_control import (
        acrobot as acrobot,
        cartpole as cartpole,
        mountain_car as mountain_car,
        mountain_car_discrete as mountain_car_discrete,
        pendulum as pendulum,
    )
    from ._hard import (
        cartpole_swing_up as cartpole_swing_up,
        double_pendulum_cart as double_pendulum_cart,
        drift as drift,
        furuta as furuta,
        quadrotor_flip as quadrotor_flip,
        reactor_start_up as reactor_start_up,
        slung_load as slung_load,
    )
    from ._hybrid import (
        bouncing_ball as bouncing_ball,
        compass_gait as compass_gait,
        rimless_wheel as rimless_wheel,
        stick_slip as stick_slip,
        thermostat as thermostat,
        valve_with_stops as valve_with_stops,
    )
    from ._linear import cartpole_linear as cartpole_linear, lds as lds
    from ._regulation import (
        cstr as cstr,
        double_integrator as double_integrator,
        lorenz as lorenz,
        mass_spring_damper as mass_spring_damper,
        neural as neural,
        permanent_magnet_motor as permanent_magnet_motor,
        two_tank as two_tank,
        van_der_pol as van_der_pol,
    )
    from ._robots import (
        dynamic_bicycle as dynamic_bicycle,
        kinematic_bicycle as kinematic_bicycle,
        planar_quadrotor as planar_quadrotor,
        quadrotor as quadrotor,
        reacher as reacher,
    )
else:
    __getattr__, __dir__ = _lazily(__name__, _TASKS)
del TYPE_CHECKING
